"""The stage: reconstructed motion, or tables of motion -> trajectories, windows and scenes."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from pipeline.behavior.trajectories import TRAIN
from pipeline.core import progress
from pipeline.core.errors import InputError
from pipeline.core.videos import Video
from pipeline.data import qa
from stages.slice_behavior import pictures, reading
from stages.slice_behavior.config import Config
from stages.slice_behavior.gridding import trajectory_from_motion
from stages.slice_behavior.windows import slice_windows, write_volumes

MIN_PAST = 3
"""Minimum number of past frames, which give posture and velocity."""


@dataclass(frozen=True)
class Inputs:
    """What the stage reads: a reconstruction or trajectories."""

    reconstruction: Path | None = None
    """Motion of all sessions in one scene."""
    trajectories: Mapping[str, Path] | None = None
    """Tables of motion, a folder per recording."""
    companions: Mapping[str, Path] | None = None
    """The artifact `reconstruction` of each other animal of the home, by its name."""
    masks: Mapping[str, Path] | None = None
    """Masks of the sessions, with the tracks of people who walk through them."""


def run(inputs: Inputs, config: Config, out: Path, *, videos: tuple[Video, ...] = ()) -> None:
    """Slice all sessions. Raises ART-004 without recordings, BEH-001 without a training window."""
    sessions = {video.id: video for video in videos if video.role == "session"}
    if not sessions:
        remedy = "give --videos build/<agent>/plan/videos.json"
        raise InputError("ART-004", "which recordings?", "slice_behavior", remedy)
    if inputs.trajectories is not None:
        source = reading.read_tables(inputs.trajectories)
    elif inputs.reconstruction is not None:
        source = reading.read_reconstruction(
            inputs.reconstruction,
            list(sessions),
            inputs.companions or {},
            config.min_confidence,
            inputs.masks or {},
        )
    else:
        raise InputError("ART-003", "no motion was given", "slice_behavior", "give --reconstruction")
    gaps = asdict(config)
    stride, past_s, _ = gaps.pop("stride"), gaps.pop("past_s"), gaps.pop("others")
    past = max(round(past_s * config.rate_hz), MIN_PAST)
    trajectories = {id: trajectory_from_motion(motion, **gaps) for id, motion in source.motions.items()}
    test = frozenset(id for id in trajectories if sessions[id].split == "test")
    data = slice_windows(
        trajectories, test, source.agent_from_bone_rest, stride=stride, past=past, rate_hz=config.rate_hz
    )
    training = len(data.indices(TRAIN))
    if not training:
        remedy = "record longer sessions in which the animal stays in view, lower min_confidence, "
        remedy += "or raise max_gap_s where rows are further apart"
        what = f"no {(data.past + data.future) / data.rate_hz:.1f} s of uninterrupted motion to learn from"
        raise InputError("BEH-001", what, source.where, remedy)
    progress.log(f"{training} training windows, {len(data.start) - training} test windows")
    data.save(out)
    write_volumes(out, source.volumes, data.training, tuple(source.motions), config.rate_hz)
    qa.write(
        out,
        good="hundreds of windows, an animal that covers the room, and an observer at many distances",
        bad="long invalid stretches, or an animal that never moves",
        checks=pictures.checks(data),
        pictures=pictures.pictures(data, source.volumes[0], test),
    )
