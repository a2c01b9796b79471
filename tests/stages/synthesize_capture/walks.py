"""Simulated walks for tests of bodies and gaits."""

import numpy as np

from stages.synthesize_capture.session import AnimalCourse


def straight(speed_m_s: float, posture: tuple[float, float, float] = (0, 0, 0)) -> AnimalCourse:
    """Walk along z for 4.3 s, looking ahead."""
    time = np.arange(130) / 30
    still = np.zeros(len(time))
    position = np.stack([still, still, speed_m_s * time], axis=-1)
    postures = np.tile(np.array(posture, float), (len(time), 1))
    return AnimalCourse(time, position, still, postures, still, position + np.array([0, 0.3, 2.0]), still)
