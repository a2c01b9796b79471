"""The behaviour model as a whole: what its channels mean, its networks, its files.

`Architecture` fixes shapes, `BehaviorNets` holds the weights, `contract` and `load` write and read them as files; the
functions between define the channels of body and past. Plans are drawn by `pipeline.models.planning`.
"""

import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Literal, assert_never

import numpy as np
from jaxtyping import Float
from safetensors.torch import load_file
from torch import nn

from pipeline.models.body_denoiser import TOLD, BodyDenoiser
from pipeline.models.concatenation import ConcatenationUNet
from pipeline.models.denoisers import EMBEDDING, ControlUNet, FreeUNet, Tail
from pipeline.models.diffusion import STANDARD, Schedule
from pipeline.models.goal_denoiser import GoalMLP, Reading
from pipeline.models.perception import (
    GRID_CELL_M,
    GRID_SHAPE,
    MAP_KEY,
    PACE_CHANNELS,
    Blind,
    Ego,
    Minds,
    PerceptionSize,
)
from pipeline.models.pointwise import WaypointUNet
from pipeline.models.strides import BREATH, FAINT, GOAL_POWER, REACH, REACH_M, ROOT, STAYS_M_S, STRIDE, bent, path_from_strides, powered
from pipeline.models.trajectories import FUTURE, PAST, RATE_HZ
from pipeline.space import rigid

ROOT_CHANNELS = 6
"""the body's leading channels: the root's rotation in the ego frame, its first two columns"""


@dataclass(frozen=True)
class Architecture:
    """Everything that fixes the shape of the networks and the meaning of their channels."""

    bones: int
    ego: Ego = "yaw"
    scene: Literal["pillars", "volume"] = "pillars"
    scene_width: int = 32
    scene_block: int = 4
    scene_channels: int = 16
    hidden: int = 128
    code: int = 64
    observer_radius_m: float = 4.0
    blind_to: Blind = "nothing"
    unet_width: int = 16
    unet_multipliers: tuple[int, ...] = (1, 2, 4)
    goal_hidden: int = 128
    goal_layers: int = 6
    family: Literal["diffusion", "gaussian", "one_stage"] = "diffusion"
    control: Literal["unet", "concatenation"] = "unet"
    future: int = FUTURE
    minds: int = 3
    reading: Reading = "attention"

    @property
    def body_channels(self) -> int:
        """Root rotation and 6 numbers per bone."""
        return ROOT_CHANNELS + 6 * self.bones

    @property
    def scene_stride(self) -> int:
        """How many cells of the ego grid the scene encoder averages along each axis before it begins."""
        return self.scene_block if self.scene == "pillars" else 1

    @property
    def map_cells(self) -> int:
        """Cells along each side of the map in which goals look things up; 0 without one."""
        return GRID_SHAPE[0] // self.scene_block if self.scene == "pillars" else 0

    @property
    def told(self) -> int:
        """Length of the perception code of all minds, of the pace and of the posture that is held now."""
        return 3 * self.code * self.minds + PACE_CHANNELS + self.body_channels

    @property
    def condition(self) -> int:
        """Length of all that is perceived: the maps of all minds, and what path and body are told."""
        return 2 * MAP_KEY * self.map_cells**2 * self.minds + self.told

    @property
    def perception(self) -> PerceptionSize:
        """Return the sizes of the perception network."""
        return PerceptionSize(
            self.scene,
            self.scene_width,
            self.scene_block,
            self.scene_channels,
            self.hidden,
            self.code,
            PAST,
            9 + 6 * self.bones,
            self.observer_radius_m,
            RATE_HZ,
            self.blind_to,
        )


