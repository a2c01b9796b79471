"""CSV tables of where an animal was: one row per id and time."""

import csv
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, Shaped

from pipeline.behavior.trajectories import ABSENT_M, KINDS, UP
from pipeline.core.errors import InputError
from pipeline.geometry import rigid, subsampling
from stages.read_trajectories.motion import CLIP_GAP_S, absent_observer, concatenated_times

REQUIRED_COLUMNS = ("time", "x", "y", "z", "heading")
OBSERVER_COLUMNS = ("observer_x", "observer_y", "observer_z")
MAX_STEP_S = 1.0
"""Maximum median time step: larger ones are not seconds, or hold no motion."""
SURPLUS = "more cells than the header"


def columns(path: Path, needed: tuple[str, ...]) -> dict[str, list[str]]:
    """Read a CSV table by column, names in lower case; cells that a short row lacks are empty.

    Raises TRJ-001 if a required column is missing or a row has more cells than the header.
    """
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            rows = csv.DictReader(file, skipinitialspace=True, restkey=SURPLUS)
            names = [name.strip().lower() for name in rows.fieldnames or ()]
            twice = sorted({name for name in names if names.count(name) > 1})
            if twice:
                what = f"column {', '.join(twice)} appears more than once"
                remedy = "keep one of each, whatever its case"
                raise InputError("TRJ-001", what, str(path), remedy)
            found: dict[str, list[str]] = {name: [] for name in names}
            for row in rows:
                if SURPLUS in row:
                    remedy = "commas between cells, points in numbers"
                    raise InputError("TRJ-001", f"line {rows.line_num} has {SURPLUS}", str(path), remedy)
                for name, value in row.items():
                    found[name.strip().lower()].append((value or "").strip())
    except (UnicodeDecodeError, csv.Error) as error:
        what = f"cannot be read as CSV: {error}"
        raise InputError("TRJ-001", what, str(path), "save it as comma-separated UTF-8") from error
    missing = [name for name in needed if name not in found]
    if missing:
        present = ",".join(found) or "nothing"
        remedy = f"name the columns {','.join(needed)} in the first line, with commas; it has {present}"
        raise InputError("TRJ-001", f"has no column {', '.join(missing)}", str(path), remedy)
    return found


def numbers(path: Path, table: dict[str, list[str]], name: str) -> Float[np.ndarray, "row"]:
    """Return a column as numbers; empty and infinite cells are NaN. Raises TRJ-001 for anything else."""
    try:
        found = np.array([float(value) if value else np.nan for value in table[name]])
        return np.where(np.isinf(found), np.nan, found)
    except ValueError as error:
        what, remedy = f"column {name} is not numeric: {error}", "one number per cell, meters or seconds"
        raise InputError("TRJ-001", what, str(path), remedy) from error


def motion_from_csv(
    path: Path,
) -> tuple[
    Float[np.ndarray, "frame"],
    Float[np.ndarray, "frame 4 4"],
    Float[np.ndarray, "frame 4 4"],
    Float[np.ndarray, "frame companion 4"] | None,
]:
    """Return times, ``world_from_agent``, ``world_from_camera`` and companions.

    Ids are concatenated as clips on one clock, as are parts of an id with long gaps between them. The
    observer looks at the animal. In a table with a column ``kind``, ids share the table's clock and perceive
    each other; animals are the agents, or people if there are no animals. Rows without a position are frames
    in which the animal was not seen (NaN). Raises TRJ-001, TRJ-002.
    """
    table = columns(path, REQUIRED_COLUMNS)
    observed = any(name in table for name in OBSERVER_COLUMNS)
    if observed:
        columns(path, OBSERVER_COLUMNS)
    needed = REQUIRED_COLUMNS + (OBSERVER_COLUMNS if observed else ())
    value = {name: numbers(path, table, name) for name in needed}
    if not np.isfinite(value["time"]).all() or not len(value["time"]):
        what = "has rows without a time, or no rows"
        raise InputError("TRJ-002", what, str(path), "give every row its time in seconds")
    names = table.get("id", [""] * len(value["time"]))
    number_of = {name: number for number, name in enumerate(dict.fromkeys(names))}
    number = np.array([number_of[name] for name in names])
    order = np.argsort(number, kind="stable")
    rows = np.split(order, np.flatnonzero(np.diff(number[order])) + 1)
    rows = [mine[np.argsort(value["time"][mine], kind="stable")] for mine in rows]
    _refuse_impossible_times(path, [value["time"][mine] for mine in rows])
    gaps = [1 + np.flatnonzero(np.diff(value["time"][mine]) > CLIP_GAP_S) for mine in rows]
    rows = [clip for mine, gap in zip(rows, gaps, strict=True) for clip in np.split(mine, gap)]
    kinds = being_kinds(path, table, names)
    companions = None
    if kinds is not None:
        agents = rows if not kinds.any() else [mine for mine in rows if kinds[mine[0]]]
        beings = np.stack([*(value[axis] for axis in "xyz"), kinds], axis=-1)
        companions = companions_of(agents, rows, np.array(names), value["time"], beings)
        rows = agents
    order = np.concatenate(rows)
    turn = np.zeros((len(order), 3))
    turn[:, 1] = value["heading"][order]
    position = np.stack([value[axis][order] for axis in "xyz"], axis=-1)
    agent = rigid.make(rigid.rotation_from_vector(np.nan_to_num(turn)), position)
    agent[~np.isfinite(turn[:, 1])] = np.nan
    camera = absent_observer(len(order))
    if observed:
        seen = np.stack([value[name][order] for name in OBSERVER_COLUMNS], axis=-1)
        both = np.isfinite(seen).all(1) & np.isfinite(agent).all((1, 2))
        camera[both] = rigid.look_at(seen[both], agent[both, :3, 3], UP)
        camera[:, :3, 3] = np.where(np.isfinite(seen), seen, ABSENT_M)
    return concatenated_times([value["time"][mine] for mine in rows]), agent, camera, companions


