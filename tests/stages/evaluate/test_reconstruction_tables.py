"""Table 3: paired comparison of pictures; holes count as wrong; no table without ground truth."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.metrics.metrics import Metrics
from stages.evaluate.heldout import HeldoutShot, HeldoutView, depth_metrics
from stages.evaluate.reading import Reconstructed
from stages.evaluate.reconstruction_tables import table


def view(wrong: int) -> HeldoutView:
    """Return a picture of 100 pixels, 20 of them of the agent, with some scene pixels half a meter too far or
    missing.
    """
    color, agent = np.zeros((10, 10, 3), np.uint8), np.zeros((10, 10), bool)
    agent[:2] = True
    true = np.full((10, 10), 2.0)
    ours = true.copy()
    ours.reshape(-1)[20 : 20 + wrong] = np.where(np.arange(wrong) % 2, 0.0, 2.5)
    return HeldoutView(color, ours, HeldoutShot(np.eye(4), np.eye(3), 0.0, color, true, agent))


def test_difference_to_a_baseline_has_an_interval():
    right = {
        name: np.array(
            [list(depth_metrics(name, [view(wrong + k % 2)]).values.values()) for k in range(12)], float
        )
        for name, wrong in (("ours", 8), ("totalrecon", 28))
    }
    found = Metrics()
    table._compare(found, "totalrecon", right["ours"] - right["totalrecon"], np.random.default_rng(0))
    assert found.values["totalrecon/depth_acc_all_less_than_reference"] == pytest.approx(0.2)
    assert found.values["totalrecon/depth_acc_scene_less_than_reference"] == pytest.approx(0.25)
    assert found.values["totalrecon/depth_acc_agent_less_than_reference"] == 0
    assert found.values["totalrecon/depth_acc_all_less_than_reference_ci95_low"] > 0.19
    text = table.text({"ours/depth_acc_all": 0.9, **found.values}, ("ours", "totalrecon"))
    assert "0.708 / 0.695 / 0.703" in text and "0.200 [0.200 0.200]" in text


def test_no_table_without_ground_truth():
    places = Reconstructed(
        frames={},
        scene_template=Path("scene"),
        agent_template=Path("agent"),
        reconstruction=Path("ours"),
        truth=None,
    )
    found = table.metrics({"ours": Path("ours")}, places, (), 24, np.random.default_rng(0), "cpu")
    assert set(found.values.values()) == {None} and set(found.values) == set(found.reasons)
    assert table.text(found.values, ("ours",)).count("- / - / -") == 5
