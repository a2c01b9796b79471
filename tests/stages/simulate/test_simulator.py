import http.client
import json
import socket
import sys
import urllib.request
from dataclasses import replace

import numpy as np
import pytest

from pipeline.behavior.config import ReplanningConfig
from pipeline.behavior.diffusion import Schedule
from pipeline.behavior.model import BehaviorNets
from pipeline.behavior.perception import world_from_ego
from pipeline.behavior.planning import observe
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.simulator import AnimalBatch
from pipeline.behavior.trajectories import FUTURE, PoseFrames, blended_frames
from pipeline.core.errors import InputError
from pipeline.data import glb, npz
from pipeline.geometry import rigid
from pipeline.geometry.meshes import Mesh
from stages.simulate import live, stage, takes
from stages.simulate.config import Config
from stages.simulate.inputs import Inputs
from stages.simulate.live import LiveAppearance, LiveView
from stages.simulate.observers import scripted
from stages.simulate.rollout import rollout, write_take
from stages.train_behavior.export import write_contract
from tests.pipeline.behavior.wandering import (
    ARCHITECTURE,
    REST,
    room,
    scaling,
    untrained_simulator,
    wandering,
)
from tests.pipeline.environments import test_other_home
from tests.pipeline.environments.small_world import write_animal, write_volume


@pytest.fixture(scope="module")
def simulator():
    return untrained_simulator(goal_steps=4, candidates=3)


def test_simulation_is_deterministic_and_continues(simulator):
    observer = np.array([0.5, 1.3, 0.5])
    lives = []
    for _ in range(2):
        states = [simulator.reset(seed=4)] + [simulator.step(observer) for _ in range(25)]
        lives.append(np.stack([state.world_from_agent for state in states]))
    np.testing.assert_array_equal(*lives)
    assert np.isfinite(lives[0]).all()
    assert states[-1].time_s == pytest.approx(2.5)
    np.testing.assert_allclose(np.linalg.det(lives[0][:, :3, :3]), 1, atol=1e-6)
    assert states[-1].agent_from_bone.shape == (3, 4, 4)


def test_states_are_not_modified_by_later_steps(simulator):
    person = np.array([0.5, 1.3, 0.5])
    states = [simulator.reset(seed=4)] + [simulator.step(person) for _ in range(55)]
    assert len({tuple(state.goal_world) for state in states}) == 2, "56 frames, of which 4 fade"


def test_batched_animals_continue_their_own_windows(simulator):
    context, _ = simulator.data.windows(np.array([0, 40, 80]))
    animals = simulator.animals
    animals.begin(replace(context, video=None), np.random.default_rng(0))
    lives = np.concatenate([animals.step(context.observer_world[:, -1]).root for _ in range(10)], axis=1)
    assert lives.shape == (3, 10, 4, 4) and animals.blocked.shape == (3,)
    start = context.world_from_agent[:, -1, :3, 3]
    assert (np.linalg.norm(lives[:, 0, :3, 3] - start, axis=-1) < 0.3).all()
    assert np.linalg.norm(start[:, None] - start, axis=-1)[~np.eye(3, dtype=bool)].min() > 0.1


