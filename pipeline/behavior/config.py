"""Options of the behavior model and of plan sampling. Standard library only."""

from dataclasses import dataclass, replace
from typing import Literal

Ego = Literal["yaw", "full", "world"]
"""Ego frame: the root's heading, its full rotation as in the paper, or, as an ablation, the world's axes."""
Family = Literal["diffusion", "gaussian", "one_stage"]
"""What is learned: goal, path and body by diffusion; each as a Gaussian; path and body without a goal."""
Control = Literal["unet", "concatenation"]
"""How goal and path condition a UNet: by a second UNet (ControlNet), or within the perception code."""
SceneEncoder = Literal["pillars", "volume", "none"]
"""2.5-D encoder with height in channels, the six 3-D convolutions of the paper, or no encoder, for
trajectories without a map."""
ObservedPast = Literal["positions", "poses"]
"""Encoding of the observer's past: positions, or, as in the paper, SE(3) poses."""
Guided = Literal["observer", "all"]
"""Conditions that the reference of guidance lacks: observer and goal; or all, as in the paper,
which needs `joint_dropout` in training."""
Encoding = Literal["strides", "positions"]
"""What is diffused: strides and goals by a power of their distance, bodies relative to the current posture;
or, as in the paper, positions, and bodies as they are."""
AblatedInput = Literal["nothing", "scene", "observer", "past"]
"""The part of perception that an ablation replaces by its learned null."""
NoiseCourse = Literal["linear", "rectified"]
"""Variances that grow linearly (Ho et al. 2020), or rectified flow (Liu et al. 2023)."""
SamplingMethod = Literal["ddpm", "ddpm_large", "dpm_solver"]
"""DDPM with the posterior variance or the larger forward variance (both Ho et al. 2020, Sec. 3.2), which
keeps the spread of samples with few steps; DPM-Solver++ (Lu et al. 2022) adds no noise."""
MAX_GUIDANCE = 2.0
"""Largest guidance scale that sliders offer; beyond it, goal errors grow."""


@dataclass(frozen=True)
class PlanSamplingConfig:
    """How plans are sampled."""

    method: SamplingMethod | None = None
    """Sampler of goals; none: the schedule's. DDPM adds fresh noise at every step; DPM-Solver++ is
    deterministic given the initial noise."""
    goal_steps: int = 0
    """Denoising steps of the goal; 0: the schedule's own number, 10 of DPM-Solver++, 50 of DDPM."""
    sequence_steps: int = 0
    """Denoising steps of path and body by DPM-Solver++; 0: the schedule's own sampler and number. Evenly
    spaced in log-SNR, some coincide: 9 are left of 10, 33 of 50."""
    guidance: float = 1.25
    """Scale s of classifier-free guidance, for bodies at most 1. Of 1, 1.25, 1.5, 2 it has the least energy
    score of goals and the right share of flights in left-out sessions of the built-in cat."""
    companions_guidance: float | tuple[float, ...] = 1.0
    """Guidance scale of companions, for bodies at most 1, where the reference keeps all other conditions; or
    one scale of each, in the order in which a context holds them, where the reference lacks only that one."""
    scene: bool = True
    """Condition on the scene."""
    observer: bool = True
    """Condition on the observer."""
    past: bool = True
    """Condition on the agent's past."""
    goal: bool = True
    """Condition paths on their goals."""
    avoid_solid: bool = True
    """Project goals and paths out of solid voxels during denoising, and onto the supporting surface; needs a
    map, and the scene as a condition."""
    snap_to_goal: bool = True
    """Warp paths to end at the goals that condition them."""
    body_noise_std: float = 0.25
    """Standard deviation of the initial noise of bodies. Of 0.1 to 1 it has the least joint error of the best
    of 16 in each of three sessions left out of training (built-in cat; `docs/experiments/behavior.md`)."""
    path_noise_std: float = 1.0
    """Standard deviation of the initial noise of paths. At 0, in one step, a path is the mean of all paths to
    its goal."""
    max_path_draws: int = 3
    """Maximum draws of a path until it reaches its goal. Paths drawn once rest too often: 67 % of the time,
    against 64 % with up to three draws and 63 % in truth (four held-out homes)."""

    def for_bodies(self) -> "PlanSamplingConfig":
        """Return settings under which guidance amplifies nobody: bodies would be contorted."""
        scales = self.companions_guidance
        most = tuple(min(each, 1.0) for each in scales) if isinstance(scales, tuple) else min(scales, 1.0)
        return replace(self, guidance=min(self.guidance, 1.0), companions_guidance=most)

    def networks_only(self) -> "PlanSamplingConfig":
        """Return settings under which plans are what the networks predict, as in the paper: not projected out
        of solid space, not snapped to their goals, drawn once.
        """
        return replace(self, avoid_solid=False, snap_to_goal=False, max_path_draws=1)


@dataclass(frozen=True)
class ReplanningConfig:
    """When and how a plan is replaced by the next one."""

    reaction_frames: int = 3
    """Frames of a plan that are played before the animal reacts to the observer; who comes at 1.2 m/s has
    reached it after 8."""
    commitment_frames: int = 8
    """Frames of a plan that are played before other animals or a command may replace it."""
    observer_motion_ratio: float = 0.25
    """Motion of the observer since planning that triggers replanning, relative to its distance from the
    agent; infinite: never."""
    blend_frames: int = 4
    """Frames over which the next plan is blended in."""
    companion_radius_m: float = 1.5
    """Distance from another animal within which a goal moves with it: at rest they are up to 1.1 m apart."""
    candidates: int = 8
    """Maximum number of plans drawn, of which the least blocked is taken."""
