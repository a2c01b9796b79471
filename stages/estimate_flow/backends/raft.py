"""RAFT as an estimator: pictures in color at the working size, flow from a guess where there is one."""

import cv2
import numpy as np
from jaxtyping import UInt8

from pipeline.backends import raft
from stages.estimate_flow.estimation import Dense, Estimator, chain

Color = UInt8[np.ndarray, "working_height working_width 3"]
UPDATES = 20
"""iterations of the network, updates of the flow: its authors evaluate with 24 to 32; the last ones change
little"""


class RaftEstimator(Estimator):
    """Flow by the network in place of the search; pictures are read in color."""

    def __init__(self, network: raft.Raft, color_size: tuple[int, int], working_side_px: int) -> None:
        """Prepare for pictures of (height, width), reduced as by `Estimator`."""
        super().__init__(color_size, working_side_px)
        self._network = network

    def reduce(self, color: UInt8[np.ndarray, "height width 3"]) -> Color:
        """Reduce a picture to the working size."""
        height, width = self.dense_size
        return cv2.resize(color, (2 * width, 2 * height), interpolation=cv2.INTER_AREA)

    def neighbors(self, first: Color, second: Color) -> Dense:
        """Estimate from nothing."""
        return self._estimated(first, second, None)

    def chained(self, first: Color, last: Color, first_to_middle: Dense, middle_to_last: Dense) -> Dense:
        """Follow one flow, then the other, and let the network go on from there."""
        return self._estimated(first, last, chain(first_to_middle, middle_to_last))

    def _estimated(self, first: Color, second: Color, guess: Dense | None) -> Dense:
        start, size = None, first.shape[1::-1]
        if guess is not None:
            start = 2 * cv2.resize(guess.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
        flow = raft.flow_between(self._network, first, second, UPDATES, start)
        return cv2.resize(flow, self.dense_size[::-1], interpolation=cv2.INTER_AREA) / 2