def being_kinds(path: Path, table: dict[str, list[str]], names: list[str]) -> Int[np.ndarray, "row"] | None:
    """Return the index into `KINDS` of each row; None if the table does not name kinds.

    Raises TRJ-001 for other kinds, and for an id of two.
    """
    if "kind" not in table:
        return None
    kind_of = dict(zip(names, table["kind"], strict=True))
    wrong = [kind for name, kind in zip(names, table["kind"], strict=True) if kind != kind_of[name]]
    wrong += [kind for kind in kind_of.values() if kind not in KINDS]
    if wrong:
        remedy = f"one of {', '.join(KINDS)}, the same in all rows of an id"
        raise InputError("TRJ-001", f"column kind holds {wrong[0]!r}", str(path), remedy)
    return np.array([KINDS.index(kind_of[name]) for name in names])


def companions_of(
    agents: list[Int[np.ndarray, "_"]],
    clips: list[Int[np.ndarray, "_"]],
    names: Shaped[np.ndarray, "row"],
    time: Float[np.ndarray, "row"],
    beings: Float[np.ndarray, "row 4"],
) -> Float[np.ndarray, "frame companion 4"]:
    """Return where everybody else is at the times of the agents' clips, one clip after the other.

    A column belongs to one being at a time, and to the next one `CLIP_GAP_S` after it has gone at the
    earliest, so that no window holds both.
    """
    parts, ordered = [], sorted(clips, key=lambda rows: time[rows[0]])
    others = [mine[np.isfinite(beings[mine]).all(1)] for mine in ordered]
    others = [known for known in others if len(known)]
    for mine in agents:
        columns: list[np.ndarray] = []
        free_from: list[float] = []
        for known in others:
            met = time[known[0]] <= time[mine[-1]] and time[mine[0]] <= time[known[-1]]
            if not met or names[known[0]] == names[mine[0]]:
                continue
            track = interpolated(time[known], beings[known], time[mine])
            here = np.flatnonzero(np.isfinite(track[:, 0]))
            if not len(here):
                continue
            begin, end = time[mine][here[[0, -1]]]
            free = next((n for n, since in enumerate(free_from) if since <= begin), len(columns))
            if free == len(columns):
                columns.append(np.full_like(track, np.nan))
                free_from.append(0.0)
            columns[free][here], free_from[free] = track[here], end + CLIP_GAP_S
        parts.append(np.stack(columns, axis=1) if columns else np.zeros((len(mine), 0, beings.shape[1])))
    most = max(part.shape[1] for part in parts)
    whole = np.full((sum(map(len, parts)), most, beings.shape[1]), np.nan)
    for begin, part in zip(np.cumsum([0, *map(len, parts)]), parts, strict=False):
        whole[begin : begin + len(part), : part.shape[1]] = part
    return whole


def interpolated(
    time: Float[np.ndarray, "known"], beings: Float[np.ndarray, "known 4"], query: Float[np.ndarray, "frame"]
) -> Float[np.ndarray, "frame 4"]:
    """Interpolate rows between known ones at most `MAX_STEP_S` apart; NaN elsewhere."""
    found = np.stack([np.interp(query, time, column) for column in beings.T], axis=-1)
    found[~subsampling.within_short_gaps(time, query, MAX_STEP_S)] = np.nan
    return found


def _refuse_impossible_times(path: Path, clips: list[Float[np.ndarray, "row"]]) -> None:
    """Raise TRJ-001 if the sorted times of an id repeat, or cannot be seconds."""
    for time in clips:
        step = np.diff(time)
        if (step == 0).any():
            what = f"two rows of one id have the same time, {time[1:][step == 0][0]:g} s"
            raise InputError("TRJ-001", what, str(path), "give each animal or clip an id of its own")
        if len(step) and np.median(step) > MAX_STEP_S:
            what = f"its rows are typically {np.median(step):g} s apart"
            raise InputError("TRJ-001", what, str(path), "write times in seconds, several rows per second")
