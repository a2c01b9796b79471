"""The template of a rendered blocky animal: surface, axes, bones and cameras."""

import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from pipeline.core.errors import InputError
from pipeline.data.clips import Clip
from pipeline.geometry import rigid
from pipeline.geometry.meshes import RayCaster
from pipeline.metrics.silhouettes import silhouette_iou
from stages.build_agent_template.canonical import fit_bones
from stages.build_agent_template.config import Config
from stages.build_agent_template.fuse import Silhouettes
from stages.build_agent_template.poses import depth_labels, register_turnaround
from stages.build_agent_template.template import build

_spec = importlib.util.spec_from_file_location(
    "room_with_animal", Path(__file__).parent.parent / "room_with_animal.py"
)
scenery = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(scenery)


class TrueMasks:
    """True masks with the interface of `pipeline.data.clips.Masks`."""

    def __init__(self, masks, folder):
        self.masks, self.folder, self.visible = masks, folder, masks.any((1, 2))

    def __len__(self):
        return len(self.masks)

    def __getitem__(self, frame):
        return np.where(self.masks[frame], 255, 0).astype(np.uint8)


@pytest.fixture(scope="module")
def turnaround(tmp_path_factory):
    folder = tmp_path_factory.mktemp("turnaround") / "frames"
    poses, agent = scenery.turnaround(36)
    truth = scenery.record(folder, poses, agent, scenery.drifted(poses))
    features = np.random.default_rng(0).normal(size=(36, 15, 11, 16)).astype(np.float16)
    return Clip.open(folder), TrueMasks(truth.masks, folder), features, rigid.inverse(agent) @ poses


@pytest.fixture(scope="module")
def template(turnaround):
    clip, masks, features, _ = turnaround
    return build(clip, masks, features, Config(), np.random.default_rng(0))


def true_from_ours(template, turnaround):
    """Transform from our agent frame to the true one, aligned by the cameras."""
    return rigid.make(
        rigid.mean_rotation((turnaround[3] @ rigid.inverse(template.agent_from_camera))[:, :3, :3]),
        np.median((turnaround[3] @ rigid.inverse(template.agent_from_camera))[:, :3, 3], axis=0),
    )


def test_surface_is_closed_and_accurate(template, turnaround):
    mesh = trimesh.Trimesh(template.mesh.vertices, template.mesh.faces, process=False)
    assert mesh.is_watertight
    assert mesh.volume > 0, "faces look outward"
    assert 1000 < len(mesh.vertices) < 4000
    ours = rigid.apply(true_from_ours(template, turnaround), mesh.sample(4000, seed=0))
    true = scenery.animal().sample(20000, seed=0)
    assert cKDTree(true).query(ours)[0].mean() < 0.012, (
        "meters; cells of 8 mm, depth noise of 5 mm, pixels of 11 mm"
    )


def test_axes_point_up_and_to_the_head(template, turnaround):
    turn = true_from_ours(template, turnaround)[:3, :3]
    assert np.degrees(rigid.rotation_angle(turn, np.eye(3))) < 6
    assert template.head_share > 0.6
    assert template.elongation > 1.3


@pytest.mark.parametrize(("turn_deg", "head"), [(180, [0, 0, -1]), (90, [1, 0, 0])])
def test_template_heading_can_be_rotated(turnaround, template, turn_deg, head):
    clip, masks, features, _ = turnaround
    turned = build(clip, masks, features, replace(Config(), turn_deg=turn_deg), np.random.default_rng(0))
    former_from_new = template.agent_from_camera[0, :3, :3] @ turned.agent_from_camera[0, :3, :3].T
    assert np.allclose(former_from_new @ [0, 0, 1], head, atol=1e-6)


def test_cameras_are_accurate(template, turnaround):
    placed = true_from_ours(template, turnaround) @ template.agent_from_camera
    error = np.linalg.norm(placed[:, :3, 3] - turnaround[3][:, :3, 3], axis=1)
    assert np.median(error) < 0.015, "meters; odometry drifts by some centimeters on the circle"
    assert template.coverage_deg > 340


