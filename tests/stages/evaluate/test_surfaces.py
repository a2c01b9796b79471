"""Exact distances between surfaces; the animal is compared in frames with a known pose, whose fraction is
reported.
"""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from pipeline.data import ply
from pipeline.data.motion import INTERPOLATED, Motion
from pipeline.data.templates import SkinTable
from pipeline.geometry.meshes import Mesh
from pipeline.metrics.surface_distance import TriangleSurface, chamfer, split
from stages.evaluate import reconstruction
from stages.evaluate.config import Config
from stages.evaluate.reading import Reconstructed

BALL = trimesh.creation.icosphere(subdivisions=3, radius=0.2)
FRAMES = 6
RNG = np.random.default_rng(0)


def plane(height_m: float) -> TriangleSurface:
    """Return a floor of 120 square meters as two triangles."""
    corner = np.array([[0, height_m, 0], [12, height_m, 0], [12, height_m, 10], [0, height_m, 10.0]])
    return TriangleSurface(corner[[[0, 1, 2], [0, 2, 3]]])


def soup(count: int) -> np.ndarray:
    """Return triangles between a centimeter and a meter, some of them degenerate."""
    corner = RNG.normal(0, 1, (count, 1, 3)) + RNG.normal(0, 1, (count, 3, 3)) * 10 ** RNG.uniform(
        -2, 0, (count, 1, 1)
    )
    corner[: count // 10, 2] = corner[: count // 10, :2].mean(1)
    corner[0] = corner[0, 0]
    return corner


def test_distances_are_exact():
    corner, points = soup(60), RNG.normal(0, 2, (300, 3))
    true = [
        np.linalg.norm(
            trimesh.triangles.closest_point(corner[6:], np.tile(point, (54, 1))) - point, axis=1
        ).min()
        for point in points
    ]
    np.testing.assert_allclose(TriangleSurface(corner[6:]).distance(points), true, atol=1e-12)
    assert (TriangleSurface(corner).distance(points) <= np.array(true) + 1e-12).all(), (
        "triangles without an inside count as lines"
    )


def test_subdivision_keeps_the_surface():
    corner = soup(60)
    pieces = split(corner, 0.1)
    assert np.linalg.norm(np.roll(pieces, -1, axis=1) - pieces, axis=-1).max() <= 0.1
    assert len(split(pieces, 0.1)) == len(pieces)
    area = [
        np.linalg.norm(np.cross(part[:, 1] - part[:, 0], part[:, 2] - part[:, 0]), axis=1).sum()
        for part in (corner, pieces)
    ]
    assert area[0] == pytest.approx(area[1])


@pytest.mark.parametrize("apart_m", [0.0, 0.01, 2.0])
def test_distance_of_parallel_planes(apart_m: float):
    assert chamfer(plane(0.0), plane(apart_m), 2000, RNG) == pytest.approx(apart_m, abs=1e-9)


def test_distance_of_a_surface_to_itself_is_zero():
    ball = TriangleSurface(BALL.triangles)
    assert chamfer(ball, ball, 2000, RNG) < 1e-12, "meters"
    assert chamfer(ball, TriangleSurface(1.05 * BALL.triangles), 2000, RNG) == pytest.approx(0.01, abs=3e-4)


def motion_of(confidence: np.ndarray) -> Motion:
    """Return a resting animal."""
    rest = np.tile(np.eye(4), (FRAMES, 1, 1))
    return Motion(0.1 * np.arange(FRAMES), rest, rest, rest[:, None], confidence, confidence > INTERPOLATED)


def test_fraction_of_compared_frames_is_reported(tmp_path: Path):
    ball = Mesh(BALL.vertices.astype(np.float32), BALL.faces.astype(np.int32))
    for path in (tmp_path / "agent.ply", tmp_path / "truth" / "agent.ply"):
        path.parent.mkdir(exist_ok=True)
        ply.write_ply(path, ball)
    SkinTable(np.ones((len(ball.vertices), 1)), np.eye(4)[None], np.ones((1, 3))).write(tmp_path)
    truth = SimpleNamespace(
        agent_visible=np.ones(FRAMES, bool), vertices_world=lambda frame: ball.vertices.astype(float)
    )
    sessions = [SimpleNamespace(video=SimpleNamespace(id=id), truth=truth) for id in ("v002", "v003")]
    motions = {
        "v002": motion_of(np.array([0.9, 0.9, 0.9, INTERPOLATED, INTERPOLATED, INTERPOLATED])),
        "v003": None,
    }
    folders = Reconstructed(
        frames={},
        scene_template=tmp_path,
        agent_template=tmp_path,
        reconstruction=tmp_path,
        truth=tmp_path / "truth",
    )
    config, frames = Config(surface_frames=FRAMES), SimpleNamespace(world_from_true_world=np.eye(4))
    values = reconstruction._agent_chamfer(folders, sessions, motions, frames, config, RNG).values
    assert values["reconstruction/agent_chamfer_share"] == pytest.approx(3 / 12)
    assert values["reconstruction/agent_chamfer_m"] < 1e-6, "meters"
    nobody = reconstruction._agent_chamfer(
        folders, sessions, dict.fromkeys(motions), frames, config, RNG
    ).values
    assert nobody == {"reconstruction/agent_chamfer_m": None, "reconstruction/agent_chamfer_share": 0}
