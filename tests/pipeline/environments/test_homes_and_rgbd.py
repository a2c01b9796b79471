"""Several homes in one world, and rendered RGB-D observations of persons."""

import shutil

import numpy as np
import pytest
import trimesh

from pipeline.core.errors import InputError
from pipeline.data import npz, ply
from pipeline.environments import NAME
from pipeline.environments.config import EnvironmentConfig
from pipeline.environments.homes import open_homes
from pipeline.environments.rgbd import FAR_M, INTRINSICS, PITCH_RAD, RgbdCamera
from pipeline.environments.world import AnimalWorld
from pipeline.geometry import rigid
from pipeline.geometry.meshes import Mesh
from pipeline.longterm.bodies import SkinnedBody
from tests.pipeline.behavior.wandering import BONES, REST, wandering
from tests.pipeline.environments.small_world import QUICK, write_animal
from tests.pipeline.environments.test_other_home import write

gymnasium = pytest.importorskip("gymnasium")

RED, BLUE = (200, 30, 30), (30, 30, 200)


def box(extents, color, place=(0.0, 0.0, 0.0), inward=False):
    """A box of one color with a given center."""
    made = trimesh.creation.box(extents, rigid.make(np.eye(3), np.array(place)))
    faces = np.asarray(made.faces)[:, ::-1] if inward else np.asarray(made.faces)
    vertices = np.asarray(made.vertices, np.float32)
    return Mesh(vertices, np.ascontiguousarray(faces, np.int32), np.tile(np.uint8(color), (len(vertices), 1)))


def write_surfaces(build):
    """Write a blue room of 4 m and a red animal as boxes."""
    (build / "reconstruction").mkdir()
    ply.write_ply(build / "reconstruction/scene.ply", box((4.4, 2.5, 4.4), BLUE, (0, 1.25, 0), inward=True))
    ply.write_ply(build / "reconstruction/agent.ply", box((0.2, 0.2, 0.4), RED))
    npz.save(
        build / "reconstruction/skin.npz",
        weights=np.full((8, BONES), 1 / BONES, np.float32),
        agent_from_bone_rest=REST.astype(np.float32),
        bone_scale_m=np.ones((BONES, 3), np.float32),
    )


@pytest.fixture(scope="module")
def builds(tmp_path_factory):
    """Two homes: the first with an untrained model and surfaces, the second with surfaces only."""
    folder = tmp_path_factory.mktemp("builds")
    own, other = write(folder / "own"), write(folder / "other")
    write_animal(own)
    for build in (own, other):
        write_surfaces(build)
    return own, other


@pytest.mark.slow
def test_episodes_start_in_every_home_and_plan_in_one_batch(builds):
    own, other = builds
    lives = []
    for _ in range(2):
        env = gymnasium.make_vec(
            NAME, num_envs=6, build=str(own), homes=[str(own), str(other)], config=QUICK, episode_s=0.5
        )
        seen, info = env.reset(seed=1)
        homes = [info["home"].copy()]
        assert info["share_known"].shape == (6,) and (info["share_known"] == 1).all(), "the same room twice"
        for _ in range(14):
            seen, *_, info = env.step(np.zeros((6, 3), np.float32))
            homes.append(info["home"].copy())
        assert set(np.concatenate(homes)) == {0, 1}
        assert (homes[0] != homes[-1]).any(), "an episode that begins anew draws a home anew"
        assert env.observation_space.contains(seen)
        lives.append(seen["animal"])
    np.testing.assert_array_equal(*lives)


def test_joined_homes_keep_their_start_states_and_volumes(builds):
    own, other = builds
    data, animals = wandering(), {"cat": own}
    alone = open_homes(own, animals, [other])["cat"]
    both = open_homes(own, animals, [own, other])["cat"]
    assert both.scenes.number(np.arange(len(both.data.videos)), len(both.data.videos)).tolist() == [
        *([0] * len(data.videos)),
        *([1] * len(alone.data.videos)),
    ]
    late = np.flatnonzero(both.home_of_video[both.data.video] == 1)
    np.testing.assert_array_equal(
        both.data.windows(late[:5])[0].world_from_agent, alone.data.windows(np.arange(5))[0].world_from_agent
    )
    assert open_homes(own, animals, [])["cat"].data.videos == data.videos


@pytest.mark.filterwarnings("error")
@pytest.mark.slow
@pytest.mark.parametrize("observations", [("rgbd",), ("animal", "rgbd")])
def test_gymnasium_accepts_image_observations(builds, observations):
    from gymnasium.utils.env_checker import check_env

    how = {"homes": [str(build) for build in builds], "config": QUICK, "observations": observations}
    env = gymnasium.make(NAME, build=str(builds[0]), episode_s=3.0, **how)
    check_env(env.unwrapped)
    seen, _ = env.reset(seed=0)
    assert set(seen) == {"rgb", "depth", *observations} - {"rgbd"}
    rgb, depth = seen["rgb"].astype(int), seen["depth"]
    animal = (rgb == RED).all(-1)
    assert 5 < animal.sum() < 1000, "it begins in view, a meter or so away"
    assert ((rgb == BLUE).all(-1) | animal).all() and depth[animal].mean() < depth[~animal].max()
    assert 0.3 < depth[animal].mean() < 2.5, "meters"


def test_rendered_depth_is_relative_to_the_camera():
    """A wall at 1.6 m, and in front of it an animal that is lowered by a bone."""
    body, wall = box((0.2, 0.2, 0.2), RED), box((20, 20, 1.0), BLUE, (0, 0, 2.1))
    weights = np.zeros((8, BONES))
    weights[:, 1] = 1
    camera = RgbdCamera([wall], [SkinnedBody(body, weights, REST, np.zeros(0))])
    level = rigid.make(np.eye(3), np.array([0.0, 0.0, 1.0]))
    eye = np.zeros(3)
    _, depth_m = camera.picture(0, eye, 0.0, [(rigid.make(np.eye(3), np.array([0.0, 50, 0])), REST)])
    row = (np.arange(48) + 0.5 - INTRINSICS[1, 2]) / INTRINSICS[1, 1]
    expected = 1.6 / (np.cos(PITCH_RAD) - row * np.sin(PITCH_RAD))
    seen = (expected > 0) & (expected < FAR_M)
    np.testing.assert_allclose(depth_m[seen, 32], expected[seen], rtol=1e-3)
    lowered = REST.copy()
    lowered[1, 1, 3] -= 0.3
    for bones, height in ((REST, 0.0), (lowered, -0.3)):
        rgb, depth_m = camera.picture(0, eye, 0.0, [(level, bones)])
        rows, columns = np.nonzero((rgb == RED).all(-1))
        ray = (np.array([columns.mean(), rows.mean()]) + 0.5 - INTRINSICS[:2, 2]) / INTRINSICS[0, 0]
        ahead = np.array([ray[0], -ray[1] * np.cos(PITCH_RAD) - np.sin(PITCH_RAD)]) / (
            np.cos(PITCH_RAD) - ray[1] * np.sin(PITCH_RAD)
        )
        np.testing.assert_allclose(
            ahead * 0.95, [0, height], atol=0.06
        )  # meters, at the near side of the body


def test_rendering_without_surfaces_is_refused(builds, tmp_path):
    shutil.copytree(builds[0], tmp_path / "blind", ignore=shutil.ignore_patterns("reconstruction"))
    world = AnimalWorld.load(tmp_path / "blind", QUICK)
    assert world.camera is None
    with pytest.raises(InputError, match="ART-003.*blind"):
        AnimalWorld.load(tmp_path / "blind", EnvironmentConfig(observations=("rgbd",)))
