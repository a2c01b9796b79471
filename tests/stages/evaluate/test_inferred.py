"""Only inferred frames are judged apart, and how many they are is told."""

from types import SimpleNamespace

import numpy as np

from pipeline.models.motion import INFERRED, Motion
from stages.evaluate.inferred import inferred_figures


def figures_of(confidence: np.ndarray) -> dict[str, float | None]:
    count = len(confidence)
    root = np.tile(np.eye(4), (count, 1, 1))
    root[:, 0, 3] = np.where(confidence < 0.1, 0.5, 0.0)
    motion = Motion(np.arange(count) * 0.1, root, root, root[:, None], confidence, confidence > 0.1)
    recorded = SimpleNamespace(video=SimpleNamespace(id="v002"), truth=None)
    frames = SimpleNamespace(roots=lambda truth: np.tile(np.eye(4), (count, 1, 1)))
    return inferred_figures([recorded], {"v002": motion}, frames).values


def test_inferred_frames_are_judged_apart():
    found = figures_of(np.array([0.9, INFERRED, INFERRED, 0.9, 0.9, 0.9, 0.9, 0.9]))
    assert found["reconstruction/agent_inferred_share"] == 0.25
    assert found["reconstruction/agent_inferred_m_median"] == 0.5 and found["reconstruction/agent_inferred_deg_median"] == 0
    found = figures_of(np.ones(4))
    assert found["reconstruction/agent_inferred_share"] == 0 and found["reconstruction/agent_inferred_m_median"] is None