def test_plans_are_followed_until_they_end_or_the_observer_moves(simulator):
    context, _ = simulator.data.windows(np.array([0, 40]))
    animals, person = simulator.animals, np.array([[0.5, 1.3, 0.5], [0.5, 1.3, 0.5]])

    def begin():
        animals.begin(
            replace(context, video=None, observer_world=np.repeat(person[:, None], 8, 1)),
            np.random.default_rng(0),
        )
        return animals.goal.copy()

    first, changed = begin(), []
    for _ in range(60):
        animals.step(person)
        changed.append((animals.goal != first).any(1))
    assert [int(np.argmax(of_one)) for of_one in np.array(changed).T] == [52, 52], (
        "56 frames, of which 4 fade"
    )
    first, near = begin(), person + np.array([[0.9, 0.0, 0.0], [0.0, 0.0, 0.0]])
    for frame in range(12):
        animals.step(near)
        assert (animals.goal != first).any(1).tolist() == [frame >= 3, False], "reacts to who has moved"
    begin()
    animals.invalidate_plans()
    for _ in range(4):
        animals.step(person)
    assert (animals.goal != first).any(1).all()
    blind = AnimalBatch(
        animals.sampler,
        animals.scenes,
        animals.rest,
        "yaw",
        sampling=replace(animals.sampling, observer=False),
        chaining=ReplanningConfig(),
    )
    blind.begin(replace(context, video=None), np.random.default_rng(0))
    first = blind.goal.copy()
    for frame in range(40):
        blind.step(person * frame)
    np.testing.assert_array_equal(blind.goal, first)


def test_animals_are_only_where_they_may_be_also_between_plans(simulator):
    """In a room of pillars, which blends of two plans and detours around a person would cut."""
    context, _ = simulator.data.windows(np.array([0, 40, 80]))
    rng, volume = np.random.default_rng(0), simulator.animals.scenes.volumes[0]
    pillars = rng.random((volume.occupancy.shape[0], 1, volume.occupancy.shape[2])) < 0.2
    scenes = Scenes((volume,), ((volume.occupancy == 0) & ~pillars,), np.zeros(1, int))
    settings = {"sampling": simulator.animals.sampling, "chaining": ReplanningConfig()}
    animals = AnimalBatch(simulator.animals.sampler, scenes, simulator.animals.rest, "yaw", **settings)
    animals.begin(replace(context, video=None), rng)
    roots = [animals.step(rng.uniform(-1.5, 1.5, (3, 3))).root[:, :, :3, 3] for _ in range(60)]
    assert animals.plans_drawn > 12, "plans are blended"
    assert not scenes.inside_solid(np.concatenate(roots, axis=1), None).any()


def test_plans_without_corrections_are_what_the_networks_predict(simulator):
    """Although the person stands in the way, and several candidates are allowed."""
    context, _ = simulator.data.windows(np.array([0, 40]))
    beside = context.world_from_agent[..., :3, 3] + np.array([0.05, 0.0, 0.05])
    context = replace(context, video=None, observer_world=beside, observer_rotation=None)
    animals, roots = simulator.animals, []
    for corrections in (False, True):
        sampler = replace(animals.sampler, corrections=corrections)
        settings = {"sampling": animals.sampling, "chaining": ReplanningConfig(candidates=4)}
        batch = AnimalBatch(sampler, animals.scenes, animals.rest, "yaw", **settings)
        batch.begin(context, np.random.default_rng(0))
        seen = observe(context, animals.scenes, animals.rest, "yaw", FUTURE)
        plan = sampler.plan(seen, animals.sampling.networks_only(), np.random.default_rng(0))
        frame = world_from_ego(context.world_from_agent[:, -1], "yaw")
        roots.append((batch.plan.root, plan.world_from_agent(frame)))
    np.testing.assert_allclose(*roots[0], atol=1e-5)
    assert np.abs(roots[1][0] - roots[1][1]).max() > 0.01


def test_plans_depend_on_the_posture(simulator):
    context, _ = simulator.data.windows(np.array([0, 40]))
    lives = []
    for bend in (0.0, 0.3):
        bones = context.agent_from_bone @ rigid.make(
            rigid.rotation_from_vector(np.array([bend, 0, 0])), np.zeros(3)
        )
        simulator.animals.begin(replace(context, video=None, agent_from_bone=bones), np.random.default_rng(0))
        lives.append(simulator.animals.plan)
    assert np.abs(lives[0].root[..., :3, 3] - lives[1].root[..., :3, 3]).max() > 1e-4, "goals and paths too"
    assert np.abs(lives[0].bones - lives[1].bones).max() > 0.01, "the body goes on from the bones that it has"


