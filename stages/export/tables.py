"""Tables of behavior: one row per frame of every session, as CSV and, with pyarrow, as Parquet."""

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.data.motion import Motion
from pipeline.geometry import rigid
from stages.export.writing import ExportRecord, extra, version

COLUMNS = (
    "time_s", "x", "y", "z", "qw", "qx", "qy", "qz", "speed_m_s",
    "observer_x", "observer_y", "observer_z", "distance_m", "in_view", "confidence",
)  # fmt: skip
DECIMALS = 6
"""Decimals in the CSV file: micrometers and microseconds, however long a recording is."""


def rows(session: Motion) -> Float[np.ndarray, "frame 15"]:
    """Return the columns above: meters, seconds, world frame, wxyz; NaN where the animal is unknown."""
    known = np.all(np.isfinite(session.world_from_agent), axis=(1, 2))
    position = session.world_from_agent[:, :3, 3]
    quaternion = np.full((len(known), 4), np.nan)
    quaternion[known] = rigid.quaternion_from_rotation(session.world_from_agent[known, :3, :3])
    speed = np.linalg.norm(np.gradient(position, session.timestamp_s, axis=0), axis=1)
    observer = session.world_from_camera[:, :3, 3]
    distance = np.linalg.norm((observer - position)[:, [0, 2]], axis=1)
    animal, person = [position, quaternion, speed], [observer, distance, session.agent_visible]
    return np.column_stack([session.timestamp_s, *animal, *person, session.confidence])


def write(folder: Path, sessions: Mapping[str, Motion]) -> ExportRecord:
    """Write `frames.csv` and `frames.parquet`."""
    arrow = extra("pyarrow", "pyarrow")
    parquet = extra("pyarrow.parquet", "pyarrow")
    tables = {video: rows(session) for video, session in sessions.items()}
    with open(folder / "frames.csv", "w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["video", *COLUMNS])
        for video, table in tables.items():
            for row in np.round(table, DECIMALS).tolist():
                writer.writerow([video, *("" if np.isnan(value) else value for value in row)])
    every = np.concatenate(list(tables.values()))
    videos = [video for video, table in tables.items() for _ in range(len(table))]
    columns = {"video": videos, **dict(zip(COLUMNS, every.T, strict=True))}
    parquet.write_table(arrow.table(columns), folder / "frames.parquet")
    assert parquet.read_table(folder / "frames.parquet").num_rows == len(every)
    remark = "meters, seconds, world frame (+y up), quaternion wxyz"
    return ExportRecord(version("pyarrow"), {}, version("pyarrow"), remark)
