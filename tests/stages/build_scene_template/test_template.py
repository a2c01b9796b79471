"""From walk-through to metric, upright template: structure from motion and its validation, refinement,
fusion, cleaning.
"""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from pipeline.core.errors import InputError
from pipeline.data import ply as mesh_files
from pipeline.geometry import ground, rigid, tsdf
from pipeline.geometry.meshes import Mesh, RayCaster
from pipeline.mapping import depth_scans
from pipeline.mapping.bundle_adjustment import TrackedPoints
from pipeline.mapping.colmap import SparseModel
from stages.build_scene_template import anchor, fuse, refine, sfm, template
from stages.build_scene_template.config import Config, FusionConfig, RefinementConfig, SfmConfig
from tests.stages.textured_room import MemoryClip, aligned_errors, drifting, textured_room, walk

NO_POINTS = TrackedPoints(*np.zeros((2, 0), int), *np.zeros((3, 0, 2)), *np.zeros((2, 0)), np.zeros(0, int))
SFM = SfmConfig(max_keyframes=16, features=600, overlap=4, loops_per_keyframe=1)


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> MemoryClip:
    truth = walk(48)
    folder = tmp_path_factory.mktemp("walk")
    made = MemoryClip(RayCaster(textured_room()), truth, drifting(truth, 1), folder=folder)
    made.write_color(folder)
    return made


@pytest.mark.slow
def test_template_is_metric_upright_and_accurate(clip, tmp_path):
    fusion = FusionConfig(voxel_m=0.05, truncation_m=0.15, island_faces=30, feature_frames=6)
    config = Config(sfm=SFM, refinement=RefinementConfig(rounds=6), fusion=fusion)
    features = np.random.default_rng(0).normal(size=(len(clip), 20, 15, 16))
    made, sparse = template.build(clip, features, config, tmp_path)
    rotation, distance = aligned_errors(made.world_from_camera, clip.truth)
    assert np.median(rotation) < 0.5, "degrees"
    assert np.median(distance) < 0.015, "meters, without any scale"
    assert made.start.source == "colmap"
    assert abs(made.odometry_scale - 1) < 0.05
    assert len(sparse.frame) >= 10
    up_error = (
        made.world_from_camera[:, :3, :3] @ np.swapaxes(clip.truth[:, :3, :3], 1, 2) @ np.array([0, 1.0, 0])
    )
    assert np.rad2deg(np.arccos(up_error[:, 1])).max() < 1.5, "degrees between the world's +y and gravity"
    camera_height = made.world_from_camera[:, 1, 3].mean() - made.floor_m
    assert abs(camera_height - clip.truth[:, 1, 3].mean()) < 0.06, "meters above the floor"
    assert (np.linalg.norm(made.features, axis=1) > 0.9).mean() > 0.5
    template.write_model(sparse, made.world_from_camera, tmp_path / "colmap")
    assert (tmp_path / "colmap" / "images.txt").exists()


def test_floor_is_the_middle_of_the_lowest_noisy_surface():
    rng, size = np.random.default_rng(0), 40
    x, z = (each.ravel() for each in np.meshgrid(np.arange(size), np.arange(size), indexing="ij"))
    corner = np.flatnonzero((x < size - 1) & (z < size - 1))
    faces = np.concatenate([corner[:, None] + [0, 1, size], corner[:, None] + [1, size + 1, size]])
    floor = np.stack([0.2 * x, rng.normal(-0.7, 0.03, len(x)), 0.2 * z], axis=1)
    table = floor + np.array([0, 0.75, 0])
    surface = Mesh(np.concatenate([floor, table]).astype(np.float32), np.concatenate([faces, faces + len(x)]))
    assert abs(template.floor_height(surface) + 0.7) < 0.01


def test_scale_of_odometry_is_robust_to_noise_and_lost_frames():
    world, rng = walk(60), np.random.default_rng(0)
    odometry = world.copy()
    odometry[:, :3, 3] = 1.1 * (world[:, :3, 3] @ rigid.rotation_from_yaw(0.7).T + 3) + rng.normal(
        0, 0.02, (60, 3)
    )
    odometry[20:24, :3, 3] += 1.0
    lengths = [np.linalg.norm(np.diff(pose[:, :3, 3], axis=0), axis=1).sum() for pose in (odometry, world)]
    assert lengths[0] / lengths[1] > 1.2
    clip = MemoryClip(None, world, odometry)
    world[30:] = np.nan
    assert anchor.odometry_scale(clip, world) == pytest.approx(1.1, abs=0.02)
    world[1:] = np.nan
    assert anchor.odometry_scale(clip, world) is None


