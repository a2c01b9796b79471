"""Animals that live together in a home: which there are, and whom they perceive."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.baselines.samplers import load_playable
from pipeline.behavior.config import Ego
from pipeline.behavior.planning import Sampler
from pipeline.behavior.simulator import AnimalBatch
from pipeline.behavior.trajectories import as_companions
from pipeline.core.config import refuse_unknown
from pipeline.core.errors import InputError
from pipeline.environments.config import EnvironmentConfig
from pipeline.environments.homes import Habitat, open_homes
from pipeline.workflow import artifact

ALONE = "animal"
"""Name of the animal of a build of one."""
NEEDED = ("behavior", "behavior_data")
"""Artifacts of an animal that lives."""


@dataclass(frozen=True)
class Resident:
    """An animal with networks of its own, and where it lives."""

    sampler: Sampler
    habitat: Habitat
    ego: Ego

    @classmethod
    def load(cls, build: Path, *, homes: Sequence[Path] = (), device: str = "cpu") -> "Resident":
        """Open the animal of a folder alone, as `load_all` does."""
        return cls.load_all(build, {ALONE: build}, homes=homes, device=device)[ALONE]

    @classmethod
    def load_all(
        cls, build: Path, animals: Mapping[str, Path], *, homes: Sequence[Path], device: str
    ) -> "dict[str, Resident]":
        """Open animals of a build by their folders, together in ``homes`` where there are any: builds, of
        which one may be their own. Moments in other homes are those of the first animal.

        Raises ART-003 where one lacks the model, ART-007 where another version wrote it, SIM-006 for models
        without goals, and what `pipeline.environments.other_home` raises for homes that cannot be used.
        """
        one_of_several = f"give one of its animals: {build}/animals/<name>"
        several = (build / "animals").is_dir() and build in animals.values()
        for folder in animals.values():
            remedy = one_of_several if several else "make it: make <agent>.behavior"
            artifact.require(folder, *NEEDED, remedy=remedy)
        habitats, residents = open_homes(build, animals, homes), {}
        for name, folder in animals.items():
            sampler, ego = load_playable(folder / "behavior", device)
            residents[name] = cls(sampler, habitats[name], ego)
        return residents

    def batch(self, config: EnvironmentConfig) -> AnimalBatch:
        """Return a batch to simulate it in; it has not begun."""
        how, scenes = {"sampling": config.sampling, "chaining": config.chaining}, self.habitat.scenes
        return AnimalBatch(self.sampler, scenes, self.habitat.data.agent_from_bone_rest, self.ego, **how)


def folders_of(build: Path, animal: str | None) -> dict[str, Path | None]:
    """Return the folders of all animals of a build by name, that of a build of one named `ALONE`; None for
    animals without a model, which are absent.

    Raises REC-001 for an ``animal`` that is not among them, ART-003 where it has no model, or where none is
    asked for and one of the home has none.
    """
    home = build / "animals"
    found = sorted(path for path in home.iterdir() if path.is_dir()) if home.is_dir() else []
    every = {path.name: path for path in found} or {ALONE: build}
    asked = every if animal is None else {animal: None}
    refuse_unknown(asked, every, where=f"environment: animal of {build}", kind="animal")
    living = {name: path for name, path in every.items() if all((path / each).is_dir() for each in NEEDED)}
    if missing := [name for name in asked if found and name not in living]:
        remedy = "make <agent>.behavior, from longer recordings of it"
        remedy += f"; or meet another one: animal={next(iter(living))!r}" if living else ""
        raise InputError("ART-003", f"{missing[0]} has no behavior model", str(build), remedy)
    return {name: living.get(name) for name in every} if found else {ALONE: build}


def companions_of(
    name: str, past_world: Mapping[str, Float[np.ndarray, "*life past_frame 3"]]
) -> Float[np.ndarray, "*life companion past_frame 4"] | None:
    """Return all animals but one as companions, from their past positions (meters); None if it is alone."""
    others = [past_world[other] for other in past_world if other != name]
    return as_companions(np.stack(others, axis=-3)) if others else None