@dataclass(frozen=True)
class Scaling:
    """What turns ego-frame metres and radians into the unit-variance numbers that are diffused, and back."""

    goal_std: Float[np.ndarray, "3"]
    stride_std: Float[np.ndarray, "#frame 4"]
    """of strides, see `pipeline.models.strides`: of all frames alike, or of each on its own"""
    path_std: Float[np.ndarray, "3 56"]
    """of places, as the body is told them, metres"""
    body_mean: Float[np.ndarray, "channel"]
    body_std: Float[np.ndarray, "channel"]

    def scaled_goal(self, goal: Float[np.ndarray, "plan 3"]) -> Float[np.ndarray, "plan 3"]:
        """Return goals in metres as they are diffused, and as they control a path."""
        return (powered(goal, GOAL_POWER) / self.goal_std).astype(np.float32)

    def goal(self, scaled: Float[np.ndarray, "plan 3"]) -> Float[np.ndarray, "plan 3"]:
        """Undo `scaled_goal`."""
        return powered(scaled * self.goal_std, 1 / GOAL_POWER)

    def path(self, scaled: Float[np.ndarray, "plan 4 frame"], start: Float[np.ndarray, "plan 3"]) -> Float[np.ndarray, "plan frame 3"]:
        """Return the paths in metres, from ``start`` on, that scaled strides lead along."""
        return path_from_strides(np.swapaxes(scaled, 1, 2) * self.stride_std, start)

    def bent(
        self, scaled: Float[np.ndarray, "plan 4 frame"], start: Float[np.ndarray, "plan 3"], path: Float[np.ndarray, "plan frame 3"]
    ) -> Float[np.ndarray, "plan 4 frame"]:
        """Return scaled strides that lead along other paths."""
        return np.swapaxes(bent(np.swapaxes(scaled, 1, 2) * self.stride_std, start, path) / self.stride_std, 1, 2)

    def told_path(self, path: Float[np.ndarray, "plan frame 3"]) -> Float[np.ndarray, "plan 3 frame"]:
        """Return paths in metres as they control a body."""
        return (np.swapaxes(path, 1, 2) / self.path_std).astype(np.float32)


@dataclass(frozen=True)
class Sampling:
    """How plans are drawn."""

    method: Literal["ddpm", "ddim"] | None = None
    """of goals (none: as the schedule asks for): DDPM adds fresh noise at every step, which mends earlier errors (minDE of goals
    0.41 -> 0.39 and 0.43 -> 0.42 m of two models, on a home kept from training); DDIM is a function of the first noise alone, as
    paths and bodies are"""
    goal_steps: int = 50
    """denoising steps of the goal"""
    sequence_steps: int = 10
    """denoising steps of path and body"""
    guidance: float = 1.0
    """interactivity s: scales the observer and the goal condition"""
    scene: bool = True
    """perceive the scene"""
    observer: bool = True
    """perceive the observer"""
    past: bool = True
    """remember the past"""
    goal: bool = True
    """let the goal steer the path"""
    clear: bool = True
    """move goals and paths out of what is solid while they are denoised, and put them on what carries, where a map is given and
    the scene perceived"""
    body_spread: float = 0.3
    """standard deviation of the noise that a body is drawn from: at 1 it trembles three times as much as the animal does,
    at 0.3 its bones turn from frame to frame as far as recorded ones do (measured on a session kept from training)"""
    path_draws: int = 3
    """paths drawn at most until one gets to its goal: of those drawn once, more stay than animals do (rest 67 % of the time, 64 %
    drawn up to three times, 63 % true; on four homes kept from training)"""


class BehaviorNets(nn.Module):
    """Perception and the three denoisers."""

    def __init__(self, architecture: Architecture, schedule: Schedule = STANDARD):
        super().__init__()
        a = architecture
        self.perception = Minds(a.perception, a.minds)
        self.goal = GoalMLP(3 * a.code, a.goal_hidden, a.goal_layers, schedule, minds=a.minds, map_cells=a.map_cells, reading=a.reading)
        match a.control:
            case "unet":
                if a.map_cells and a.reading == "pointwise":
                    self.path = WaypointUNet(a.minds, a.map_cells, a.future, 3, a.told, a.unet_width, a.unet_multipliers, schedule)
                else:
                    self.path = ControlUNet(STRIDE, 3, a.told, a.unet_width, a.unet_multipliers, schedule)
                along = ControlUNet(a.body_channels, TOLD, a.told, a.unet_width, a.unet_multipliers, schedule)
            case "concatenation":
                self.path = ConcatenationUNet(STRIDE, 3, a.told, a.unet_width, a.unet_multipliers, schedule)
                along = ConcatenationUNet(a.body_channels, TOLD * a.future, a.told, a.unet_width, a.unet_multipliers, schedule)
            case _:
                assert_never(a.control)
        if a.family == "one_stage":  # one network for path and body, which nothing steers
            along = FreeUNet(STRIDE + a.body_channels, Tail(a.told, EMBEDDING), a.unet_width, a.unet_multipliers, schedule)
        self.body = BodyDenoiser(along, a.body_channels, a.future, schedule)