def test_points_per_frame_are_limited_by_memory(clip, monkeypatch):
    taken, correspondences = [], fuse.depth_scans.SurfaceMap.correspondences

    def counted(surface, frames, scans, poses, reach_m, inflation):
        taken.append(sum(len(scan.sigma_m) for scan in scans))
        return correspondences(surface, frames, scans, poses, reach_m, inflation)

    monkeypatch.setattr(fuse.depth_scans.SurfaceMap, "correspondences", counted)
    start = clip.truth @ rigid.exp(np.random.default_rng(0).normal(0, 0.01, (len(clip), 6)))
    monkeypatch.setattr(fuse, "ALIGN_POINTS", 48 * 60)
    _, gap, _ = fuse.align_frames(clip, clip.caster.mesh, start, FusionConfig())
    assert max(taken) <= 48 * 60
    assert np.nanmedian(gap) < 0.006, "meters; the depth noise is 4 mm, the cameras began 1.6 cm off"


def test_misplaced_frames_are_not_registered(clip):
    """Depth near some surface is not enough: a misplaced frame always has floor within reach."""
    start, lost = clip.truth.copy(), np.arange(len(clip)) >= 36
    start[lost] = rigid.make(rigid.rotation_from_yaw(np.deg2rad(60)), np.array([0.4, 0, 0.3])) @ start[lost]
    poses, gap, fit = fuse.align_frames(
        replace(clip, odometry_from_camera=None), clip.caster.mesh, start, FusionConfig()
    )
    far = np.linalg.norm(poses[:, :3, 3] - clip.truth[:, :3, 3], axis=1) > 0.1
    assert (far == lost).all(), "meters; alignment does not find them back"
    assert (fuse.registered(fit) == ~lost).all()
    assert gap[lost].max() < 0.01, (
        "meters; the median does not show it: half of the points still lie on floor or wall"
    )


def test_frames_that_hardly_measured_anything_are_not_registered():
    assert fuse.registered(np.array([0.9, np.nan, 1.0, 0.0, 0.7, 0.95])).tolist() == [1, 0, 1, 0, 0, 1]
    assert not fuse.registered(np.array([0.0, np.nan, 0.0])).any()


@pytest.mark.slow
def test_misplaced_frames_leave_no_trace_in_the_map(clip, tmp_path, monkeypatch):
    """Surface and features come from registered frames alone."""
    align = fuse.align_frames

    def lost(clip, mesh, poses, config, frames):
        poses, gap, fit = align(clip, mesh, poses, config, frames)
        poses[40:, :3, 3] += 5.0
        fit[40:] = 0.3
        return poses, gap, fit

    monkeypatch.setattr(fuse, "align_frames", lost)
    fusion = FusionConfig(voxel_m=0.06, truncation_m=0.18, island_faces=30, feature_frames=3, align_rounds=2)
    config = Config(sfm=SFM, refinement=RefinementConfig(rounds=2), fusion=fusion)
    made, _ = template.build(clip, np.ones((len(clip), 20, 15, 2)), config, tmp_path)
    assert (np.flatnonzero(~made.registered) == np.arange(40, 48)).all()
    assert np.ptp(made.mesh.vertices, axis=0).max() < 3.5, "meters: the room, and no second one beside it"


def test_wrong_structure_is_rejected_by_depth(clip):
    frames = np.arange(0, 48, 4)
    keyframes = [refine.load_keyframe(clip, int(frame)) for frame in frames]
    bent = clip.truth[frames].copy()
    bent[:, 0, 3] += np.linspace(0, 2.0, len(frames)) ** 2
    rows = np.arange(len(frames) * 40)
    key, pixel = rows % len(frames), np.random.default_rng(0).uniform(20, 100, (len(rows), 2))
    points = np.stack(
        [sfm.back_project(clip, int(frames[k]), p[None])[0] for k, p in zip(key, pixel, strict=True)]
    )
    world = np.stack([rigid.apply(bent[k], p[None])[0] for k, p in zip(key, points, strict=True)])
    sparse = SparseModel(frames, bent, world, rows, key, pixel, 0.5, None)
    start = anchor.choose_trajectory(clip, frames, keyframes, sparse)
    assert start.source == "odometry"
    assert "depth" in start.reason


