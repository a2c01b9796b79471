"""Every step of the refinement runs on a simulated second device, where a forgotten `.to(device)` fails."""

from dataclasses import replace

import numpy as np
import torch

from pipeline.fields.gaussians import Splats
from stages.refine_gaussians import pictures, refine, stage
from stages.refine_gaussians.config import GaussianWeights
from stages.refine_gaussians.refine import FrameLoss, MotionDeltas
from stages.refine_gaussians.views import DrawnVideo
from tests.pipeline.fields import gsplat_stand_in
from tests.simulated_device import DEVICE, is_on_device, simulated_device
from tests.stages.refine_gaussians.test_cover import SIZE, film
from tests.stages.refine_gaussians.test_splats import ball


class _Masks(list):
    visible = np.ones(4, bool)


def session() -> DrawnVideo:
    """Return four frames of a wall behind an animal of one bone, with masks and flow."""
    plain, root = film(0), np.tile(np.eye(4), (4, 1, 1))
    root[:, 2, 3] = 1.0
    masks = _Masks([np.where(np.indices(SIZE)[1] > 80, 255, 0).astype(np.uint8)] * 4)
    cells = (3, SIZE[0] // 4, SIZE[1] // 4)
    flow = np.zeros((*cells, 2), np.float16), np.full(cells, 255, np.uint8)
    motion = replace(plain.motion, world_from_agent=root, agent_from_bone=np.tile(np.eye(4), (4, 1, 1, 1)))
    return replace(plain, masks=masks, flow=flow, motion=motion)


def test_refinement_runs_on_another_device(tmp_path, monkeypatch):
    gsplat_stand_in.install(monkeypatch)
    sequence = session()
    agent = ball(0.2, 60)
    splats = Splats(ball(0.5, 60), agent, torch.ones(60, 1), torch.eye(4)[None], videos=1)
    with simulated_device():
        splats, deltas = splats.to(DEVICE), MotionDeltas(4, 1).to(DEVICE)
        loss = FrameLoss(splats, deltas, [sequence], GaussianWeights(), 32, "gsplat")
        record = refine.refine(loss, 3, 0, tmp_path / "resume", 2)
        assert set(record.terms) == {"color", "depth", "silhouette", "flow", "motion"}
        assert np.isfinite(record.total()).all() and all(map(is_on_device, splats.parameters()))
        stage.write(tmp_path, splats, deltas, [sequence])
        pictures.report_quality(tmp_path, loss, [sequence], record)
    assert (tmp_path / "v0" / "motion.npz").exists() and (tmp_path / "qa.json").exists()
