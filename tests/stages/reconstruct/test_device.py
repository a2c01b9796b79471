"""Every step of the reconstruction runs on a simulated second device, where a forgotten `.to(device)` fails."""

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree

from pipeline.data import motion as motion_files
from pipeline.fields import fields, marching_cubes
from pipeline.fields.fields import Reconstruction
from pipeline.fields.render import Renderer, render_depth
from stages.reconstruct import assemble, former, optimize, results
from stages.reconstruct.config import LearningRates, LossWeights, PhaseSteps, RayBatches
from tests.simulated_device import DEVICE, is_on_device, simulated_device
from tests.stages.reconstruct.test_fuse import fused_scene
from tests.stages.reconstruct.test_optimize import RADIUS_M, SHAPES, UPRIGHT, film, template

STEPS = PhaseSteps(template=40, scene=2, body=2, joint=2, save_every=2)
BATCHES = RayBatches(scene_rays=32, joint_scene_rays=16, rendered_rays=8, rendered_samples=8, runs=1)


@pytest.mark.slow
@pytest.mark.parametrize("form", ["fused", "measured", "rendered"])
def test_all_phases_run_on_another_device(form, tmp_path):
    rng = np.random.default_rng(0)
    videos = [film("v002", 8, True, rng), film("v001", 4, False, rng, UPRIGHT)]
    fused, rendered = fused_scene() if form == "fused" else None, form == "rendered"
    with simulated_device():
        problem = assemble.build(
            videos, template(RADIUS_M), SHAPES, 0, DEVICE, fused, tmp_path, rendered=rendered
        )
        plan = optimize.OptimizationPlan(
            STEPS, LossWeights(), BATCHES, LearningRates(), 0, tmp_path, rendered=rendered
        )
        records = optimize.optimize(problem, plan)
        assert all(np.isfinite(record.total()).all() for record in records.values())
        tables = (problem.store.scene, problem.store.agent, problem.store.views)
        for module in (*problem.modules().values(), problem.scene.grid):
            assert all(map(is_on_device, (*module.parameters(), *module.buffers())))
        assert all(is_on_device(value) for table in tables for value in vars(table).values())
        motion = results.motions(problem, videos, 0.75)["v002"]
        measured = KDTree(results.measured_points(problem))
        assert len(results.scene_surface(problem, measured).vertices) >= 0
        agent = marching_cubes.extract_agent(problem.agent, 0.04)
        assert np.isfinite(results.skin_weights(problem, agent)).all()
        results.feature_volume(problem, measured)
        reconstruction = Reconstruction(
            problem.scene, problem.agent, problem.body, assemble.scene_ids(videos)
        )
        fields.save(tmp_path, reconstruction)
        loaded = fields.load(tmp_path, DEVICE)
        camera, intrinsics = motion.world_from_camera[0], np.array([[20.0, 0, 8], [0, 20.0, 6], [0, 0, 1]])
        pose = motion.world_from_agent[0], motion.agent_from_bone[0]
        depth, _ = render_depth(loaded, camera, intrinsics, 12, 16, 3.0, "v002", *pose, samples=16)
        assert np.isfinite(depth).all()
        if form == "fused":
            Renderer(loaded, "v002", 0.04).draw(camera, intrinsics, 12, 16, *pose)
        assert torch.get_default_dtype() == torch.float32


@pytest.mark.slow
def test_warm_start_runs_on_another_device(tmp_path):
    rng = np.random.default_rng(0)
    videos = [film(id, 6, id != "v001", rng, UPRIGHT) for id in ("v003", "v002", "v001")]
    (tmp_path / "v002").mkdir()
    with simulated_device():
        problem = assemble.build(videos, template(RADIUS_M), SHAPES, 0, DEVICE)
        ids = assemble.scene_ids(videos)
        fields.save(tmp_path, Reconstruction(problem.scene, problem.agent, problem.body, ids))
        motion_files.save(tmp_path / "v002" / "motion.npz", results.motions(problem, videos, 0.75)["v002"])
        known = former.begin(problem, videos, tmp_path)
        assert len(known.frame) == 6 and all(map(is_on_device, problem.scene.parameters()))
        steps, resume = former.shorter(STEPS), tmp_path / "resume"
        plan = optimize.OptimizationPlan(
            steps, LossWeights(), BATCHES, LearningRates(), 0, resume, known=known
        )
        records = optimize.optimize(problem, plan)
    assert all(np.isfinite(records[phase].total()).all() for phase in ("scene", "joint"))