def test_plans_are_blended_from_the_old_to_the_new_one():
    old = PoseFrames(np.tile(np.eye(4), (10, 1, 1)), np.zeros((10, 6)))
    turned = rigid.make(rigid.rotation_from_vector(np.array([0, 1.0, 0])), np.array([1.0, 0, 0]))
    new = PoseFrames(np.tile(turned, (10, 1, 1)), np.ones((10, 6)))
    blend = blended_frames(old, new, 4)
    np.testing.assert_allclose(blend.root[:5, 0, 3], [0.2, 0.4, 0.6, 0.8, 1.0])
    angles = rigid.rotation_angle(np.eye(3), blend.root[:5, :3, :3])
    np.testing.assert_allclose(angles, [0.2, 0.4, 0.6, 0.8, 1.0], atol=1e-9)
    np.testing.assert_allclose(blend.bones[:, 0], [0.2, 0.4, 0.6, 0.8] + [1.0] * 6)
    assert blended_frames(PoseFrames(old.root[:0], old.bones[:0]), new, 4) is new


@pytest.mark.parametrize("script", ["away", "still", "approach"])
def test_observers_move_at_a_walking_pace(script):
    observer = scripted(script, center=np.array([0.0, 1.4, 0.0]), speed_m_s=1.0)
    track = np.array([observer(step / 10, np.array([2.0, 0.2, 1.0])) for step in range(100)])
    assert (np.abs(np.diff(track, axis=0)).max(0) <= 0.1 + 1e-9).all()
    assert np.ptp(track[:, 1]) == 0
    if script == "approach":
        assert np.linalg.norm(track[39] - [2.0, 1.4, 1.0]) == pytest.approx(0.5, abs=0.05)


def test_take_is_written_completely(simulator, tmp_path):
    observer = scripted("approach", center=np.array([0.0, 1.4, 0.0]))
    take = rollout(simulator, observer, seconds=1.0, seed=0)
    write_take(tmp_path, take)
    lines = (tmp_path / "take.csv").read_text().splitlines()
    assert len(lines) == 1 + 11
    assert lines[0].startswith("time_s,x,y,z,qw")
    assert (tmp_path / "take.npz").stat().st_size > 1000
    write_take(tmp_path, rollout(simulator, observer, seconds=0.0, seed=0))
    assert len((tmp_path / "take.csv").read_text().splitlines()) == 2, "one moment"


def test_the_caller_s_arrays_stay_its_own(simulator):
    place = np.array([0.0, 1.4, 0.0])
    simulator.reset(0)
    for _ in range(3):
        place += [0.1, 0.0, 0.0]
        state = simulator.step(place)
    np.testing.assert_allclose([seen[0, 0] for seen in simulator.animals.observer][-3:], [0.1, 0.2, 0.3])
    state.world_from_agent[:] = 0
    assert simulator.past_world[-1].any()


def homes(folder, seen=None, architecture=ARCHITECTURE):
    """Write a model and recordings in a home each, 20 m apart, with absent observers or observers at `seen`."""
    data = wandering()
    for number, (name, track) in enumerate(data.trajectories.items()):
        there = np.array([20.0 * number, 0, 0])
        person = np.tile(
            rigid.make(np.eye(3), np.array([1000.0, 0, 0]) if seen is None else there + seen),
            (len(track.valid), 1, 1),
        )
        shifted = rigid.make(np.eye(3), there) @ track.world_from_agent
        data.trajectories[name] = replace(track, world_from_agent=shifted, world_from_camera=person)
    for artifact in ("behavior_data/volumes", "behavior"):
        (folder / artifact).mkdir(parents=True)
    data.save(folder / "behavior_data")
    for number, name in enumerate(data.videos):
        bare = room()
        volume = replace(bare, origin=bare.origin + np.array([20.0 * number, 0, 0]))
        write_volume(folder / f"behavior_data/volumes/{name}.npz", volume)
    write_contract(folder / "behavior", BehaviorNets(architecture), architecture, scaling(), Schedule(), REST)
    return Inputs(behavior_data=folder / "behavior_data", behavior=folder / "behavior")


