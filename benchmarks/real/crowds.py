"""Pedestrian tracks of ETH/UCY, in the text format of the SGAN splits.

Each row is `frame person x y`, meters, with 0.4 s between consecutive frame numbers. `Crowd.read` reads a file,
`table` writes it as the CSV that `stages.read_trajectories` reads, `walks` lists the windows of the protocol.
"""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

STEP_S = 0.4
PAST, FUTURE = 8, 12
"""steps of the protocol (Alahi et al. 2016)"""
HEADING_M = 0.2
"""Shortest displacement that defines a heading: positions have errors of centimeters."""
MIN_PEOPLE = 2
"""People present throughout a window for it to count in the protocol of SGAN (Gupta et al. 2018)."""


@dataclass(frozen=True)
class Walk:
    """A window of one person."""

    person: int
    """column of `Crowd.position`"""
    start: int
    """row of `Crowd.position`"""


@dataclass(frozen=True)
class Crowd:
    """One recording."""

    position: Float[np.ndarray, "step person 2"]
    """meters; NaN where a person is absent"""

    @classmethod
    def read(cls, path: Path) -> "Crowd":
        """Read a file of the SGAN splits."""
        rows = np.loadtxt(path, ndmin=2)
        number = np.round(rows[:, 0]).astype(int)
        gaps = np.diff(np.unique(number))
        step = (number - number.min()) // (int(gaps.min()) if len(gaps) else 1)
        names, person = np.unique(rows[:, 1], return_inverse=True)
        position = np.full((step.max() + 1, len(names), 2), np.nan)
        position[step, person] = rows[:, 2:4]
        return cls(position)

    def walks(self) -> list[Walk]:
        """Return all windows of people who are present throughout, ordered by person and time."""
        steps = PAST + FUTURE
        known = np.isfinite(self.position[..., 0])
        if len(known) < steps:
            return []
        whole = np.lib.stride_tricks.sliding_window_view(known, steps, axis=0).all(-1)
        return [Walk(int(person), int(start)) for person, start in zip(*np.nonzero(whole.T), strict=True)]

    def accompanied(self, walks: list[Walk]) -> Bool[np.ndarray, "walk"]:
        """Return whether others are present throughout the same window."""
        start = np.array([walk.start for walk in walks], int)
        return np.bincount(start, minlength=1)[start] >= MIN_PEOPLE

    def heading(self, person: int) -> Float[np.ndarray, "step"]:
        """Return the causal heading per step, radians about +y from +z.

        Steps before the first displacement of `HEADING_M` take its direction if every window that contains them
        contains it too, and 0 otherwise.
        """
        found = np.full(len(self.position), np.nan)
        place = self.position[:, person]
        steps = np.flatnonzero(np.isfinite(place[:, 0]))
        for order, step in enumerate(steps):
            displacement = place[step] - place[steps[max(order - PAST, 0) : order]][::-1]
            far = np.flatnonzero(np.linalg.norm(displacement, axis=-1) >= HEADING_M)
            if len(far):
                found[step] = np.arctan2(*displacement[far[0]])
            elif order:
                found[step] = found[steps[order - 1]]
        first = np.flatnonzero(np.isfinite(found[steps]))[:1]
        before = steps[: first[0]] if len(first) else steps
        found[before] = found[steps[first[0]]] if len(first) and first[0] < PAST else 0.0
        return found

    def table(self, path: Path) -> None:
        """Write a CSV table of people who all perceive each other, sorted by person."""
        with open(path, "w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(("id", "time", "x", "y", "z", "heading", "kind"))
            for person in range(self.position.shape[1]):
                heading = self.heading(person)
                for step in np.flatnonzero(np.isfinite(heading)):
                    x, z = self.position[step, person]
                    row = (person, f"{step * STEP_S:.1f}", repr(float(x)), 0, repr(float(z)))
                    writer.writerow((*row, repr(float(heading[step])), "person"))
