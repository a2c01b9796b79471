"""A reconstruction that starts from an earlier one keeps its fields and motion, and poses only added
recordings.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.core.errors import InputError
from pipeline.data import motion
from pipeline.fields import fields
from pipeline.fields.fields import Reconstruction
from pipeline.geometry import rigid
from stages.reconstruct import assemble, former, optimize, results
from stages.reconstruct.config import PhaseSteps
from tests.stages.reconstruct.test_optimize import (
    RADIUS_M,
    SHAPES,
    UPRIGHT,
    WIDE,
    film,
    plan,
    problem,
    template,
)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A reconstruction of a session and the turnaround as files, the problem and its motion."""
    torch.set_num_threads(1)
    found, videos = problem(videos=films())
    optimize.optimize(found, plan(template=20, scene=20, body=6, joint=3))
    folder = tmp_path_factory.mktemp("former")
    fields.save(folder, Reconstruction(found.scene, found.agent, found.body, assemble.scene_ids(videos)))
    motions = results.motions(found, videos, 0.75)
    (folder / "v002").mkdir()
    (folder / "templates").mkdir()
    motion.save(folder / "v002/motion.npz", motions["v002"])
    motion.save(folder / "templates/v001.npz", motions["v001"])
    return folder, found, motions


def films(*more):
    rng = np.random.default_rng(0)
    return [film("v002", 12, True, rng, WIDE), film("v001", 6, False, rng, UPRIGHT), *more]


def added():
    return film("v003", 9, True, np.random.default_rng(5), WIDE)


@pytest.mark.slow
def test_fields_and_motion_of_the_earlier_reconstruction_are_kept(made):
    folder, before, motions = made
    found, videos = problem(videos=films(added()))
    known = former.begin(found, videos, folder)
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    code = torch.full((200,), -1)
    with torch.no_grad():
        for field, its in ((found.agent, before.agent), (found.scene, before.scene)):
            video = code if field is found.scene else None
            now, then = (each(points, video) for each in (field, its))
            assert (now.signed_distance - then.signed_distance).abs().mean() < 2e-3, "meters"
        of_v002 = torch.nonzero(found.video == 0)[:, 0]
        assert set(of_v002.tolist()) < set(known.frame.tolist())
        assert not set(torch.nonzero(found.video == 1)[:, 0].tolist()) & set(known.frame.tolist())
        known.write(found)
        for table, name in (
            (found.motion.world_from_agent(of_v002), "world_from_agent"),
            (found.motion.agent_from_bone(of_v002), "agent_from_bone"),
            (found.motion.world_from_camera(of_v002), "world_from_camera"),
        ):
            np.testing.assert_allclose(table.numpy(), getattr(motions["v002"], name), atol=2e-3)
    np.testing.assert_array_equal(found.scene.codes.weight[0].detach(), before.scene.codes.weight[0].detach())


def test_only_added_recordings_are_posed(made, tmp_path):
    folder, *_ = made
    found, videos = problem(videos=films(added()))
    known = former.begin(found, videos, folder)
    steps = former.shorter(PhaseSteps(template=20, scene=20, body=4, joint=10))
    assert (steps.template, steps.scene, steps.joint) == (0, 6, 3)
    optimize.optimize(found, replace(plan(resume=tmp_path), steps=steps, known=known))
    posed = [path.name for path in tmp_path.glob("body_*")]
    assert len(posed) == 1, "the segment of the recording that was added"
    assert np.isfinite(results.motions(found, videos, 0.75)["v003"].world_from_agent).all()


def test_recording_with_other_timestamps_is_added(made):
    folder, *_ = made
    videos = films(added())
    videos[0] = replace(videos[0], timestamp_s=videos[0].timestamp_s + 1.0)
    found, videos = problem(videos=videos)
    known = former.begin(found, videos, folder)
    assert set(found.video[known.frame].tolist()) == {2}, "the turnaround alone is known"


def test_fields_of_other_sizes_are_refused(made, tmp_path):
    folder, *_ = made
    found, videos = problem(replace(SHAPES, width=48), films(added()))
    with pytest.raises(InputError, match=r"RCN-003.*: agent\.\S+ \((\d+, )*32.*, not \((\d+, )*48"):
        former.begin(found, videos, folder)
    found, videos = problem(replace(SHAPES, encoding="mlp"), films(added()))
    with pytest.raises(InputError, match=r"RCN-003.*a scene without a grid"):
        former.begin(found, videos, folder)
    with pytest.raises(InputError, match="ART-007"):
        former.begin(found, videos, tmp_path)


def test_fields_of_another_template_are_refused(made):
    """Turned by 180 degrees (`turn_deg`), a template has the same sizes; its motion would be backwards."""
    folder, *_ = made
    videos, ball = films(added()), template(RADIUS_M)
    turned = rigid.make(rigid.rotation_from_yaw(np.pi), np.zeros(3)) @ ball.agent_from_bone_rest
    found = assemble.build(videos, replace(ball, agent_from_bone_rest=turned), SHAPES, 0, "cpu")
    with pytest.raises(InputError, match=r"RCN-003.*another agent template"):
        former.begin(found, videos, folder)


def test_motion_in_another_world_is_refused(made):
    """As after a second walk-through."""
    folder, *_ = made
    videos, elsewhere = films(added()), rigid.make(rigid.rotation_from_yaw(1.0), np.array([1.0, 0, 2]))
    poses = {name: elsewhere @ getattr(videos[0], name) for name in ("world_from_camera", "world_from_agent")}
    found, videos = problem(videos=[replace(videos[0], **poses), *videos[1:]])
    with pytest.raises(InputError, match=r"RCN-003.*v002's cameras moved by \d"):
        former.begin(found, videos, folder)


def test_other_failures_are_not_taken_for_other_sizes(made, monkeypatch):
    def fail(*_):
        raise RuntimeError("out of memory")

    folder, *_ = made
    found, videos = problem(videos=films(added()))
    monkeypatch.setattr(former, "_resample_grid", fail)
    with pytest.raises(RuntimeError, match="out of memory"):
        former.begin(found, videos, folder)
