"""The quality page shows measured values even if others are missing."""

import json
from types import SimpleNamespace

import numpy as np

from stages.reconstruct import pictures


def stub(monkeypatch, rows, asked):
    opened = SimpleNamespace(open=lambda folder: [folder] * pictures.FRAMES)

    def chosen(motion, number):
        asked.append((motion, number))
        return list(range(number))

    for name, double in {
        "Clip": opened,
        "Masks": opened,
        "Renderer": lambda reconstruction, id: None,
        "chosen_frames": chosen,
        "compare": lambda *_: (next(rows), np.zeros((8, 8, 3), np.uint8)),
    }.items():
        monkeypatch.setattr(pictures, name, double)


def checks_of(folder, ids):
    paths = dict.fromkeys(ids, folder)
    pictures.report_quality(folder, None, {id: id for id in ids}, paths, paths, {})
    return json.loads((folder / "qa.json").read_text())["checks"]


def test_frame_without_depth_does_not_hide_metrics(tmp_path, monkeypatch):
    stub(monkeypatch, iter([(20.0, np.nan, 0.8), (30.0, 0.9, 0.6)] * 8), [])
    np.testing.assert_allclose([check["value"] for check in checks_of(tmp_path, ["v002"])], [25.0, 0.9, 0.7])


def test_every_session_is_compared(tmp_path, monkeypatch):
    asked, ids = [], [f"v{number:03d}" for number in range(2, 10)]
    stub(monkeypatch, iter([(30.0, 0.95, 0.9)] * 8 + [(30.0, 0.95, 0.2)] * 8), asked)
    assert checks_of(tmp_path, ids)[2]["status"] == "warn", "the last sessions' masks are missed"
    assert asked == [(id, 2) for id in ids]
