"""Sub-goals as a user writes them: a TOML file of `[[subgoal]]` tables.

[[subgoal]]
position = [1.2, 0.8]       # x, z on the floor, or x, y, z of the body's center (on furniture); meters, world
heading_deg = 90             # optional: about +y, 0 looks along +z, 90 along +x
time_s = 12.0                # optional: when to be there; not before the animal can be

A place on the floor without room to turn, by a wall or inside of furniture, or without a path to it, is moved
to the nearest that has both; `take.json` holds where to.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.core import config as configuration
from pipeline.core.errors import InputError
from pipeline.longterm.subgoals import Subgoal

LONGEST_S = 3600.0
"""Latest time of a sub-goal, seconds."""


@dataclass(frozen=True)
class SubgoalEntry:
    """One `[[subgoal]]`."""

    position: tuple[float, ...]
    """x and z on the floor, or x, y, z of the body's center; meters, world."""
    heading_deg: float | None = None
    """Where the head points: about +y, 0 along +z, 90 along +x; None: as it comes."""
    time_s: float | None = None
    """When to be there, seconds from the beginning; None: as fast as usual."""


def read(path: Path) -> list[Subgoal]:
    """Read the sub-goals of a file. Raises InputError SIM-002, and those of a table that is no TOML."""
    table = configuration.read_table(path)
    rows = table.get("subgoal")
    if set(table) != {"subgoal"} or not isinstance(rows, list) or not all(isinstance(r, dict) for r in rows):
        remedy = "write one [[subgoal]] table per sub-goal, nothing else"
        raise InputError("SIM-002", "holds no sub-goals", str(path), remedy)
    written = [configuration.from_table(SubgoalEntry, row, where=str(path)) for row in rows]
    found, clock = [], 0.0
    for number, each in enumerate(written, 1):
        where = f"{path}: subgoal {number}"
        if len(each.position) not in (2, 3) or not np.isfinite(each.position).all():
            remedy = "give [x, z] or [x, y, z] in meters"
            raise InputError("SIM-002", f"{each.position} is no position", where, remedy)
        if not np.isfinite(each.heading_deg or 0.0) or not (each.time_s or 0.0) <= LONGEST_S:
            what = f"heading_deg or time_s is no number up to {LONGEST_S:g} s"
            raise InputError("SIM-002", what, where, "correct it")
        if each.time_s is not None and each.time_s < clock:
            what = f"time_s {each.time_s:g} is before the sub-goal ahead of it"
            raise InputError("SIM-002", what, where, "let times rise")
        clock = each.time_s if each.time_s is not None else clock
        x, *middle, z = each.position
        position = np.array([x, middle[0] if middle else np.nan, z])
        heading = None if each.heading_deg is None else float(np.radians(each.heading_deg))
        found.append(Subgoal(position, heading, each.time_s))
    return found
