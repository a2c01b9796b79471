"""Sources of motion, split into training and held-out motion."""

from pathlib import Path

import numpy as np

from pipeline.behavior.trajectories import BehaviorData
from pipeline.core.errors import InputError
from pipeline.data import npz, ply
from pipeline.longterm.examples import DatasetSplit, MotionDataset, reconstructed_split
from pipeline.longterm.short_motions import STEPS, resample_motion
from pipeline.longterm.smplx_bodies import motion_from_parameters, smplx_body
from pipeline.longterm.surroundings import MotionScene
from stages.train_longterm import prox

PARAMETERS = ("transl", "global_orient", "body_pose")
NO_MOTION = "no two seconds of uninterrupted motion to learn from"
STUDY_REACH_M = 1.5
"""heights of the synthetic study's scene that are used, above and below where bodies have been"""


def recorded(reconstruction: Path, behavior_data: Path) -> DatasetSplit:
    """Read reconstructed sessions; behavior test videos are held out. Raises LTM-001 without motion."""
    split = reconstructed_split(reconstruction, BehaviorData.load(behavior_data))
    if not split.train.stretches:
        remedy = "record longer sessions in which the animal stays in view"
        raise InputError("LTM-001", NO_MOTION, str(behavior_data), remedy)
    return split


def people(model: Path, folder: Path) -> DatasetSplit:
    """Read recorded SMPL-X motion: `scene.ply` and `*.npz` of one person; the last file by name is held out.

    Each file holds `timestamp_s`, `transl`, `global_orient`, `body_pose` (rotation vectors, world +y up,
    meters) and `betas`, optionally `left_hand_pose` and `right_hand_pose` (45 values or PCA coefficients). A
    folder in PROX's layout is read by `prox`. Raises InputError LTM-001 without motion, LTM-003 and LTM-004
    without SMPL-X, LTM-005 for damaged PROX data.
    """
    if (folder / prox.FITS).is_dir():
        return _in_scans(model, folder)
    files = sorted(folder.glob("*.npz"))
    if not files:
        raise InputError(
            "LTM-001", "no SMPL-X motion to learn from", str(folder), "put *.npz and scene.ply there"
        )
    loaded = [npz.load(file, ("timestamp_s", *PARAMETERS, "betas")) for file in files]
    person = smplx_body(model, loaded[0]["betas"])
    fitted = [
        motion_from_parameters(person, *(each[name] for name in PARAMETERS), hands=_hands(each))
        for each in loaded
    ]
    motions = tuple(map(resample_motion, (each["timestamp_s"] for each in loaded), fitted))
    last = max(len(motions) - 1, 1)
    if max(map(len, motions[:last])) <= STEPS:
        raise InputError("LTM-001", NO_MOTION, str(folder), "give recordings of more than two seconds")
    roots = np.concatenate([motion.world_from_agent[:, :3, 3] for motion in motions])
    scene = MotionScene.for_motion(ply.read_ply(folder / "scene.ply"), roots, reach_m=STUDY_REACH_M)
    dataset = MotionDataset(person.body, motions, (0,) * len(motions), (scene,))
    return DatasetSplit.of(dataset, ["train"] * last + ["test"] * (len(motions) - last))


def _hands(table: dict[str, np.ndarray]) -> np.ndarray | None:
    both = [table[name] for name in ("left_hand_pose", "right_hand_pose") if name in table]
    return np.stack(both, axis=1) if len(both) == 2 else None


def _in_scans(model: Path, folder: Path) -> DatasetSplit:
    """Read PROX; the last recording is held out."""
    person, recordings, scenes = prox.read(model, folder)
    names = list(scenes)
    stretches = [(motion, names.index(each.scene)) for each in recordings for motion in each.motions]
    if not stretches:
        remedy = "give recordings with two seconds of fits without a gap"
        raise InputError("LTM-001", NO_MOTION, str(folder), remedy)
    motions, places = zip(*stretches, strict=True)
    dataset = MotionDataset(person.body, motions, places, tuple(scenes.values()))
    last = sum(len(each.motions) for each in recordings[:-1]) or len(motions)
    return DatasetSplit.of(dataset, ["train"] * last + ["test"] * (len(motions) - last))
