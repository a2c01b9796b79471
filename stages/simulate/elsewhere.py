"""Files and summary of a take in the home of another build: how much of it the animal knows."""

import json
from pathlib import Path

import numpy as np

from pipeline.data import npz
from pipeline.environments.other_home import MovedAnimal
from stages.simulate.rollout import Take


def write_home(folder: Path, take: Take, moved: MovedAnimal, home: str) -> None:
    """Write `volume.npz`, the home as the animal perceives it, and `home.json` beside a take."""
    volume = {**vars(moved.home.volume), "allowed": moved.home.marks, "stands_m": moved.home.stands_m}
    npz.save(folder / "volume.npz", compress=True, **volume)
    goals, in_solid = _goals(take, moved)
    about = {"home": home, "share_known": moved.share_known, "goals": goals, "goals_in_solid": in_solid}
    (folder / "home.json").write_text(json.dumps(about, indent=1) + "\n")


def summary(take: Take, moved: MovedAnimal) -> str:
    """Return how much of the home looks known, and how much of the plans is not allowed there."""
    goals, in_solid = _goals(take, moved)
    known = f"{moved.share_known:.0%} of the surfaces look like the known home's; "
    known += f"{in_solid:.1%} of {goals} goals in something solid, "
    return known + f"{float(take.blocked.mean()):.1%} of the plans' frames outside the allowed space"


def _goals(take: Take, moved: MovedAnimal) -> tuple[int, float]:
    """Return the number of goals, and the share of them in something solid."""
    goals = np.unique(take.goal_world, axis=0)
    return len(goals), float(moved.home.scenes().inside_solid(goals[:, None], None).mean())
