"""The rows of the table: location of their data and the functions that measure them."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from benchmarks.real import captured_dog, davis, flow, masks, rooms, walkers
from benchmarks.real.table import Row


@dataclass(frozen=True)
class RowKind:
    """One row of the table."""

    layout: str
    """expected layout of the folder, for the message that a row is skipped"""
    source: str
    """publication of the data"""
    find: Callable[[Path], Path | None]
    """from the folder to the data of the row; None if incomplete"""
    measure: Callable[[Path, Path, int], Row]
    """from (data of the row, output folder, number of seeds) to the row"""


def first(pattern: str) -> Callable[[Path], Path | None]:
    """Return a function that finds the first matching path."""
    return lambda data: next(iter(sorted(data.glob(pattern))), None)


def crowds_in(data: Path) -> Path | None:
    """Return the folder of the SGAN splits if it has all scenes."""
    folder = data / "eth_ucy"
    parts = [folder / scene / part for scene in walkers.SCENES for part in ("train", "test")]
    return folder if all(any(part.glob("*.txt")) for part in parts) else None


def animals_in(data: Path) -> Path | None:
    """Return the folder of DAVIS if it has an animal sequence."""
    folder = data / "davis"
    return folder if davis.animals(folder) else None


def joints_in(data: Path) -> Path | None:
    """Return the folder of DAVIS if it has an animal sequence with annotated joints."""
    folder = data / "davis"
    return folder if any(sequence.joints for sequence in davis.animals(folder).values()) else None


def rooms_in(data: Path) -> Path | None:
    """Return the first folder of frames with poses."""
    return next((path for path in sorted(data.glob("7scenes*")) if rooms.numbers(path)), None)


DAVIS = "davis/JPEGImages/480p/<sequence>/*.jpg and davis/Annotations/480p/<sequence>/*.png"
ROWS = {
    "walkers": RowKind(
        "eth_ucy/{eth,hotel,univ,zara1,zara2}/{train,test}/*.txt (rows: frame person x y, tab-separated)",
        "the data sets that the code of SGAN (Gupta et al. 2018) downloads",
        crowds_in,
        lambda data, out, seeds: walkers.row(data, out, seeds=seeds),
    ),
    "captured_dog": RowKind(
        "dog_mocap/*.npz (one array [frame 27 3] per clip, meters, +y up, 60 Hz)",
        "the dog of AI4Animation (CC BY-NC 4.0) as joint positions",
        first("dog_mocap/*.npz"),
        lambda data, out, seeds: captured_dog.row(data, out, seeds=seeds),
    ),
    "flow": RowKind(
        f"{DAVIS}, and davis/joint_annotations/<sequence>.json",
        "DAVIS 2016 (480p) and BADJA",
        joints_in,
        lambda data, out, seeds: flow.row(data, out),
    ),
    "masks": RowKind(DAVIS, "DAVIS 2016 (480p)", animals_in, lambda data, out, seeds: masks.row(data, out)),
    "rooms": RowKind(
        "7scenes*/frame-*.{color.jpg or color.png,depth.png,pose.txt} and 7scenes*/camera-intrinsics.txt",
        "7-Scenes (RGB-D Dataset 7-Scenes, research use): one walk of one scene",
        rooms_in,
        lambda data, out, seeds: rooms.row(data, out),
    ),
}
