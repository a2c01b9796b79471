"""The behavior model: its architecture, channels, networks and files.

`Architecture` fixes shapes, `BehaviorNets` holds the networks, `contract` and `load` write and read
`behavior.json`; other functions define the channels of body and past. `pipeline.behavior.planning` samples.
"""

import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import assert_never

import numpy as np
import torch
from jaxtyping import Float
from safetensors.torch import load_file
from torch import nn

from pipeline.behavior import body_denoiser, config, denoisers, path_encoding
from pipeline.behavior.body_denoiser import CONTROL_CHANNELS, ROOT_CHANNELS
from pipeline.behavior.diffusion import SOLVER_STEPS, STANDARD, Schedule
from pipeline.behavior.encoders import ATTENDED_CHANNELS, HEADS
from pipeline.behavior.goal_denoiser import GoalMLP
from pipeline.behavior.path_encoding import path_from_velocity_channels, warped_path, with_powered_length
from pipeline.behavior.perception import (
    GRID_CELL_M,
    GRID_SHAPE,
    MAP_KEY_CHANNELS,
    VELOCITY_CHANNELS,
    PerceptionConfig,
    PerceptionEnsemble,
)
from pipeline.behavior.trajectories import ABSENT_M, FUTURE, KINDS, PAST, RATE_HZ, anticipated_frames
from pipeline.core.errors import other_versions_refused
from pipeline.geometry import rigid


@dataclass(frozen=True)
class Architecture:
    """All that determines the shapes of the networks and the meaning of their channels."""

    bones: int
    ego: config.Ego = "yaw"
    scene: config.SceneEncoder = "pillars"
    observed_past: config.ObservedPast = "positions"
    scene_width: int = 32
    scene_block: int = 4
    scene_channels: int = 16
    hidden: int = 128
    code: int = 64
    observer_radius_m: float = 4.0
    companions: bool = False
    """whether it was recorded with companions; then goals read the positions of others"""
    ablated_input: config.AblatedInput = "nothing"
    body_components: int = 0
    """principal components of bones that the UNet of bodies corrects (`GaussianPrior`); 0: it
    denoises all channels, without a fitted prior"""
    unet_width: int = 16
    unet_multipliers: tuple[int, ...] = (1, 2, 4)
    goal_hidden: int = 128
    goal_layers: int = 6
    family: config.Family = "diffusion"
    control: config.Control = "unet"
    past: int = PAST
    future: int = FUTURE
    rate_hz: float = RATE_HZ
    ensemble_size: int = 3
    guided: config.Guided = "observer"
    """conditions that guidance amplifies: all if trained with `joint_dropout`"""
    encoding: config.Encoding = "strides"
    """what is diffused; with positions, bodies have no prior (`body_components` 0)"""
    corrections: bool = True
    """whether plans are corrected after the networks (`PlanSamplingConfig.networks_only`)"""

    @property
    def body_channels(self) -> int:
        """Channels of a body: root rotation and 6 per bone."""
        return ROOT_CHANNELS + 6 * self.bones

    @property
    def scene_stride(self) -> int:
        """Cells of the ego grid that are averaged along each axis before encoding."""
        match self.scene:
            case "pillars":
                return self.scene_block
            case "volume":
                return 1
            case "none":
                return GRID_SHAPE[1]
            case _:
                assert_never(self.scene)

    @property
    def map_cells(self) -> int:
        """Cells along each side of the map that goals read; 0 without a map."""
        return GRID_SHAPE[0] // self.scene_block if self.scene == "pillars" else 0

    @property
    def attended_channels(self) -> int:
        """Channels of attended positions of others, per member."""
        return ATTENDED_CHANNELS * HEADS if self.companions and self.observed_past == "positions" else 0

    @property
    def anticipated(self) -> list[int]:
        """Frames for which it may know where the observer will be, if it perceives positions."""
        return anticipated_frames(self.future).tolist() if self.observed_past == "positions" else []

    @property
    def code_length(self) -> int:
        """Length of the perception codes of all members, velocity and posture together."""
        return (
            (3 * self.code + self.attended_channels) * self.ensemble_size
            + VELOCITY_CHANNELS
            + self.body_channels
        )

    @property
    def condition_length(self) -> int:
        """Length of the whole condition: maps of all members, then what conditions path and body."""
        return 2 * MAP_KEY_CHANNELS * self.map_cells**2 * self.ensemble_size + self.code_length

    @property
    def perception(self) -> PerceptionConfig:
        """Return the sizes of the perception network."""
        names = {field.name for field in fields(PerceptionConfig)} & vars(self).keys()
        shared = {name: getattr(self, name) for name in names}
        return PerceptionConfig(**shared, past_frames=self.past, past_channels=9 + 6 * self.bones)


