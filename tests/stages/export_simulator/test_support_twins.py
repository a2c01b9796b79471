"""The page projects paths to the support and to free space exactly as Python does."""

import json
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from pipeline.behavior.path_encoding import REST_SPEED_M_S
from pipeline.behavior.perception import FeatureVolume
from pipeline.behavior.scenes import SceneConstraint, Scenes
from pipeline.behavior.support import Support, mark_supported
from pipeline.behavior.trajectories import RATE_HZ, PoseFrames, blended_frames
from pipeline.geometry import rigid
from stages.export_simulator.reading import support_contract

SOURCES = Path(__file__).parents[3] / "stages/export_simulator/web/src"
ASK = """
import { FreeSpace } from '%(sources)s/clearing.js';
import { Senses } from '%(sources)s/senses.js';
import { Support } from '%(sources)s/support.js';
import { Timeline } from '%(sources)s/timeline.js';
const { volume, marks, paths, fastest } = JSON.parse(await new Response(process.stdin).text());
const senses = Object.create(Senses.prototype);
const allowed = Uint8Array.from(marks);
const space = new FreeSpace(volume, allowed);
Object.assign(senses, { volume, space, support: new Support(volume, allowed) });
console.log(JSON.stringify(paths.map((path) => %(answer)s)));
"""
needs_node = pytest.mark.skipif(shutil.which("node") is None, reason="needs node")


def run_node(script: str, **asked: object) -> np.ndarray:
    """Return the output of a script for an input on stdin."""
    node = ["node", "--no-warnings", "--input-type=module", "-e", script]
    answer = subprocess.run(node, input=json.dumps(asked), capture_output=True, text=True, check=True)
    return np.array(json.loads(answer.stdout))


def page_answers(
    answer: str, scene: FeatureVolume, marks: np.ndarray, paths: np.ndarray, **more: object
) -> np.ndarray:
    """Return paths as projected by the page, in a scene with marks of support or allowed voxels."""
    volume = {"shape": [1, *marks.shape], "origin": scene.origin.tolist(), "voxel_m": scene.voxel_m}
    asked = {"volume": volume | more, "marks": marks.ravel().astype(int).tolist(), "paths": paths.tolist()}
    return run_node(ASK % {"sources": SOURCES, "answer": answer}, fastest=REST_SPEED_M_S / RATE_HZ, **asked)


def scene_of(occupancy: np.ndarray, origin: tuple[float, float, float]) -> FeatureVolume:
    """Return a scene with voxels of 0.1 m."""
    features = np.zeros((1, *occupancy.shape), np.float32)
    return FeatureVolume(features, occupancy.astype(np.uint8), np.array(origin), 0.1)


@needs_node
def test_page_and_python_place_paths_on_the_same_support():
    rng = np.random.default_rng(0)
    occupancy = (rng.random((12, 8, 12)) < 0.2).astype(np.uint8)
    occupancy[:, 0] = 1
    scene = scene_of(occupancy, (-0.6, -0.1, -0.6))
    marks, range_m = mark_supported(occupancy == 0, occupancy), np.array([[0.05, 0.14], [0.08, 0.12]])
    paths = np.cumsum(rng.normal(0, [0.02, 0.01, 0.02], (20, 57, 3)), axis=1)
    paths[..., 1] += 0.3
    scenes = Scenes((scene,), (marks > 0,), np.zeros(1, int), (Support.of(scene, marks, range_m),))
    ours = SceneConstraint(scenes, np.tile(np.eye(4), (20, 1, 1)), None).on_support(paths[:, 1:], paths[:, 0])
    follow = "senses.support.follow(path.slice(1), path[0], fastest)"
    theirs = page_answers(follow, scene, marks, paths, support=support_contract(range_m))
    np.testing.assert_allclose(theirs, ours, atol=1e-9)
    assert np.abs(ours - paths[:, 1:])[..., 1].max() > 0.02


def moved_as_far(
    scene: FeatureVolume, points: np.ndarray, ours: np.ndarray, theirs: np.ndarray
) -> np.ndarray:
    """Return which points were moved to the same voxel; where several are as near, they may differ."""
    own, mine, other = (scene.voxel(part)[0] for part in (points, ours, theirs))
    np.testing.assert_array_equal(*(((part - own) ** 2).sum(-1) for part in (mine, other)))
    return (mine == other).all(-1)


