"""A bank of patches of rendered views: nearest neighbours give the point of the map under a patch."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, Shaped

BLOCK = 4096
"""Patches of the bank compared at once: their similarities stay in the processor's cache."""
LEAST_SIMILARITY = 0.05
"""Cosine similarities below count as this, so that every match keeps some weight."""


@dataclass(frozen=True)
class PatchBank:
    """All patches of all rendered views."""

    descriptors: Float[np.ndarray, "patch axis"]
    """Unit length."""
    points_map: Float[np.ndarray, "patch 3"]
    """Metres."""
    view: Int[np.ndarray, "patch"]
    map_from_camera: Float[np.ndarray, "view 4 4"]

    def match(
        self, query: Float[np.ndarray, "query axis"], part: Int[np.ndarray, "part"] | None = None
    ) -> tuple[Float[np.ndarray, "query 3"], Float[np.ndarray, "query"]]:
        """Return the map's point of each query's nearest neighbour and its weight (squared cosine), among all
        or some."""
        descriptors, points = self.descriptors, self.points_map
        if part is not None:
            descriptors, points = descriptors[part], points[part]
        nearest, similarity = np.zeros(len(query), int), np.full(len(query), -np.inf, np.float32)
        for first in range(0, len(descriptors), BLOCK):
            table = query @ descriptors[first : first + BLOCK].T
            best = table.argmax(1)
            score = table[np.arange(len(query)), best]
            nearest = np.where(score > similarity, best + first, nearest)
            similarity = np.maximum(similarity, score)
        return points[nearest].astype(float), np.clip(similarity, LEAST_SIMILARITY, 1).astype(float) ** 2

    def sectors(self, count: int) -> list[Int[np.ndarray, "part"]]:
        """Split the patches by the azimuth their view was taken from."""
        eye = self.map_from_camera[:, :3, 3]
        sector = np.floor((np.arctan2(eye[:, 0], eye[:, 2]) / (2 * np.pi) + 0.5) * count).astype(int) % count
        return [np.flatnonzero(sector[self.view] == index) for index in range(count)]

    def arrays(self) -> dict[str, Shaped[np.ndarray, "..."]]:
        """Return the arrays to store."""
        return vars(self) | {"descriptors": self.descriptors.astype(np.float16)}

    @staticmethod
    def from_arrays(arrays: dict[str, Shaped[np.ndarray, "..."]]) -> "PatchBank":
        """Rebuild a bank from stored arrays."""
        return PatchBank(**arrays | {"descriptors": arrays["descriptors"].astype(np.float32)})