@dataclass(frozen=True)
class Scaling:
    """Conversion between ego-frame meters and radians and the unit-variance channels that are diffused."""

    goal_std: Float[np.ndarray, "3"]
    velocity_std: Float[np.ndarray, "*each 4"]
    """of strides (`pipeline.behavior.path_encoding`), shared by all frames or for each frame"""
    path_std: Float[np.ndarray, "3 frame"]
    """of positions, as they control the body, meters"""
    body_mean: Float[np.ndarray, "channel"]
    body_std: Float[np.ndarray, "channel"]
    rate_hz: float = RATE_HZ
    """frames per second"""
    encoding: config.Encoding = "strides"
    """of goals and paths"""

    def scaled_goal(self, goal: Float[np.ndarray, "plan 3"]) -> Float[np.ndarray, "plan 3"]:
        """Convert goals in meters to the units of diffusion and of the control of paths."""
        power = path_encoding.GOAL_POWER_OF[self.encoding]
        return (with_powered_length(goal, power) / self.goal_std).astype(np.float32)

    def goal(self, scaled: Float[np.ndarray, "plan 3"]) -> Float[np.ndarray, "plan 3"]:
        """Undo `scaled_goal`."""
        return with_powered_length(scaled * self.goal_std, 1 / path_encoding.GOAL_POWER_OF[self.encoding])

    def path(
        self, scaled: Float[np.ndarray, "plan channel frame"], start: Float[np.ndarray, "plan 3"]
    ) -> Float[np.ndarray, "plan frame 3"]:
        """Integrate scaled strides from ``start`` to paths in meters, or convert scaled positions."""
        if self.encoding == "positions":
            return self.path_of_scaled(scaled)
        return path_from_velocity_channels(np.swapaxes(scaled, 1, 2) * self.velocity_std, start, self.rate_hz)

    def warped_path(
        self,
        scaled: Float[np.ndarray, "plan channel frame"],
        start: Float[np.ndarray, "plan 3"],
        path: Float[np.ndarray, "plan frame 3"],
    ) -> Float[np.ndarray, "plan channel frame"]:
        """Return scaled strides or positions that follow other paths in meters."""
        if self.encoding == "positions":
            return self.scaled_path(path)
        strides = np.swapaxes(scaled, 1, 2) * self.velocity_std
        return np.swapaxes(warped_path(strides, start, path, self.rate_hz) / self.velocity_std, 1, 2)

    def scaled_path(self, path: Float[np.ndarray, "plan frame 3"]) -> Float[np.ndarray, "plan 3 frame"]:
        """Convert paths in meters to the control of bodies."""
        return (np.swapaxes(path, 1, 2) / self.path_std).astype(np.float32)

    def path_of_scaled(self, scaled: Float[np.ndarray, "plan 3 frame"]) -> Float[np.ndarray, "plan frame 3"]:
        """Undo `scaled_path`."""
        return np.swapaxes(scaled * self.path_std, 1, 2)


