"""The animal's surface is compared where its pose is known, and in what share of the frames that is is told."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from pipeline.files import arrays, meshes
from pipeline.models.motion import INFERRED, Motion
from pipeline.space.meshes import Mesh
from stages.evaluate import reconstruction

BALL = trimesh.creation.icosphere(subdivisions=3, radius=0.2)
FRAMES = 6


def motion_of(confidence: np.ndarray) -> Motion:
    """Return an animal that stays where it is."""
    rest = np.tile(np.eye(4), (FRAMES, 1, 1))
    return Motion(0.1 * np.arange(FRAMES), rest, rest, rest[:, None], confidence, confidence > INFERRED)


def test_the_share_of_frames_in_which_the_animal_is_compared_is_told(tmp_path: Path):
    ball = Mesh(BALL.vertices.astype(np.float32), BALL.faces.astype(np.int32))
    for path in (tmp_path / "agent.ply", tmp_path / "truth" / "agent.ply"):
        path.parent.mkdir(exist_ok=True)
        meshes.write_ply(path, ball)
    arrays.save(tmp_path / "skin.npz", weights=np.ones((len(ball.vertices), 1), "f4"), agent_from_bone_rest=np.eye(4, dtype="f4")[None])
    truth = SimpleNamespace(agent_visible=np.ones(FRAMES, bool), vertices_world=lambda frame: ball.vertices.astype(float))
    sessions = [SimpleNamespace(video=SimpleNamespace(id=id), truth=truth) for id in ("v002", "v003")]
    motions = {"v002": motion_of(np.array([0.9, 0.9, 0.9, INFERRED, INFERRED, INFERRED])), "v003": None}
    folders = SimpleNamespace(reconstruction=tmp_path, truth=tmp_path / "truth")
    effort, frames = SimpleNamespace(surface_frames=FRAMES), SimpleNamespace(world_from_true_world=np.eye(4))
    values = reconstruction._agent_chamfer(folders, sessions, motions, frames, effort).values
    assert values["reconstruction/agent_chamfer_share"] == pytest.approx(3 / 12)
    assert values["reconstruction/agent_chamfer_m"] < 1e-4, "metres"
    nobody = reconstruction._agent_chamfer(folders, sessions, dict.fromkeys(motions), frames, effort).values
    assert nobody == {"reconstruction/agent_chamfer_m": None, "reconstruction/agent_chamfer_share": 0}