def test_keyframes_are_refined_by_depth_and_odometry_alone(clip):
    frames = np.arange(0, 48, 4)
    keyframes = [refine.load_keyframe(clip, int(frame)) for frame in frames]
    start = clip.odometry_from_camera[frames]
    found = refine.refine_keyframes(clip, frames, keyframes, start, NO_POINTS, RefinementConfig())
    before, after = aligned_errors(start, clip.truth[frames])[1], aligned_errors(found, clip.truth[frames])[1]
    assert np.median(after) < 0.013, (
        "meters; points at rims, which hold a small room's furniture, do not count"
    )
    assert np.median(after) < 0.7 * np.median(before)


@pytest.fixture(scope="module")
def matched(clip, tmp_path_factory):
    """Return a workspace with matched keyframes."""
    workspace = tmp_path_factory.mktemp("matched")
    sfm.reconstruct(clip, SFM, workspace, 0)
    return workspace


def test_systematic_depth_errors_do_not_bend_keyframes(clip, matched):
    """The depth error grows towards the image border; tracked points contradict it."""
    bent = MemoryClip(clip.caster, clip.truth, clip.odometry_from_camera, folder=clip.folder)
    row, column = np.mgrid[: clip.depth_size[0], : clip.depth_size[1]]
    rim = np.hypot(row - 80, column - 60) / 100
    for frame in range(len(bent)):
        color, depth = clip.color(frame), clip.depth(frame)
        bent.cache[frame] = color, (depth * (1 + 0.06 * rim**2)).astype(np.float32)
    frames = sfm.choose_keyframes(clip, SFM)
    keyframes = [refine.load_keyframe(bent, int(frame)) for frame in frames]
    tracked = sfm.tracked_points(bent, matched / sfm.DATABASE, frames)
    start = clip.odometry_from_camera[frames]
    errors = {
        points: aligned_errors(
            refine.refine_keyframes(bent, frames, keyframes, start, given, RefinementConfig()),
            clip.truth[frames],
        )[1]
        for points, given in {"with": tracked, "without": NO_POINTS}.items()
    }
    assert np.median(errors["with"]) < 0.8 * np.median(errors["without"])
    poses, *_ = fuse.align_frames(bent, clip.caster.mesh, clip.truth, FusionConfig(), frames)
    assert np.array_equal(poses[frames], clip.truth[frames]), "keyframes that depth contradicts stay"


def test_tracked_points_lie_on_the_room(clip, matched):
    frames = sfm.choose_keyframes(clip, SFM)
    tracked = sfm.tracked_points(clip, matched / sfm.DATABASE, frames)
    assert tracked.points > 100
    assert np.bincount(tracked.point).min() >= 2
    pairs = np.stack([tracked.camera, tracked.point])
    assert len(np.unique(pairs, axis=1).T) == len(tracked.camera), "no point twice in a keyframe"
    gap = clip.caster.mesh.vertices[:, None, 1].min() - tracked.unproject(clip.truth[frames])[:, 1]
    assert np.quantile(gap, 0.95) < 0.05, "meters below the floor"


def test_both_sides_of_a_thin_wall_are_kept_apart():
    """Two cameras face each other through a wall of 8 cm, which is less than the search radius."""
    depth = np.full((60, 80), 1.0)
    lens = np.array([[70.0, 0, 40], [0, 70.0, 30], [0, 0, 1]])
    scan = depth_scans.scan(depth, lens, stride=4)
    normals = depth_scans.image_normals(depth, lens)
    inner = np.abs(normals.reshape(-1, 3)[scan.pixel_index]).sum(1) > 0
    scan = depth_scans.Scan(scan.points_camera[inner], scan.sigma_m[inner], scan.pixel_index[inner])
    key = refine.Keyframe(scan, depth, normals, lens)
    across = rigid.make(rigid.rotation_from_vector(np.array([0, np.pi, 0])), np.array([0, 0, 2.08]))
    poses = np.stack([np.eye(4), across, np.eye(4)])
    facing = refine.depth_correspondences([key] * 3, np.array([[0, 1], [1, 0]]), poses, 0.15)
    beside = refine.depth_correspondences([key] * 3, np.array([[0, 2]]), poses, 0.15)
    assert len(facing.first) == 0
    assert len(beside.first) > 50


def test_propagation_is_exact_where_odometry_is(clip):
    exact = MemoryClip(clip.caster, clip.truth, drifting(clip.truth, 3, deg=0, m=0))
    frames = np.array([3, 17, 40])
    assert np.abs(anchor.propagate(exact, frames, clip.truth[frames]) - clip.truth).max() < 1e-9


