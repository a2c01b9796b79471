"""The quality page shows measured values even if others are missing."""

import json
from types import SimpleNamespace

import numpy as np

from stages.reconstruct import pictures


def test_frame_without_depth_does_not_hide_metrics(tmp_path, monkeypatch):
    rows = iter([(20.0, np.nan, 0.8), (30.0, 0.9, 0.6)])
    opened = SimpleNamespace(open=lambda folder: {0: folder, 1: folder})
    for name, stub in {
        "Clip": opened,
        "Masks": opened,
        "Renderer": lambda reconstruction, id: None,
        "chosen_frames": lambda motion, number: [0, 1],
        "compare": lambda *_: (next(rows), np.zeros((8, 8, 3), np.uint8)),
    }.items():
        monkeypatch.setattr(pictures, name, stub)
    pictures.report_quality(tmp_path, None, {"v002": None}, {"v002": tmp_path}, {"v002": tmp_path}, {})
    checks = json.loads((tmp_path / "qa.json").read_text())["checks"]
    np.testing.assert_allclose([check["value"] for check in checks], [25.0, 0.9, 0.7])