def channels_from_bones(
    agent_from_bone: Float[np.ndarray, "*batch bone 4 4"], rest: Float[np.ndarray, "bone 4 4"]
) -> Float[np.ndarray, "*batch channel"]:
    """Return per bone the rotation vector of ``agent_from_bone rest^-1`` and the shift of its origin from rest."""
    turn = agent_from_bone[..., :3, :3] @ np.swapaxes(rest[..., :3, :3], -1, -2)
    shift = agent_from_bone[..., :3, 3] - rest[..., :3, 3]
    return np.concatenate([rigid.vector_from_rotation(turn), shift], axis=-1).reshape(*turn.shape[:-3], -1)


def bones_from_channels(
    channels: Float[np.ndarray, "*batch channel"], rest: Float[np.ndarray, "bone 4 4"]
) -> Float[np.ndarray, "*batch bone 4 4"]:
    """Undo `channels_from_bones`."""
    twist = channels.reshape(*channels.shape[:-1], len(rest), 6)
    return rigid.make(rigid.rotation_from_vector(twist[..., :3]) @ rest[..., :3, :3], rest[..., :3, 3] + twist[..., 3:])


def past_channels(
    ego_from_agent: Float[np.ndarray, "batch 8 4 4"], bones: Float[np.ndarray, "batch 8 channel"]
) -> Float[np.ndarray, "batch 8*channel"]:
    """Return per past frame: root position, root rotation (6), bones; oldest frame first."""
    root = np.concatenate([ego_from_agent[..., :3, 3], rigid.rotation_to_6d(ego_from_agent[..., :3, :3])], axis=-1)
    return np.concatenate([root, bones], axis=-1).reshape(len(root), -1).astype(np.float32)


def contract(architecture: Architecture, scaling: Scaling, schedule: Schedule, rest: Float[np.ndarray, "bone 4 4"]) -> dict:
    """Return the content of `behavior.json`: all that a sampler in another language must know."""
    bone = ["rotation_x", "rotation_y", "rotation_z", "shift_x", "shift_y", "shift_z"]
    root = ["right_x", "right_y", "right_z", "up_x", "up_y", "up_z"]
    return {
        "units": "metres, radians, seconds",
        "up": [0, 1, 0],
        "rate_hz": RATE_HZ,
        "past_frames": PAST,
        "future_frames": architecture.future,
        "architecture": asdict(architecture),
        "bones": [f"bone_{number:02d}" for number in range(architecture.bones)],
        "agent_from_bone_rest": np.asarray(rest, float).tolist(),
        "channels": {
            "observer_past": {"per_frame": ["x", "y", "z"], "order": "frame, channel; oldest first"},
            "past": {
                "per_frame": ["root_x", "root_y", "root_z", *root],
                "per_bone": bone,
                "order": "frame, (root, bones); oldest first",
            },
            "goal": ["x", "y", "z"],
            "path": ["root_of_velocity_x", "root_of_velocity_y", "root_of_velocity_z", "moves"],
            "body": {"root": root, "per_bone": bone},
            "keep": ["scene", "observer", "past"],
        },
        "grid": {"shape": list(GRID_SHAPE), "cell_m": GRID_CELL_M, "sampling": "nearest", "order": "channel, x, y, z"},
        "strides": {
            "numbers": STRIDE,
            "root_power": ROOT,
            "goal_power": GOAL_POWER,
            "breath": BREATH,
            "faint_m2": FAINT,
            "stays_m_s": STAYS_M_S,
            "reach_m": REACH_M,
            "reach": REACH,
        },
        "scaling": {name: np.asarray(value, float).tolist() for name, value in vars(scaling).items()},
        "schedule": {**asdict(schedule), "alpha_bar": schedule.alpha_bar.tolist()},
        "sampling": asdict(Sampling(method=schedule.method)),
    }


def load(folder: Path) -> tuple[Architecture, BehaviorNets, Scaling, Schedule, Float[np.ndarray, "bone 4 4"]]:
    """Read a trained model: its shape, networks, scaling, schedule, and the bones at rest."""
    document = json.loads((folder / "behavior.json").read_text())
    shape = document["architecture"]
    architecture = Architecture(**shape | {"unet_multipliers": tuple(shape["unet_multipliers"])})
    scaling = Scaling(**{name: np.asarray(value, np.float64) for name, value in document["scaling"].items()})
    schedule = Schedule(**{field.name: document["schedule"][field.name] for field in fields(Schedule)})
    nets = BehaviorNets(architecture, schedule)
    nets.load_state_dict(load_file(folder / "behavior.safetensors"))
    return architecture, nets, scaling, schedule, np.asarray(document["agent_from_bone_rest"])