class BehaviorNets(nn.Module):
    """Perception and the three denoisers."""

    def __init__(self, architecture: Architecture, schedule: Schedule = STANDARD):
        super().__init__()
        a = architecture
        self.perception = PerceptionEnsemble(a.perception, a.ensemble_size)
        self.goal = GoalMLP(
            3 * a.code,
            a.goal_hidden,
            a.goal_layers,
            schedule,
            ensemble_size=a.ensemble_size,
            map_cells=a.map_cells,
            attended_channels=a.attended_channels,
            length_power=path_encoding.GOAL_POWER_OF[a.encoding],
        )
        positions = a.encoding == "positions"
        assert not (positions and a.body_components), "bodies beside positions have no prior"
        bones = 6 * a.bones
        gates = min(a.body_components, bones)
        components = gates or bones
        corrected = ROOT_CHANNELS + components
        widths = tuple(a.unet_width * multiplier for multiplier in a.unet_multipliers)
        sizes = (a.code_length, widths, schedule)
        along, lead = 3 if positions else CONTROL_CHANNELS, path_encoding.PATH_CHANNELS_OF[a.encoding]
        match a.control:
            case "unet":
                self.path = denoisers.ControlUNet(lead, 3, *sizes)
                body = denoisers.ControlUNet(corrected, along, *sizes, outputs=corrected + gates)
            case "concatenation":
                self.path = denoisers.ConcatenationUNet(lead, 3, *sizes)
                along *= a.future
                body = denoisers.ConcatenationUNet(corrected, along, *sizes, outputs=corrected + gates)
            case _:
                assert_never(a.control)
        if a.family == "one_stage":  # one network for path and body, without control
            read = denoisers.TrailingLinear(a.code_length, denoisers.EMBEDDING)
            corrected += lead
            body = denoisers.UncontrolledUNet(corrected, read, *sizes[1:], outputs=corrected + gates)
            denoiser, leading = body_denoiser.OneStageDenoiser, lead + ROOT_CHANNELS
        else:
            denoiser, leading = body_denoiser.BodyDenoiser, ROOT_CHANNELS
        prior = body_denoiser.GaussianPrior(leading, bones, components, a.future, schedule)
        relative = denoiser(body, prior, a.body_channels, a.future, schedule, a.rate_hz)
        self.body: body_denoiser.BodyDenoiser | denoisers.SequenceDenoiser = body if positions else relative


def channels_from_bones(
    agent_from_bone: Float[np.ndarray, "*batch bone 4 4"], rest: Float[np.ndarray, "bone 4 4"]
) -> Float[np.ndarray, "*batch channel"]:
    """Return per bone the rotation vector of ``agent_from_bone rest^-1`` and the shift of its origin."""
    turn = agent_from_bone[..., :3, :3] @ np.swapaxes(rest[..., :3, :3], -1, -2)
    shift = agent_from_bone[..., :3, 3] - rest[..., :3, 3]
    return np.concatenate([rigid.vector_from_rotation(turn), shift], axis=-1).reshape(*turn.shape[:-3], -1)


def bones_from_channels(
    channels: Float[np.ndarray, "*batch channel"], rest: Float[np.ndarray, "bone 4 4"]
) -> Float[np.ndarray, "*batch bone 4 4"]:
    """Undo `channels_from_bones`."""
    twist = channels.reshape(*channels.shape[:-1], len(rest), 6)
    turn = rigid.rotation_from_vector(twist[..., :3])
    return rigid.make(turn @ rest[..., :3, :3], rest[..., :3, 3] + twist[..., 3:])


def other_channels(
    ego_from_observer: Float[np.ndarray, "batch past_frame 4 4"],
    companions_ego: Float[np.ndarray, "batch companion past_frame 4"] | None = None,
) -> Float[np.ndarray, "batch other past_frame 10"]:
    """Return position, 6D rotation (0 for companions) and kind of others, oldest frame first (Eq. 12)."""
    position, rotation = ego_from_observer[..., :3, 3], ego_from_observer[..., :3, :3]
    kind = np.zeros((*position.shape[:2], 1))
    others = np.concatenate([position, rigid.rotation_to_6d(rotation), kind], axis=-1)[:, None]
    if companions_ego is not None:
        unknown = np.zeros((*companions_ego.shape[:3], 6))
        parts = [companions_ego[..., :3], unknown, companions_ego[..., 3:]]
        others = np.concatenate([others, np.concatenate(parts, axis=-1)], axis=1)
    return others.astype(np.float32)


def past_channels(
    ego_from_agent: Float[np.ndarray, "batch past_frame 4 4"],
    bones: Float[np.ndarray, "batch past_frame channel"],
) -> Float[np.ndarray, "batch past"]:
    """Return per past frame: root position, root rotation (6), bones; oldest frame first."""
    rotation = rigid.rotation_to_6d(ego_from_agent[..., :3, :3])
    return (
        np.concatenate([ego_from_agent[..., :3, 3], rotation, bones], axis=-1)
        .reshape(len(bones), -1)
        .astype(np.float32)
    )


