"""Cross-validation over clips on synthetic dog joints."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.real import captured_dog
from pipeline.data import npz
from stages.train_behavior.config import BehaviorOptimizerConfig


def walk(seed: int, frames: int = 500) -> np.ndarray:
    """Synthesize five joints of a body that walks along an arc at 60 Hz."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, 6) + np.linspace(0, rng.uniform(-1, 1), frames)
    forward = np.stack([np.sin(angle), np.zeros(frames), np.cos(angle)], axis=-1)
    root = (forward / 60).cumsum(0) + np.array([0, 0.5, 0])
    swing = 0.1 * np.sin(np.arange(frames) / 5)[:, None] * forward
    up = np.array([0, 0.3, 0])
    return np.stack([root, root - up + swing, root + 0.2 * forward, root + 0.5 * forward, root + up], axis=1)


@pytest.mark.slow
def test_every_clip_is_held_out(tmp_path, monkeypatch):
    optimization = BehaviorOptimizerConfig(steps=3, goal_steps=1, batch=4, goal_batch=4)
    training = replace(captured_dog.MODEL.training, optimization=optimization)
    monkeypatch.setattr(
        captured_dog, "MODEL", replace(captured_dog.MODEL, training=training, ensemble_size=1)
    )
    monkeypatch.setattr(captured_dog, "SAMPLES", 3)
    monkeypatch.setattr(captured_dog, "STRIDE", 8)
    npz.save(tmp_path / "dog.npz", compress=False, **{f"clip{n}": walk(n) for n in range(2)})
    row = captured_dog.row(tmp_path / "dog.npz", tmp_path / "out")
    means = row.detail["means"]
    assert means.keys() == {"ours", "standing still", "constant velocity", "location prior"}
    assert set(means["ours"]) == set(captured_dog.METRICS)
    assert all(np.isfinite(value) for scores in means.values() for value in scores.values())
    assert "orientation_minade_rad" not in means["location prior"]
    assert (tmp_path / "out" / "dog" / "clip1" / "figures-0.json").is_file()