@pytest.mark.parametrize("seen", [None, [0.5, 1.6, -0.5]])
def test_observer_is_in_the_home_of_the_take(tmp_path, seen):
    settings = Config(seconds=1.0, observer="still", seed=3, goal_steps=4, sequence_steps=2)
    takes.of_behavior(homes(tmp_path, seen), settings, "cpu").write(tmp_path)
    take = npz.load(tmp_path / "take.npz")
    begin, person = take["world_from_agent"][0, :3, 3], take["observer_world"]
    assert abs(begin[0] - 20) < 2, "meters: the second home"
    np.testing.assert_allclose(
        person,
        np.tile(
            begin + takes.DEFAULT_OBSERVER_OFFSET_M if seen is None else np.add(seen, [20, 0, 0]), (11, 1)
        ),
    )
    assert take["blocked"].mean() < 0.9, "it lives in its own home: elsewhere all is blocked"


def test_models_without_chainable_plans_are_refused(tmp_path):
    with pytest.raises(InputError, match="SIM-006.*gaussian"):
        takes.of_behavior(
            homes(tmp_path, architecture=replace(ARCHITECTURE, family="gaussian")), Config(), "cpu"
        )


def test_take_in_the_home_of_another_build(tmp_path):
    own, other = test_other_home.write(tmp_path / "own"), test_other_home.write(tmp_path / "other")
    write_animal(own)
    artifacts = ("behavior_data", "behavior", "feature_basis", "scene_template")
    inputs = Inputs(**{name: own / name for name in artifacts}, home=other)
    settings = Config(seconds=1.0, goal_steps=4, sequence_steps=2)
    stage.run(inputs, settings, tmp_path)
    summary = json.loads((tmp_path / "home.json").read_text())
    assert summary["home"] == "other" and summary["share_known"] == 1.0 and summary["goals_in_solid"] == 0.0
    take, volume = npz.load(tmp_path / "take.npz"), npz.load(tmp_path / "volume.npz")
    assert len(take["timestamp_s"]) == 11 and volume["allowed"].shape == volume["occupancy"].shape
    with pytest.raises(InputError, match="SIM-011"):
        stage.run(inputs, replace(settings, places="visited"), tmp_path)


def look():
    """A triangle on three bones in a room of one triangle."""
    mesh = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32), None)
    joints = np.tile(np.arange(4, dtype=np.uint8) % 3, (3, 1))
    skin = glb.Skin(joints, np.full((3, 4), 0.25, np.float32), np.tile(np.eye(4), (3, 1, 1)), ("a", "b", "c"))
    return LiveAppearance(mesh, skin, glb.static(mesh, "room"))


def test_live_view_runs_and_saves_its_take(simulator):
    pytest.importorskip("viser")
    here = LiveView(simulator, look(), np.array([0.0, 1.3, 0.0]), seed=1, port=8117)
    with urllib.request.urlopen(f"http://127.0.0.1:{here.port}", timeout=10) as answer:
        assert answer.status == 200
    here.interactivity.value = 0.25
    here.person.position = (0.4, 1.3, 0.2)
    take = here.run(stopped=lambda: len(here.states) >= 4)
    assert len(take.timestamp_s) == 4 and simulator.animals.sampling.guidance == 0.25
    np.testing.assert_allclose(take.observer_world[-1], [0.4, 1.3, 0.2], atol=1e-6)
    np.testing.assert_allclose(here.animal.position, take.world_from_agent[-1, :3, 3], atol=1e-6)


