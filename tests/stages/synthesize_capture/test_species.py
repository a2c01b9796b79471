"""Every species is one closed surface that stands, walks and rests on the ground."""

import numpy as np
import pytest
import trimesh

from pipeline.core.errors import InputError
from pipeline.geometry import rigid
from stages.synthesize_capture import animal, gait, stage
from stages.synthesize_capture.config import Config
from stages.synthesize_capture.session import AnimalCourse
from tests.stages.synthesize_capture.walks import straight

OTHERS = ("rabbit", "hen")
SOLES = ("left toes", "right toes", "left hand", "right hand")


@pytest.mark.parametrize("species", animal.BODIES)
def test_surface_is_closed_and_connected(species):
    creature = animal.grow(np.random.default_rng(1), species=species)
    surface = trimesh.Trimesh(creature.vertices, creature.faces, process=False)
    assert surface.is_watertight
    assert surface.body_count == 1
    assert surface.volume > 0
    assert np.isfinite(creature.fur).all()
    assert (creature.fur[:, :3] >= 0).all() and (creature.fur[:, :3] <= 1).all()
    rest = rigid.make(np.eye(3), creature.anatomy.size * creature.anatomy.heads)
    np.testing.assert_allclose(animal.surface(creature, rest), creature.vertices, atol=1e-6)


@pytest.mark.parametrize("species", animal.BODIES)
def test_bones_have_the_same_names(species):
    bones = animal.BODIES[species].bones
    assert [(bone.name, bone.parent) for bone in bones] == [(bone.name, bone.parent) for bone in animal.BONES]


@pytest.mark.parametrize("species", OTHERS)
@pytest.mark.parametrize("posture", [(0, 0, 0), (1, 0, 0), (0, 1, 0)])
def test_it_rests_on_the_ground(species, posture):
    lowest = [points[:, 1].min() for points, _ in _shown(species, straight(0.0, posture))]
    assert np.abs(lowest).max() < 0.015, "meters"


@pytest.mark.parametrize(("species", "feet"), [("cat", 4), ("rabbit", 4), ("hen", 2)])
def test_it_stands_on_its_feet(species, feet):
    points, bone = _shown(species, straight(0.0))[0]
    lows = [points[bone == animal.INDEX[name], 1].min(initial=1.0) for name in SOLES]
    assert sum(low < 0.02 for low in lows) == feet, lows
    if feet == 2:
        assert min(lows[2:]) > 0.1, "meters: wings are off the ground"


@pytest.mark.parametrize("species", OTHERS)
@pytest.mark.parametrize("speed", [0.7, 1.5])
def test_it_walks_on_the_ground(species, speed):
    shown = _shown(species, straight(speed))
    assert np.isfinite([points for points, _ in shown]).all()
    assert np.abs([points[:, 1].min() for points, _ in shown]).max() < 0.03, "meters"


def test_rabbit_hops_with_both_hind_feet():
    motion = gait.poses(straight(1.0), np.linspace(1, 3, 200), animal.BODIES["rabbit"])
    left, right = (_heights(motion, name) for name in ("left toes", "right toes"))
    assert np.corrcoef(left, right)[0, 1] > 0.9
    assert np.ptp(motion.world_from_agent[:, 1, 3]) > 0.03, "meters that the body rises and falls"


def test_hen_moves_one_foot_at_a_time():
    motion = gait.poses(straight(0.7), np.linspace(1, 3, 200), animal.BODIES["hen"])
    left, right = (_heights(motion, name) for name in ("left toes", "right toes"))
    assert np.corrcoef(left, right)[0, 1] < -0.2


def test_two_of_a_species_are_refused(tmp_path):
    with pytest.raises(InputError, match="species"):
        stage.run(stage.Inputs(), Config(species="dog", companion="dog"), tmp_path)


def _shown(species, course: AnimalCourse) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return vertices in the world and the bone of each, at some times."""
    creature = animal.grow(np.random.default_rng(0), species=species)
    motion = gait.poses(course, np.linspace(1, 3, 30), creature.anatomy)
    return [
        (animal.surface(creature, world_from_agent @ bones), creature.bone[:, 0])
        for world_from_agent, bones in zip(motion.world_from_agent, motion.agent_from_bone, strict=True)
    ]


def _heights(motion: gait.AnimalMotion, bone: str) -> np.ndarray:
    places = motion.agent_from_bone[:, animal.INDEX[bone], :3, 3]
    return rigid.apply(motion.world_from_agent, places[:, None])[:, 0, 1]