def test_animal_that_turns_during_the_turnaround_is_rejected(turnaround, template):
    """Half of the silhouettes show another pose than the cameras imply."""
    assert np.nanquantile(template.silhouette_iou, 0.1) > 0.7
    clip, masks, *_ = turnaround
    turned = template.agent_from_camera.copy()
    half = len(turned) // 2
    turn = rigid.make(rigid.rotation_from_yaw(np.array(np.pi / 2)), np.zeros(3))
    turned[half:] = turn @ turned[half:]
    caster, frames = RayCaster(template.mesh), range(0, len(turned), 4)
    seen = [silhouette_iou(clip, masks, caster, frame, turned[frame]) for frame in frames]
    assert np.nanquantile(seen, 0.1) < 0.6


def test_skin_and_features_are_normalized(template):
    assert template.weights.shape == (len(template.mesh.vertices), 25)
    assert np.allclose(template.weights.sum(1), 1, atol=1e-5)
    assert np.allclose(np.linalg.norm(template.features, axis=1), 1, atol=1e-3)
    assert np.allclose(np.linalg.det(template.bones.agent_from_bone_rest[:, :3, :3]), 1)


def test_each_limb_has_its_own_bone():
    """Every paw, the head and the tip of the tail belong to different bones."""
    grid = np.stack(np.meshgrid(*[np.arange(-0.4, 0.4, 0.012)] * 3, indexing="ij"), -1).reshape(-1, 3)
    parts = scenery.animal().split()
    inside = grid[
        np.any([np.all((grid > part.bounds[0]) & (grid < part.bounds[1]), axis=1) for part in parts], axis=0)
    ]
    bones = fit_bones(inside, 0.012, Config().bones, np.random.default_rng(0))
    tips = np.array(
        [[x, -0.21, z] for x in (-0.05, 0.05) for z in (-0.16, 0.16)] + [[0, 0.12, 0.28], [0, 0.06, -0.36]]
    )
    nearest = np.linalg.norm(bones.agent_from_bone_rest[None, :, :3, 3] - tips[:, None], axis=-1)
    assert len(set(nearest.argmin(1))) == len(tips)
    assert nearest.min(1).max() < 0.07, "meters from a tip to its bone's center"
    assert (bones.bone_scale_m > 0.01).all()


def test_template_is_deterministic(turnaround, template):
    clip, masks, features, _ = turnaround
    again = build(clip, masks, features, Config(), np.random.default_rng(0))
    assert np.array_equal(again.mesh.vertices, template.mesh.vertices)
    assert np.array_equal(again.weights, template.weights)


def test_silhouettes_ignore_cells_behind_the_observed_surface():
    grid = Silhouettes(np.array([0.0, 0.0, 1.0]), (1, 1, 3), 0.5)
    intrinsics = np.array([[10.0, 0, 2], [0, 10.0, 2], [0, 0, 1]])
    grid.add(np.zeros((4, 4), np.uint8), np.full((4, 4), 1.7, np.float32), intrinsics, np.eye(4))
    grid.add(np.full((4, 4), 255, np.uint8), np.full((4, 4), 1.2, np.float32), intrinsics, np.eye(4))
    assert grid.share_off_mask().reshape(-1).tolist() == [0.5, 0.5, 0.0], (
        "the third cell is behind the surface"
    )


def test_too_few_frames_are_refused(turnaround):
    clip, masks, features, _ = turnaround
    few = TrueMasks(np.where(np.arange(36)[:, None, None] < 5, masks.masks, False), masks.folder)
    with pytest.raises(InputError, match="AGT-001"):
        build(clip, few, features, Config(), np.random.default_rng(0))


def test_turnaround_without_depth_is_refused(turnaround):
    clip, masks, _, _ = turnaround

    class WithoutDepth(Clip):
        def depth(self, frame):
            return np.where(depth_labels(masks[frame], self.depth_size) == 255, 0, super().depth(frame))

    with pytest.raises(InputError, match="AGT-001.*only 0 depth points"):
        register_turnaround(WithoutDepth(**vars(clip)), masks)
