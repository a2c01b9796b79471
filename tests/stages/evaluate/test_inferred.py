"""Only inferred frames are judged apart, how many they are is told, and they do not count as placed."""

from types import SimpleNamespace

import numpy as np

from pipeline.models.motion import INFERRED, Motion
from stages.evaluate.inferred import inferred_figures
from stages.evaluate.reconstruction import agent_roots


def figures_of(confidence: np.ndarray, seen: np.ndarray) -> dict[str, float | None]:
    count = len(confidence)
    root = np.tile(np.eye(4), (count, 1, 1))
    root[:, 0, 3] = np.where(seen, 0.0, 0.5)
    motion = Motion(np.arange(count) * 0.1, root, root, root[:, None], confidence.astype("f4"), seen)
    recorded = SimpleNamespace(video=SimpleNamespace(id="v002"), truth=SimpleNamespace(agent_visible=np.arange(count) < 4))
    frames = SimpleNamespace(roots=lambda truth: np.tile(np.eye(4), (count, 1, 1)))
    given = [recorded], {"v002": motion}, frames
    return inferred_figures(*given).values | agent_roots(*given).values


def test_inferred_frames_are_judged_apart():
    confidence = np.array([0.9, INFERRED, INFERRED, 0.9, 0.9, 0.9, 0.9, 0.9])
    found = figures_of(confidence, confidence > INFERRED)
    assert found["reconstruction/agent_inferred_share"] == 0.25
    assert found["reconstruction/agent_inferred_m_median"] == 0.5 and found["reconstruction/agent_inferred_deg_median"] == 0
    assert found["reconstruction/agent_placed_share"] == 0.5, "of the first four frames, which truly show it"
    found = figures_of(np.ones(4), np.ones(4, bool))
    assert found["reconstruction/agent_inferred_share"] == 0 and found["reconstruction/agent_inferred_m_median"] is None


def test_a_doubtful_camera_infers_nothing():
    found = figures_of(np.array([0.9, 0.08, 0.03, 0.9]), np.ones(4, bool))
    assert found["reconstruction/agent_inferred_share"] == 0
