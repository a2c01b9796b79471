"""Choices that recipes make about the behaviour model, and how plans are sampled. Standard library only."""

from dataclasses import dataclass
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
"""What is read of the observer's past: where it was, or, as in the paper, its SE(3) poses."""
Guided = Literal["observer", "all"]
"""What the reference of guidance does without: observer and goal; or all conditions, as in the paper, which a
model learns by `joint_dropout`."""
MapLookup = Literal["attention", "pointwise"]
"""How denoisers read the map: by attention, or, as in the released code, at the noisy point itself."""
AblatedInput = Literal["nothing", "scene", "observer", "past"]
"""The part of perception that an ablation replaces by its learned null."""
NoiseCourse = Literal["linear", "rectified"]
"""Variances that grow linearly (Ho et al. 2020), or rectified flow (Liu et al. 2023)."""
SamplingMethod = Literal["ddpm", "ddpm_large", "ddim"]
"""DDPM adds noise of the posterior's variance at each step, or of the larger one of the forward step (both of
Ho et al. 2020, Sec. 3.2), which keeps the spread that few steps of the former lose; DDIM adds none."""
MAX_GUIDANCE = 2.0
"""Largest scale that sliders offer: goals err more from there on."""


@dataclass(frozen=True)
class PlanSamplingConfig:
    """How plans are drawn."""

    method: SamplingMethod | None = None
    """Sampler of goals (none: as the schedule asks for). DDPM adds fresh noise at every step, which corrects
    earlier errors; DDIM is a function of the first noise alone, as paths and bodies are."""
    goal_steps: int = 50
    """Denoising steps of the goal."""
    sequence_steps: int = 10
    """Denoising steps of path and body."""
    guidance: float = 1.25
    """Scale s of classifier-free guidance, for bodies at most 1. Of 1, 1.25, 1.5, 2 it has the least energy
    score of goals and the right share of flights in left-out sessions of the built-in cat."""
    guided: Guided = "observer"
    """What the guidance acts on."""
    companions_guidance: float = 1.0
    """The scale for all others but the observer, where the reference has all other conditions."""
    scene: bool = True
    """Condition on the scene."""
    observer: bool = True
    """Condition on the observer."""
    past: bool = True
    """Condition on the agent's past."""
    goal: bool = True
    """Condition paths on their goals."""
    avoid_solid: bool = True
    """Move goals and paths out of solid voxels while they are denoised, and onto what supports the agent;
    needs a map and the scene among the conditions."""
    body_noise_std: float = 0.3
    """Standard deviation of the noise that bodies are drawn from. At 1 a body trembles three times as much as
    the animal does; at 0.3 its bones rotate from frame to frame as far as recorded ones (session kept from
    training)."""
    path_noise_std: float = 1.0
    """Standard deviation of the noise that paths are drawn from. At 0, in one step, a path is the mean of all
    that lead to its goal."""
    max_path_draws: int = 3
    """Paths drawn at most until one reaches its goal. Of paths drawn once, more stay than animals do: 67 % of
    the time against 64 % with up to three draws and 63 % in truth (four homes kept from training)."""


@dataclass(frozen=True)
class ReplanningConfig:
    """When a plan is replaced by the next one, and how."""

    reaction_frames: int = 8
    """Frames of a plan that are played before another one may follow it."""
    observer_motion_ratio: float = 0.25
    """How far the observer must have moved since then for a plan to be dropped, as a share of the distance
    between observer and agent; no plan is dropped where this is infinite."""
    blend_frames: int = 4
    """Frames over which the next plan is blended in."""
    candidates: int = 8
    """Plans drawn at most, of which the least blocked one is taken."""
