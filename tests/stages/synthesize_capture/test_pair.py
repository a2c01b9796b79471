"""A cat and a dog in one home: they interact without collisions, and each has its own ground truth."""

from dataclasses import replace

import numpy as np

from stages.synthesize_capture import animal, gait, produce, room, script, session
from stages.synthesize_capture.config import Config
from tests.stages.synthesize_capture.walks import straight

HOME = room.furnish(np.random.default_rng(0))
CAT = animal.grow(np.random.default_rng(0), cell_m=0.016)
DOG = animal.grow(np.random.default_rng(0), cell_m=0.016, species="dog")
PHONE = script.PhoneFormat(15.0, (160, 120), (128, 96))
CONFIG = Config(
    seed=8,
    session_count=2,
    session_s=0.6,
    test_session_s=0.6,
    walkthrough_s=0.5,
    turnaround_s=0.5,
    heldout_of=0,
    dim_session=0,
    sideways_session=0,
    companion="dog",
)


def test_dog_follows_and_makes_way():
    lived = [
        session.simulate_session(HOME, np.random.default_rng(seed), 40.0, with_dog=True) for seed in (1, 2)
    ]
    for each in lived:
        assert each.companion is not None
        apart = np.linalg.norm((each.animal.position - each.companion.position)[:, [0, 2]], axis=-1)
        level = (each.animal.position[:, 1] < 0.05) & (each.animal.airborne == 0)
        assert apart[level].min() > 0.4, "meters between centers"
        assert (each.companion.position[:, 1] == 0).all(), "on the floor"
        assert each.companion.speed().max() < 4.0
    near = [
        (np.linalg.norm(one.animal.position - one.companion.position, axis=-1) < 1.3).mean() for one in lived
    ]
    assert np.mean(near) > 0.3, "share of the time"
    again = session.simulate_session(HOME, np.random.default_rng(1), 40.0, with_dog=True)
    np.testing.assert_array_equal(again.companion.position, lived[0].companion.position)


def test_its_feet_stand_on_the_floor():
    motion = gait.poses(straight(0.8), np.linspace(1, 3, 30), animal.DOG)
    lowest = [
        animal.surface(DOG, world_from_agent @ bones)[:, 1].min()
        for world_from_agent, bones in zip(motion.world_from_agent, motion.agent_from_bone, strict=True)
    ]
    assert np.abs(lowest).max() < 0.035, "meters: soles sink in as those of the cat do, in proportion"


def test_each_animal_has_its_own_ground_truth(tmp_path):
    scripts = script.scripts(CONFIG, HOME, PHONE)
    names = ["walkthrough", "turnaround_cat", "turnaround_dog", "session-1", "session-2"]
    assert [part.name for part in scripts] == names
    assert [part.motions[0] is not None for part in scripts] == [False, True, False, True, True]
    assert [part.motions[1] is not None for part in scripts] == [False, False, True, True, True]
    produce.produce(scripts[2:4], CAT, tmp_path, tmp_path, workers=1, companion=DOG)
    found = {}
    for name in ("cat", "dog"):
        truth = np.load(tmp_path / name / "session-1.npz")
        assert truth["agent_vertices_world"].shape[1] == len({"cat": CAT, "dog": DOG}[name].vertices)
        found[name] = [
            np.unpackbits(packed["packed"], axis=-1, count=packed["shape"][2]).astype(bool)
            for packed in (np.load(tmp_path / name / f"session-1.{kind}.npz") for kind in ("masks", "others"))
        ]
    np.testing.assert_array_equal(found["cat"][0], found["dog"][1])
    np.testing.assert_array_equal(found["cat"][1], found["dog"][0])
    assert not (found["cat"][0] & found["dog"][0]).any()
    assert "world_from_agent" not in np.load(tmp_path / "cat/turnaround_dog.npz")


def test_companion_does_not_change_the_walkthrough():
    both = script.scripts(CONFIG, HOME, PHONE)
    alone = script.scripts(replace(CONFIG, companion="none"), HOME, PHONE)
    np.testing.assert_array_equal(both[0].world_from_camera, alone[0].world_from_camera)
    np.testing.assert_array_equal(both[1].world_from_camera, alone[1].world_from_camera)
