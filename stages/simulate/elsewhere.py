"""Files and summary of a take in the home of another build: how much of it the animal knows."""

import json
from pathlib import Path

import numpy as np

from pipeline.data import npz
from pipeline.environments.other_home import MovedAnimal
from stages.simulate.rollout import Take


def metrics(take: Take, moved: MovedAnimal, home: str) -> dict[str, str | int | float]:
    """Return the content of `home.json`: the home, the share of it that looks known, and goals in solids."""
    goals = np.unique(take.goal_world, axis=0)
    in_solid = float(moved.home.scenes().inside_solid(goals[:, None], None).mean())
    return {"home": home, "share_known": moved.share_known, "goals": len(goals), "goals_in_solid": in_solid}


def summary(take: Take, about: dict[str, str | int | float]) -> str:
    """Return how much of the home looks known, and how much of the plans is not allowed there."""
    known = f"{about['share_known']:.0%} of the surfaces look like the known home's; "
    known += f"{about['goals_in_solid']:.1%} of {about['goals']} goals in something solid, "
    return known + f"{float(take.blocked.mean()):.1%} of the plans' frames outside the allowed space"


def write_home(folder: Path, moved: MovedAnimal, about: dict[str, str | int | float]) -> None:
    """Write `volume.npz`, the home as the animal perceives it, and `home.json` beside a take."""
    volume = {**vars(moved.home.volume), "allowed": moved.home.marks, "stands_m": moved.home.stands_m}
    npz.save(folder / "volume.npz", compress=True, **volume)
    (folder / "home.json").write_text(json.dumps(about, indent=1) + "\n")
