"""Heat maps in space are occluded by walls."""

import numpy as np

from stages.export_simulator.pictures import _splatted


def test_heat_is_occluded_by_surfaces():
    lens = np.array([[100.0, 0, 32], [0, 100.0, 24], [0, 0, 1]])
    behind = np.full((48, 64), np.inf)
    behind[:, :32] = 1.5
    points = np.array([[-0.2, 0, 2.0], [0.2, 0, 2.0], [0.2, 0, -2.0], [5.0, 0, 2.0]])
    image = _splatted(points, np.array([0.9, 0.7, 0.8, 1.0]), np.eye(4), lens, behind, radius_px=2)
    assert image[24, 42] == image.max() == 0.7
    assert (image > 0).sum() == 9, "one point, three pixels wide"
