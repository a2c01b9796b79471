"""Animal sequences of DAVIS 2016 as recordings: pictures without depth, flow, true masks, joints of BADJA.

`animals` lists the sequences that a folder holds, `DavisSequence` opens one; `frames` and `flow` write its artifacts as
`extract_frames` and `estimate_flow` do.
"""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from benchmarks.behavior_builds import emptied
from pipeline.data import images, npz
from stages.estimate_flow import stage as flowing
from stages.estimate_flow.config import Config as FlowConfig

ANIMALS = frozenset(
    "bear blackswan camel cows dog dog-agility elephant flamingo goat horsejump-high horsejump-low libby "
    "mallard-fly mallard-water rhino".split()
)
"""Sequences of DAVIS 2016 whose annotated object is an animal (with its rider, if any)."""
RATE_HZ = 24.0
FULL_SIZE_PX = np.array([1920.0, 1080.0])
"""width and height of the pictures for which BADJA annotates joints"""
DEPTH_SIZE = (60, 107)
"""size of the empty depth pictures"""


@dataclass(frozen=True)
class Joints:
    """Annotated joints of one frame."""

    position_px: Float[np.ndarray, "joint 2"]
    """x, y"""
    visible: Bool[np.ndarray, "joint"]


@dataclass(frozen=True)
class DavisSequence:
    """One sequence."""

    name: str
    pictures: tuple[Path, ...]
    masks: tuple[Path, ...]
    joints: Path | None

    def mask(self, frame: int) -> Bool[np.ndarray, "height width"]:
        """Read the true mask of a frame."""
        return images.read_gray(self.masks[frame]) > 0

    def joints_by_frame(self) -> dict[int, Joints]:
        """Read the joints that BADJA annotates, by frame; stored as (row, column) at full resolution."""
        assert self.joints is not None, self.name
        height, width = self.mask(0).shape
        number_of = {path.stem: number for number, path in enumerate(self.pictures)}
        found = {}
        for entry in json.loads(self.joints.read_text()):
            stem = Path(entry["image_path"]).stem
            if stem in number_of:
                position = np.array(entry["joints"], float)[:, ::-1] * [width, height] / FULL_SIZE_PX
                found[number_of[stem]] = Joints(position, np.array(entry["visibility"], bool))
        return found


def animals(davis: Path) -> dict[str, DavisSequence]:
    """Return the animal sequences of a DAVIS folder that have pictures and masks."""
    found = {}
    for folder in sorted((davis / "JPEGImages" / "480p").glob("*")):
        pictures = tuple(sorted(folder.glob("*.jpg")))
        masks = tuple(davis / "Annotations" / "480p" / folder.name / f"{path.stem}.png" for path in pictures)
        if folder.name in ANIMALS and pictures and all(path.is_file() for path in masks):
            joints = davis / "joint_annotations" / f"{folder.name}.json"
            found[folder.name] = DavisSequence(
                folder.name, pictures, masks, joints if joints.is_file() else None
            )
    return found


def frames(sequence: DavisSequence, folder: Path) -> Path:
    """Write the pictures as the frames of a recording without depth, poses and intrinsics."""
    if (folder / "frames.npz").is_file():
        return folder
    emptied(folder)
    for name in ("color", "depth", "confidence"):
        (folder / name).mkdir()
    for number, picture in enumerate(sequence.pictures):
        shutil.copy(picture, folder / "color" / f"{number:06d}.jpg")
        images.write_depth(folder / "depth" / f"{number:06d}.exr", np.zeros(DEPTH_SIZE))
    count = len(sequence.pictures)
    eye = np.tile(np.eye(3), (count, 1, 1))
    npz.save(
        folder / "frames.npz",
        timestamp_s=np.arange(count) / RATE_HZ,
        intrinsics=eye,
        depth_intrinsics=eye,
        quality=np.ones(count, np.float32),
        gravity_known=np.array(False),
    )
    return folder


def flow(recording: Path, folder: Path) -> Path:
    """Run `estimate_flow` on frames; cached."""
    if not (folder / "qa.json").is_file():
        flowing.run(flowing.Inputs(recording), FlowConfig(), emptied(folder))
    return folder
