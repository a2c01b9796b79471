"""CSV tables of where an animal was: one row per id and time."""

import csv
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.errors import InputError
from pipeline.space import rigid
from stages.read_trajectories.life import NOBODY_M, nobody, one_after_another

NEEDED = ("time", "x", "y", "z", "heading")
OBSERVER = ("observer_x", "observer_y", "observer_z")


def columns(path: Path, needed: tuple[str, ...]) -> dict[str, list[str]]:
    """Read a CSV table by column. Raises TRJ-001 when a needed column is missing or a row is short."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            rows = csv.DictReader(file, skipinitialspace=True)
            found = {name.strip(): [] for name in rows.fieldnames or ()}
            for row in rows:
                for name, value in row.items():
                    found[name.strip()].append((value or "").strip())
    except (UnicodeDecodeError, csv.Error, KeyError, AttributeError) as error:
        raise InputError("TRJ-001", f"cannot be read as CSV: {error}", str(path), "save it as comma-separated UTF-8") from error
    missing = [name for name in needed if name not in found]
    if missing:
        raise InputError("TRJ-001", f"has no column {', '.join(missing)}", str(path), f"columns: {', '.join(needed)}")
    return found


def numbers(path: Path, table: dict[str, list[str]], name: str) -> Float[np.ndarray, "row"]:
    """Return a column as numbers; empty cells are NaN. Raises TRJ-001 for anything else."""
    try:
        return np.array([float(value) if value else np.nan for value in table[name]])
    except ValueError as error:
        raise InputError(
            "TRJ-001", f"column {name} is not numeric: {error}", str(path), "one number per cell, metres or seconds"
        ) from error


def motion_from_csv(
    path: Path,
) -> tuple[Float[np.ndarray, "frame"], Float[np.ndarray, "frame 4 4"], Float[np.ndarray, "frame 4 4"]]:
    """Return times, ``world_from_agent`` and ``world_from_camera``; ids follow each other on one clock.

    Rows without a position are frames in which the animal was not seen (NaN).
    """
    table = columns(path, NEEDED)
    observed = any(name in table for name in OBSERVER)
    if observed:
        columns(path, OBSERVER)
    value = {name: numbers(path, table, name) for name in (*NEEDED, *(OBSERVER if observed else ()))}
    if not np.isfinite(value["time"]).all() or not len(value["time"]):
        raise InputError("TRJ-002", "has rows without a time, or no rows", str(path), "give every row its time in seconds")
    names = table.get("id", [""] * len(value["time"]))
    rows = [np.flatnonzero(np.array(names) == name) for name in dict.fromkeys(names)]
    rows = [mine[np.argsort(value["time"][mine], kind="stable")] for mine in rows]
    if any((np.diff(value["time"][mine]) <= 0).any() for mine in rows):
        raise InputError("TRJ-001", "two rows of one id have the same time", str(path), "give each animal or clip an id of its own")
    order = np.concatenate(rows)
    turn = np.zeros((len(order), 3))
    turn[:, 1] = value["heading"][order]
    agent = rigid.make(rigid.rotation_from_vector(np.nan_to_num(turn)), np.stack([value[axis][order] for axis in "xyz"], axis=-1))
    agent[~np.isfinite(turn[:, 1])] = np.nan
    camera = nobody(len(order))
    if observed:
        seen = np.stack([value[name][order] for name in OBSERVER], axis=-1)
        camera[:, :3, 3] = np.where(np.isfinite(seen), seen, NOBODY_M)
    return one_after_another([value["time"][mine] for mine in rows]), agent, camera
