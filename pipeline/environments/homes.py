"""The animals of one build in several homes, each with recorded starts and scenes.

`open_homes` opens their own home or other builds' homes; `together` joins them, so that animals in different
homes plan in one batch.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Int

from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import BehaviorData
from pipeline.environments.other_home import ReconstructedHome, move_in


@dataclass(frozen=True)
class Habitat:
    """Recorded moments in which episodes start, and their scenes."""

    data: BehaviorData
    scenes: Scenes
    home_of_video: Int[np.ndarray, "video"]
    """Index of the home of each recording."""
    share_known: tuple[float, ...]
    """Per home, share (0..1) of its surface that looks like the animal's own home."""

    @property
    def home_of_window(self) -> Int[np.ndarray, "window"]:
        """Index of the home of each window."""
        return self.home_of_video[self.data.video]

    @classmethod
    def of_one_home(cls, data: BehaviorData, scenes: Scenes, share_known: float = 1.0) -> "Habitat":
        """Return one home as a habitat, by default the animal's own."""
        return cls(data, scenes, np.zeros(len(data.videos), int), (share_known,))


def open_homes(build: Path, animals: Mapping[str, Path], homes: Sequence[Path]) -> dict[str, Habitat]:
    """Put all ``animals`` of a ``build``, by their folders, into ``homes`` together, by default their own.

    Moments in other homes are those of the first animal. Raises the errors of
    `pipeline.environments.other_home` for unusable homes.
    """
    data = {name: BehaviorData.load(folder / "behavior_data") for name, folder in animals.items()}
    recorded: dict[str, tuple[ReconstructedHome, BehaviorData]] = {}
    habitats: dict[str, list[Habitat]] = {name: [] for name in animals}
    for home in homes or (build,):
        if home.resolve() == build.resolve():
            for name, folder in animals.items():
                scenes = Scenes.load(folder / "behavior_data", data[name].videos)
                habitats[name].append(Habitat.of_one_home(data[name], scenes))
            continue
        recorded = recorded or {
            name: (ReconstructedHome.of_build(folder), data[name]) for name, folder in animals.items()
        }
        for name, moved in move_in(recorded, ReconstructedHome.of_build(home)).items():
            habitats[name].append(Habitat.of_one_home(moved.data, moved.home.scenes(), moved.share_known))
    return {name: together(each) for name, each in habitats.items()}


def together(habitats: Sequence[Habitat]) -> Habitat:
    """Join habitats of one animal; recordings are named `<number of the home>/<recording>`."""
    if len(habitats) == 1:
        return habitats[0]
    tracks, videos, of_video, home_of_video, windows = {}, [], [], [], []
    volumes = 0
    for number, habitat in enumerate(habitats):
        data, scenes = habitat.data, habitat.scenes
        names = [f"{number}/{video}" for video in data.videos]
        tracks |= {name: data.trajectories[video] for name, video in zip(names, data.videos, strict=True)}
        windows.append(data.video + len(videos))
        videos += names
        of_video.append(volumes + scenes.number(np.arange(len(names)), len(names)))
        home_of_video.append(np.full(len(names), number))
        volumes += len(scenes.volumes)
    parts = [habitat.data for habitat in habitats]
    data = replace(
        parts[0],
        trajectories=tracks,
        videos=tuple(videos),
        video=np.concatenate(windows),
        start=np.concatenate([part.start for part in parts]),
        tested=np.concatenate([part.tested for part in parts]),
    )
    every = [habitat.scenes for habitat in habitats]
    joined = Scenes(
        tuple(volume for scenes in every for volume in scenes.volumes),
        tuple(allowed for scenes in every for allowed in scenes.allowed),
        np.concatenate(of_video),
        tuple(support for scenes in every for support in scenes.supports or (None,) * len(scenes.volumes)),
    )
    shares = tuple(share for habitat in habitats for share in habitat.share_known)
    return Habitat(data, joined, np.concatenate(home_of_video), shares)
