"""A bank of patches of rendered views: nearest neighbours tell which point of the map lies under a patch."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

BLOCK = 4096
"""Patches of the bank that are compared at once: their table stays in the processor's cache."""


@dataclass(frozen=True)
class Bank:
    """All patches of all rendered views."""

    descriptors: Float[np.ndarray, "patch axis"]
    points_map: Float[np.ndarray, "patch 3"]
    view: Int[np.ndarray, "patch"]
    map_from_camera: Float[np.ndarray, "view 4 4"]

    def correspond(
        self, query: Float[np.ndarray, "query axis"], part: Int[np.ndarray, "part"] | None = None
    ) -> tuple[Float[np.ndarray, "query 3"], Float[np.ndarray, "query"]]:
        """Return the map's point under each query patch and how far to trust it, asking all patches or some."""
        descriptors, points = (self.descriptors, self.points_map) if part is None else (self.descriptors[part], self.points_map[part])
        nearest, similarity = np.zeros(len(query), int), np.full(len(query), -np.inf, np.float32)
        for first in range(0, len(descriptors), BLOCK):
            table = query @ descriptors[first : first + BLOCK].T
            best = table.argmax(1)
            found = table[np.arange(len(query)), best]
            nearest = np.where(found > similarity, best + first, nearest)
            similarity = np.maximum(similarity, found)
        return points[nearest].astype(float), np.clip(similarity, 0.05, 1).astype(float) ** 2

    def sectors(self, count: int) -> list[Int[np.ndarray, "part"]]:
        """Split the patches by the azimuth their view was taken from."""
        eye = self.map_from_camera[:, :3, 3]
        sector = np.floor((np.arctan2(eye[:, 0], eye[:, 2]) / (2 * np.pi) + 0.5) * count).astype(int) % count
        return [np.flatnonzero(sector[self.view] == index) for index in range(count)]

    def arrays(self) -> dict[str, np.ndarray]:
        """Return what a file keeps."""
        return vars(self) | {"descriptors": self.descriptors.astype(np.float16)}

    @staticmethod
    def from_arrays(arrays: dict[str, np.ndarray]) -> "Bank":
        """Rebuild a bank from a file."""
        return Bank(**arrays | {"descriptors": arrays["descriptors"].astype(np.float32)})