def contract(
    architecture: Architecture, scaling: Scaling, schedule: Schedule, rest: Float[np.ndarray, "bone 4 4"]
) -> dict:
    """Return the content of `behavior.json`, for samplers in other languages."""
    bone = ["rotation_x", "rotation_y", "rotation_z", "shift_x", "shift_y", "shift_z"]
    root = ["right_x", "right_y", "right_z", "up_x", "up_y", "up_z"]
    place, stride = ["x", "y", "z"], [*(f"root_of_velocity_{axis}" for axis in "xyz"), "moves"]
    sampling = config.PlanSamplingConfig(schedule.method, schedule.sampled_steps, sequence_steps=SOLVER_STEPS)
    sampling = sampling if architecture.corrections else sampling.networks_only()
    scales = {name: value for name, value in vars(scaling).items() if name != "encoding"}
    return {
        "units": "metres, radians, seconds",
        "up": [0, 1, 0],
        "rate_hz": architecture.rate_hz,
        "past_frames": architecture.past,
        "future_frames": architecture.future,
        "architecture": asdict(architecture),
        "bones": [f"bone_{number:02d}" for number in range(architecture.bones)],
        "agent_from_bone_rest": np.asarray(rest, float).tolist(),
        "channels": {
            "others": {
                "per_frame": ["x", "y", "z", *root, "kind"],
                "kinds": list(KINDS),
                "anticipated_frames": architecture.anticipated,
                "absent_m": ABSENT_M,
                "order": "other, frame, channel; the observer first; oldest frame first, then anticipated",
            },
            "past": {
                "per_frame": ["root_x", "root_y", "root_z", *root],
                "per_bone": bone,
                "order": "frame, (root, bones); oldest first",
            },
            "goal": place,
            "path": place if architecture.encoding == "positions" else stride,
            "body": {"root": root, "per_bone": bone},
            "keep": ["scene", "observer", "past"],
        },
        "grid": {
            "shape": list(GRID_SHAPE),
            "cell_m": GRID_CELL_M,
            "sampling": "nearest",
            "order": "channel, x, y, z",
        },
        "path_encoding": {
            "channels": path_encoding.PATH_CHANNELS_OF[architecture.encoding],
            "velocity_power": path_encoding.VELOCITY_POWER,
            "goal_length_power": path_encoding.GOAL_POWER_OF[architecture.encoding],
            "rest_damping": path_encoding.REST_DAMPING,
            "min_squared_m2": path_encoding.MIN_SQUARED_M2,
            "rest_speed_m_s": path_encoding.REST_SPEED_M_S,
            "goal_tolerance_m": path_encoding.GOAL_TOLERANCE_M,
            "goal_tolerance_share": path_encoding.GOAL_TOLERANCE_SHARE,
        },
        "scaling": {name: np.asarray(value, float).tolist() for name, value in scales.items()},
        "schedule": {**asdict(schedule), "alpha_bar": schedule.alpha_bar.tolist()},
        "sampling": asdict(sampling),
    }


def load(folder: Path) -> tuple[Architecture, BehaviorNets, Scaling, Schedule, Float[np.ndarray, "bone 4 4"]]:
    """Read a trained model: architecture, networks, scaling, schedule, and the bones at rest.

    Raises InputError ART-007 for files or a contract of another version.
    """
    refused = other_versions_refused("behavior model", str(folder))
    with refused, torch.random.fork_rng(devices=[]):  # untrained weights are drawn
        document = json.loads((folder / "behavior.json").read_text())
        shape = document["architecture"]
        architecture = Architecture(**shape | {"unet_multipliers": tuple(shape["unet_multipliers"])})
        scales = {name: value for name, value in document["scaling"].items() if name != "rate_hz"}
        arrays = {name: np.asarray(value, np.float64) for name, value in scales.items()}
        scaling = Scaling(**arrays, rate_hz=float(document["rate_hz"]), encoding=architecture.encoding)
        schedule = Schedule(**{field.name: document["schedule"][field.name] for field in fields(Schedule)})
        rest = np.asarray(document["agent_from_bone_rest"], np.float64)
        expected = json.loads(json.dumps(contract(architecture, scaling, schedule, rest)))
        other = sorted(
            name
            for name in (expected.keys() | document.keys()) - {"sampling"}  # the caller decides
            if expected.get(name) != document.get(name)
        )
        if other:
            raise ValueError(f"behavior.json says otherwise about {', '.join(other)}")
        nets = BehaviorNets(architecture, schedule)
        nets.load_state_dict(load_file(folder / "behavior.safetensors"))
    return architecture, nets, scaling, schedule, rest
