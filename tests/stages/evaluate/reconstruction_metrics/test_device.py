"""A reconstruction is measured on a simulated second device: localizer, fields and LPIPS."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from pipeline.core.videos import Video
from pipeline.data import motion
from pipeline.data.clips import Clip
from pipeline.data.gaussian_ply import SPLATS
from pipeline.data.motion import Motion
from pipeline.data.templates import SceneCameras, SkinTable
from pipeline.fields import fields, gaussians
from pipeline.fields.fields import ArticulatedBody, Field, FieldShape, Reconstruction
from pipeline.geometry import rigid
from stages.evaluate import heldout
from stages.evaluate.config import Config
from stages.evaluate.reading import BuildFolders
from stages.evaluate.reconstruction_metrics import measuring, stage
from tests.pipeline.metrics.test_lpips import write_weights
from tests.simulated_device import DEVICE, simulated_device
from tests.stages import room_with_animal, untrained_localizer
from tests.stages.reconstruct.test_fuse import HIGH, LOW, fused_scene
from tests.stages.refine_gaussians.test_splats import ball

FRAMES, BONES = 5, 2
REST = np.tile(np.eye(4, dtype=np.float32), (BONES, 1, 1))
VIDEOS = (
    Video("v001", "session.r3d", "session", "test", None),
    Video("v002", "heldout.r3d", "heldout", "none", None, "v001", 0.0),
)


@pytest.fixture
def folders(tmp_path: Path) -> BuildFolders:
    """A session and a phone that looks at the animal from a fixed camera."""
    phone = np.tile(
        rigid.look_at(np.array([0.0, 0.6, 1.5]), np.zeros(3), np.array([0.0, 1, 0])), (FRAMES, 1, 1)
    )
    nobody = np.full((FRAMES, 4, 4), np.nan)
    for id in ("v001", "v002"):
        room_with_animal.record(tmp_path / "frames" / id, phone, nobody, phone)
    localizer = untrained_localizer.write(tmp_path / "scene_localizer", "scene")
    return BuildFolders(
        frames={id: tmp_path / "frames" / id for id in ("v001", "v002")}, masks={}, flow={}, truth=None,
        scene_template=tmp_path, agent_template=tmp_path, scene_localizer=localizer, registration=tmp_path,
        reconstruction=tmp_path / "reconstruction", splats=tmp_path / "splats",
    )  # fmt: skip


def write_reconstruction(folders: BuildFolders, fused: bool) -> None:
    """Write untrained fields, whose animal is a box, and Gaussians."""
    small, high = (-0.15,) * 3, (0.15,) * 3
    shape = FieldShape(
        LOW, HIGH, (0.5,), videos=3, truncation_m=0.1 if fused else None, starts_as_box=not fused
    )
    agent = FieldShape(small, high, (0.1,))
    body = ArticulatedBody(torch.from_numpy(REST), torch.full((BONES, 3), 0.1), agent)
    scene = Field(shape, 0.0, fused_scene() if fused else None)
    still = np.tile(np.eye(4), (FRAMES, 1, 1))
    bones = np.tile(REST.astype(np.float64), (FRAMES, 1, 1, 1))
    known = np.ones(FRAMES)
    moved = Motion(0.1 * np.arange(FRAMES), still, still, bones, known, known > 0)
    for folder in (folders.reconstruction / "v001", folders.splats):
        folder.mkdir(parents=True)
    fields.save(folders.reconstruction, Reconstruction(scene, Field(agent, -0.1), body, ("v001", "b", "c")))
    motion.save(folders.reconstruction / "v001/motion.npz", moved)
    SkinTable(np.ones((1, BONES), np.float32), REST, np.ones((BONES, 3), np.float32)).write(
        folders.reconstruction
    )
    cloud = ball(0.2, 40)
    chosen = torch.arange(len(cloud)) > 0
    for name, drawn in (("scene", chosen), ("moved", ~chosen), ("agent", chosen)):
        gaussians.save_ply(folders.splats / f"{name}.ply", cloud, drawn)
    SPLATS.save(
        folders.splats / "splats.npz", agent_weights=np.full((len(cloud) - 1, BONES), 0.5, np.float32),
        agent_from_bone_rest=REST, videos=np.array(["v001"]), stands=np.ones((1, len(cloud)), bool),
        appearance=np.zeros((1, 3, 4), np.float32),
    )  # fmt: skip


@pytest.mark.parametrize("fused", [True, False])
def test_a_real_capture_is_measured_on_another_device(folders, fused, tmp_path, monkeypatch):
    monkeypatch.setattr(heldout, "RENDERED_PIXELS", 400)
    write_reconstruction(folders, fused)
    out, weights = tmp_path / "out", tmp_path / "weights"
    for folder in (out, weights):
        folder.mkdir()
    write_weights(weights)
    config = Config(heldout_frames=1, lpips_weights=str(weights))
    with simulated_device():
        found = stage.run(folders, config, out, device=DEVICE, videos=VIDEOS)
    names = [f"reconstruction/{kind}_all" for kind in ("depth_acc", "rendered_depth_acc", "psnr", "lpips")]
    values = [found.values[name] for name in (*names, "splats/psnr_all")]
    assert np.isfinite(np.array(values, float)).all(), found.reasons
    assert found.reasons["reconstruction/heldout_cameras"] == "from registration: 5 of 5 single frames agree"


def test_single_frames_are_localized_on_another_device(folders, monkeypatch):
    clip = Clip.open(folders.frames["v001"])
    cameras = np.tile(np.eye(4), (FRAMES, 1, 1))
    known = np.ones(FRAMES, bool)
    SceneCameras(clip.timestamp_s, cameras, clip.intrinsics, known, known).write(folders.scene_template)
    walkthrough = SimpleNamespace(clip=clip)
    session = SimpleNamespace(clip=clip, truth=None, video=VIDEOS[0])
    frames = SimpleNamespace(cameras=lambda truth: cameras)
    monkeypatch.setattr(
        measuring.Masks, "open", lambda folder: np.zeros((FRAMES, *clip.color_size), np.uint8)
    )
    folders = replace(folders, masks={"v001": Path()})
    with simulated_device():
        found = measuring._single_frames(
            folders, walkthrough, [session], frames, Config(localizer_frames=1), DEVICE
        )
    assert found.values["localizer/rotation_deg_median"] is not None
