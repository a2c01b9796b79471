"""The page and Python warp paths around the person in the same way, without collisions."""

import numpy as np
import pytest

from pipeline.behavior.avoidance import PERSON_M, around_person, clearance_of
from tests.stages.export_simulator.test_support_twins import SOURCES, needs_node, run_node

ASK = (
    f"import {{ aroundPerson, clearanceOf }} from '{SOURCES}/avoidance.js';"
    + """
const { paths, people, rest } = JSON.parse(await new Response(process.stdin).text());
console.log(JSON.stringify(paths.map((path, i) => aroundPerson(path.slice(1), path[0], people[i], clearanceOf(rest)))));
"""
)
REST = np.tile(np.eye(4), (3, 1, 1))
REST[:, 2, 3] = (-0.38, 0.0, 0.28)
CLEARANCE_M = clearance_of(REST)


def test_clearance_scales_with_the_animal():
    assert clearance_of(REST) == pytest.approx(0.4), "meters, of a cat"
    dog = REST * np.array([1.0, 1.0, 1.0, 1.3])
    assert clearance_of(dog) == pytest.approx(PERSON_M + 1.3 * 0.28)
    assert clearance_of(REST[1:2]) == pytest.approx(0.4), (
        "meters, of an animal of which only the root is known"
    )


@pytest.fixture(scope="module")
def paths() -> np.ndarray:
    """Straight walks at 0.5 m/s past or through the origin from different sides."""
    rng = np.random.default_rng(0)
    along, aside = np.linspace(-1.4, 1.4, 57), rng.uniform(-0.5, 0.5, 40)
    angle = rng.uniform(0, 2 * np.pi, 40)[:, None]
    x = along * np.cos(angle) - aside[:, None] * np.sin(angle)
    z = along * np.sin(angle) + aside[:, None] * np.cos(angle)
    return np.stack([x, np.full_like(x, 0.2), z], axis=-1)


def nearest_m(paths: np.ndarray) -> np.ndarray:
    """Return the distance of each path, finely sampled, from the origin."""
    share = np.linspace(0, 1, 20)[:, None, None, None]
    return np.linalg.norm((paths[:, :-1] * (1 - share) + paths[:, 1:] * share)[..., [0, 2]], axis=-1).min(
        (0, 2)
    )


def test_paths_do_not_intersect_the_person(paths):
    led = around_person(paths[:, 1:], paths[:, 0], np.zeros((len(paths), 3)), CLEARANCE_M)
    whole = np.concatenate([paths[:, :1], led], axis=1)
    assert nearest_m(paths).min() < 0.05 and nearest_m(whole).min() > CLEARANCE_M - 0.01, "meters"
    steps = np.linalg.norm(np.diff(whole[..., [0, 2]], axis=1), axis=-1)
    assert steps.max() < 0.09, "meters in 0.1 s: a walk, no jump"
    past = np.linalg.norm((led[:, -1] - paths[:, -1])[:, [0, 2]], axis=1)
    assert np.median(past) < 0.02, "meters: those that can arrive arrive"


def test_animal_within_the_clearance_does_not_come_closer(paths):
    start = 0.2 * paths[:, 0] / np.linalg.norm(paths[:, 0][:, [0, 2]], axis=1, keepdims=True)
    led = around_person(paths[:, 1:], start, np.zeros((len(paths), 3)), CLEARANCE_M)
    assert np.linalg.norm(led[..., [0, 2]], axis=-1).min() > 0.19, "meters"


@pytest.mark.parametrize("start_m", [CLEARANCE_M, CLEARANCE_M + 1e-4, 0.2])
def test_animal_beside_a_person_walks_around_them(paths, start_m):
    """From the circle that it may not enter, on which a straight step along it would not stay outside."""
    along = paths[:, -1] - paths[:, 0]
    along[:, 1] = 0.0
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    start = -start_m * along + [0.0, 0.2, 0.0]
    beyond = start[:, None] + along[:, None] * 0.05 * np.arange(1, 57)[:, None]
    led = around_person(beyond, start, np.zeros((len(paths), 3)), CLEARANCE_M)
    reach_m = min(start_m, CLEARANCE_M)
    assert nearest_m(np.concatenate([start[:, None], led], axis=1)).min() > reach_m - 1e-6, "meters"
    assert np.linalg.norm((led - beyond)[:, -1], axis=1).max() < 0.01, "meters: they arrive"


def test_distant_persons_do_not_change_paths(paths):
    led = around_person(paths[:, 1:], paths[:, 0], np.full((len(paths), 3), 9.0), CLEARANCE_M)
    np.testing.assert_allclose(led, paths[:, 1:], atol=1e-12)


@needs_node
def test_page_and_python_give_the_same_paths(paths):
    theirs = run_node(
        ASK, paths=paths.tolist(), people=np.zeros((len(paths), 2)).tolist(), rest=REST.tolist()
    )
    ours = around_person(paths[:, 1:], paths[:, 0], np.zeros((len(paths), 3)), CLEARANCE_M)
    np.testing.assert_allclose(theirs, ours, atol=1e-9)