def test_floor_direction_is_found_from_normals():
    rng = np.random.default_rng(0)
    turn = rigid.rotation_from_vector(np.array([0.2, 0.4, -0.15]))
    walls = np.concatenate([np.repeat(np.eye(3), 200, axis=0), -np.repeat(np.eye(3), 100, axis=0)]) @ turn.T
    normals = np.concatenate([walls, rng.normal(size=(200, 3))])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    up = ground.floor_direction(normals, np.array([0.0, 1.0, 0.0]))
    assert np.rad2deg(np.arccos(up @ turn[:, 1])) < 1.0, "degrees"


def test_cleaning_removes_islands_and_keeps_colors(tmp_path):
    volume = tsdf.Volume(np.zeros(3), (40, 40, 40), 0.05, 0.15)
    grid = np.stack(np.meshgrid(*[np.arange(40) * 0.05] * 3, indexing="ij"), -1)
    big, small = np.linalg.norm(grid - 0.9, axis=-1) - 0.5, np.linalg.norm(grid - 1.7, axis=-1) - 0.1
    volume.distance[:] = np.clip(np.minimum(big, small) / 0.15, -1, 1)
    volume.weight[:] = volume.color_weight[:] = 1
    volume.color[:] = (200, 30, 90)
    mesh = volume.surface(0.0)
    cleaned = fuse.clean(mesh, tmp_path, island_faces=200)
    assert cleaned is not None
    assert len(cleaned.faces) < len(mesh.faces)
    assert np.linalg.norm(cleaned.vertices - 0.9, axis=1).max() < 0.6, "the small sphere is gone"
    assert (cleaned.color == (200, 30, 90)).all()
    mesh_files.write_ply(tmp_path / "again.ply", Mesh(cleaned.vertices, cleaned.faces, cleaned.color))
    (tmp_path / "only_islands").mkdir()
    assert fuse.clean(mesh, tmp_path / "only_islands", island_faces=len(mesh.faces)) is None


def test_failure_of_the_cleaner_is_reported(tmp_path, monkeypatch):
    monkeypatch.setattr(fuse.sys, "executable", "/bin/false")
    with pytest.raises(InputError, match="MAP-003"):
        fuse.clean(textured_room(edge_m=0.5), tmp_path, island_faces=2)


@pytest.mark.parametrize("code", ["MAP-001", "MAP-002"])
def test_walkthrough_without_content_is_refused(code, tmp_path, monkeypatch):
    """Darkness without odometry; or odometry with depth out of range."""
    truth = walk(10)
    dark = MemoryClip(
        RayCaster(textured_room(edge_m=0.5)),
        truth,
        None if code == "MAP-001" else truth,
        folder=tmp_path / "walk",
    )
    for frame in range(len(dark)):
        far = np.where(dark.depth(frame) > 0, 4.9 if code == "MAP-002" else 0, 0).astype(np.float32)
        dark.cache[frame] = np.zeros((*dark.color_size, 3), np.uint8), far
    dark.write_color(tmp_path / "walk")
    config = Config(sfm=SFM, refinement=RefinementConfig(rounds=1), fusion=FusionConfig(voxel_m=0.1))
    with pytest.raises(InputError, match=code):
        template.build(dark, np.zeros((len(dark), 4, 4, 2)), config, tmp_path)


def test_empty_volume_marks_nothing_as_observed():
    empty = tsdf.Volume(np.zeros(3), (8, 8, 8), 0.1, 0.3).surface(0.0)
    assert len(empty.faces) == 0


def test_false_matches_are_rejected_by_depth(clip, tmp_path):
    sfm.reconstruct(clip, SFM, tmp_path, 0)
    with pycolmap.Database.open(tmp_path / "database.db") as table:
        pairs = sorted(pycolmap.pair_id_to_image_pair(pair) for pair in table.read_two_view_geometries()[0])
        geometry = table.read_two_view_geometry(*pairs[0])
        wrong = geometry.inlier_matches.copy()
        wrong[:, 1] = np.random.default_rng(0).permutation(wrong[:, 1])
        geometry.inlier_matches = wrong
        table.delete_two_view_geometry(*pairs[0])
        table.write_two_view_geometry(*pairs[0], geometry)
    confirmed, all_pairs = sfm.verify_matches(clip, tmp_path / "database.db", np.random.default_rng(0))
    assert all_pairs == len(pairs)
    assert confirmed == len(pairs) - 1, "the scrambled pair goes, the others stay"


def test_huge_scene_is_refused(clip, monkeypatch):
    monkeypatch.setattr(fuse, "MAX_VOXELS", 1000)
    with pytest.raises(InputError, match="MAP-005.*the walk-through spans"):
        fuse.fuse(clip, np.arange(0, 48, 4), clip.truth, FusionConfig(voxel_m=0.05))