def http_status(port: int, **headers: str) -> int:
    """Request the page of the live view and return the HTTP status."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.putrequest("GET", "/", skip_host=True)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    code = connection.getresponse().status
    connection.close()
    return code


def test_live_view_rejects_other_hosts_and_origins(simulator):
    """Rejects requests with another Host, and sockets of pages with another Origin."""
    viser = pytest.importorskip("viser")
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    def opened(origin: str | None, host: str) -> int:
        try:
            protocols = [f"viser-v{viser.__version__}"]
            with connect(
                f"ws://{host}",
                origin=origin,
                sock=socket.create_connection(("127.0.0.1", here.port), timeout=10),
                subprotocols=protocols,
            ) as connection:
                return connection.response.status_code
        except InvalidStatus as refused:
            return refused.response.status_code

    here = LiveView(simulator, look(), np.array([0.0, 1.3, 0.0]), seed=1, port=8121)
    try:
        own = f"127.0.0.1:{here.port}"
        assert (
            http_status(here.port, Host=own) == http_status(here.port, Host=f"localhost:{here.port}") == 200
        )
        assert http_status(here.port, Host=own, Origin=f"http://{own}") == 200
        for host in ("evil.example", f"evil.example:{here.port}", "127.0.0.1", f"{own}.evil.example"):
            assert http_status(here.port, Host=host) == 403, host
        assert http_status(here.port) == 403, "no Host at all"
        assert opened(f"http://{own}", own) == opened(None, own) == 101
        for origin in ("http://evil.example", "null", f"http://evil.example:{here.port}", f"https://{own}"):
            assert http_status(here.port, Host=own, Origin=origin) == 403, origin
            assert opened(origin, own) == 403, origin
        assert opened(None, f"evil.example:{here.port}") == 403
    finally:
        here.server.stop()


def test_unknown_viser_version_is_refused():
    started = []

    class Unchecked:
        def __init__(self, **_):
            started.append("running")

        def stop(self):
            started.append("stopped")

    pytest.importorskip("viser")
    with pytest.raises(InputError, match="SIM-010"):
        live._serving_own_page_only(Unchecked, 8122)
    assert started == ["running", "stopped"]


def test_restart_during_a_step_keeps_the_take_consistent(simulator):
    pytest.importorskip("viser")
    here = LiveView(simulator, look(), np.array([0.0, 1.3, 0.0]), seed=1, port=8119)
    step, clicked = simulator.step, []

    def stepping(position):
        if not clicked:
            clicked.append(here.again.set())
        return step(position)

    simulator.step = stepping
    try:
        take = here.run(stopped=lambda: here.seed == 2 and len(here.states) >= 3)
    finally:
        simulator.step = step
    assert len(take.observer_world) == len(take.timestamp_s) == 3


def test_live_view_names_missing_requirements(simulator, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match="make extras"):
        LiveView(simulator, look(), np.zeros(3), seed=1, port=8118)


@pytest.mark.parametrize("observer", [[np.nan, 1.0, 0.0], [0.0, 1.0], 5.0, None, "here"])
def test_unusable_observers_are_refused_and_leave_no_trace(simulator, observer):
    eyes = np.array([0.5, 1.4, 0.5])
    simulator.reset(0)
    undisturbed = [simulator.step(eyes).world_from_agent for _ in range(4)]
    simulator.reset(0)
    simulator.step(eyes)
    with pytest.raises(InputError, match="SIM-012"):
        simulator.step(observer)
    np.testing.assert_array_equal([simulator.step(eyes).world_from_agent for _ in range(3)], undisturbed[1:])
    if observer is not None:
        with pytest.raises(InputError, match="SIM-012"):
            simulator.reset(0, observer=observer)


def test_restarted_animals_leave_the_frames_that_were_returned(simulator):
    animals, observer = simulator.animals, np.tile([0.5, 1.4, 0.5], (1, 1))
    simulator.reset(0)
    kept = [animals.step(observer).root for _ in range(3)]
    before = np.array(kept)
    context, _ = simulator.data.windows(np.array([5]))
    animals.restart(np.array([0]), context)
    np.testing.assert_array_equal(kept, before)
