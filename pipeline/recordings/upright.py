"""Find how many quarter turns make a recording upright, from the direction of gravity in its pictures."""

import numpy as np
from jaxtyping import Float

from pipeline.space import cameras


def quarter_turns_from_gravity(
    odometry_from_camera: Float[np.ndarray, "frame 4 4"],
    *,
    up_odometry: tuple[float, float, float] = (0.0, 1.0, 0.0),
    margin: float = 0.1,
) -> int:
    """Return the clockwise quarter turns (0..3) after which up in the world points up in the pictures on average.

    The pictures stay as they are unless another turn is better by ``margin`` (mean cosine): a phone that looks
    straight down has no upright.
    """
    up_in_picture = [-(cameras.turn_camera(odometry_from_camera, turns)[:, :3, 1] @ np.asarray(up_odometry)).mean() for turns in range(4)]
    best = int(np.argmax(up_in_picture))
    return best if up_in_picture[best] > up_in_picture[0] + margin else 0
