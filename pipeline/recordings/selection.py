"""Choose recorded frames by time: evenly spaced where the recording is dense, gaps kept where it is not."""

import numpy as np
from jaxtyping import Float, Int


def choose_frames(timestamp_s: Float[np.ndarray, "frame"], rate_hz: float) -> Int[np.ndarray, "chosen"]:
    """Pick, for every tick of a clock at ``rate_hz``, the frame nearest to it within half a tick.

    Ticks start at the first frame. No frame is picked twice and none is invented: a tick without a frame stays empty.
    ``timestamp_s`` must increase.
    """
    tick = np.rint((timestamp_s - timestamp_s[0]) * rate_hz).astype(int)
    distance_s = np.abs(timestamp_s - timestamp_s[0] - tick / rate_hz)
    order = np.lexsort((distance_s, tick))
    first_of_tick = np.unique(tick[order], return_index=True)[1]
    return order[first_of_tick]
