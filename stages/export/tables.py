"""Tables of behaviour: one row per frame of every session, as CSV and, with pyarrow, as Parquet."""

import csv
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.geometry import rigid
from stages.export.reading import Session
from stages.export.writing import ExportRecord, extra, version

COLUMNS = (
    "time_s", "x", "y", "z", "qw", "qx", "qy", "qz", "speed_m_s",
    "observer_x", "observer_y", "observer_z", "distance_m", "in_view", "confidence",
)  # fmt: skip


def rows(session: Session) -> Float[np.ndarray, "frame 15"]:
    """Return the columns above: metres, seconds, world frame, quaternion wxyz; NaN where the animal is
    unknown.
    """
    known = np.all(np.isfinite(session.world_from_agent), axis=(1, 2))
    position = session.world_from_agent[:, :3, 3]
    quaternion = np.full((len(known), 4), np.nan)
    quaternion[known] = rigid.quaternion_from_rotation(session.world_from_agent[known, :3, :3])
    speed = np.linalg.norm(np.gradient(position, session.timestamp_s, axis=0), axis=1)
    observer = session.world_from_camera[:, :3, 3]
    distance = np.linalg.norm((observer - position)[:, [0, 2]], axis=1)
    return np.column_stack(
        [
            session.timestamp_s,
            position,
            quaternion,
            speed,
            observer,
            distance,
            session.visible,
            session.confidence,
        ]
    )


def write(folder: Path, sessions: list[Session]) -> ExportRecord:
    """Write `frames.csv` and `frames.parquet`."""
    arrow = extra("pyarrow", "pyarrow")
    parquet = extra("pyarrow.parquet", "pyarrow")
    tables = {session.video: rows(session) for session in sessions}
    with open(folder / "frames.csv", "w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["video", *COLUMNS])
        for video, table in tables.items():
            writer.writerows(
                [video, *("" if np.isnan(value) else f"{value:.6g}" for value in row)] for row in table
            )
    every = np.concatenate(list(tables.values()))
    videos = [video for video, table in tables.items() for _ in range(len(table))]
    columns = {"video": videos, **dict(zip(COLUMNS, every.T, strict=True))}
    parquet.write_table(arrow.table(columns), folder / "frames.parquet")
    assert parquet.read_table(folder / "frames.parquet").num_rows == len(every)
    return ExportRecord(
        version("pyarrow"), {}, version("pyarrow"), "metres, seconds, world frame (+y up), quaternion wxyz"
    )