@needs_node
@pytest.mark.parametrize("free", [0.02, 0.5, 0.0])
def test_page_and_python_project_points_to_the_same_free_space(free):
    rng = np.random.default_rng(1)
    allowed = rng.random((12, 7, 9)) < free
    scene = scene_of(~allowed, (-0.6, -0.1, 0.3))
    points = scene.origin + rng.uniform(-0.2, 1.4, (30, 5, 3))
    ours = Scenes((scene,), (allowed,), np.zeros(1, int)).out_of_solid(points, None)
    theirs = page_answers("path.map((point) => space.cleared(point))", scene, allowed, points)
    if not free:
        np.testing.assert_array_equal(theirs, points)
        return
    assert allowed[tuple(np.moveaxis(scene.voxel(theirs)[0], -1, 0))].all()
    same = moved_as_far(scene, points, ours, theirs)
    np.testing.assert_allclose(theirs[same], ours[same], atol=1e-12)
    assert same.mean() > 0.7


def each_row(*frames: PoseFrames) -> Iterator[list[PoseFrames]]:
    """Yield the frames of one plan after the other."""
    for row in range(len(frames[0].root)):
        yield [PoseFrames(each.root[row], each.bones[row]) for each in frames]


@needs_node
def test_page_and_python_project_blends_of_plans_to_the_same_free_space():
    """Two plans pass pillars on different sides; a new one fades in over four ticks from tick 5."""
    rng, frames = np.random.default_rng(3), 12
    allowed = np.ones((30, 6, 30), bool)
    for x, z in rng.integers(1, 28, (60, 2)):
        allowed[x : x + 2, :, z : z + 2] = False
    scene = scene_of(~allowed, (-1.5, 0, -1.5))
    scenes = Scenes((scene,), (allowed,), np.zeros(1, int))
    begin, end = rng.uniform([-1, 0.2, -1], [1, 0.4, 1], (2, 80, 2, 1, 3))
    plans = begin + (end - begin) * np.linspace(0, 1, frames)[:, None]
    plans = scenes.out_of_solid(plans, None).astype(np.float32)
    roots = rigid.make(np.eye(3), plans.astype(float))
    old, new = (PoseFrames(part, np.zeros((80, 7, 0))) for part in (roots[:, 0, 5:], roots[:, 1, :7]))
    blend = np.stack([blended_frames(*both, 4).root[..., :3, 3] for both in each_row(old, new)])
    theirs = page_answers(
        """(() => {
          const rows = path.map((plan) => plan.map((place) => Float32Array.of(...place, 1, 0, 0, 0)));
          const timeline = new Timeline([rows[0][0]], 4, 0, (place) => space.cleared(place));
          timeline.follow(0, rows[0], -9);
          timeline.follow(5, rows[1], 5);
          return [6, 7, 8, 9, 10, 11, 12].map((tick) => Array.from(timeline.at(tick).subarray(0, 3)));
        })()""",
        scene,
        allowed,
        plans,
    )
    assert scenes.inside_solid(blend, None).mean() > 0.05, "blends of plans cut pillars"
    assert not scenes.inside_solid(theirs, None).any()
    ours = scenes.out_of_solid(blend, None)
    same = moved_as_far(scene, blend, ours, theirs)
    np.testing.assert_allclose(theirs[same], ours[same], atol=1e-6)
    assert same.mean() > 0.9 and (np.abs(ours - blend)[same] > 0.01).any(), "meters"


@needs_node
def test_page_and_python_rotate_the_same_goals_to_free_space():
    rng = np.random.default_rng(2)
    allowed = rng.random((30, 5, 30)) < 0.3
    scene = scene_of(~allowed, (-1.5, 0, -1.5))
    start = rng.uniform([-0.5, 0, -0.5], [0.5, 0.5, 0.5], (60, 3))
    goals = rng.uniform([-1.5, 0, -1.5], [1.5, 0.5, 1.5], (60, 3))
    scenes = Scenes((scene,), (allowed,), np.zeros(1, int))
    ours = SceneConstraint(scenes, np.tile(np.eye(4), (60, 1, 1)), None).goals_on_support(goals, start)
    ends = np.stack([goals, start], axis=1)
    theirs = page_answers("senses.turnedFree(path[0], path[1])", scene, allowed, ends)
    as_far = np.isclose(*(np.linalg.norm(end - start, axis=1) for end in (ours, goals)))
    assert as_far.mean() > 0.9 and not scenes.inside_solid(ours[:, None], None).any()
    assert (np.linalg.norm(ours - goals, axis=1)[as_far] > 0.01).any()
    np.testing.assert_allclose(theirs[as_far], ours[as_far], atol=1e-12)
