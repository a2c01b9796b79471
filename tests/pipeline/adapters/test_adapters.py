"""Adapters to programs with their own clocks: poses are interpolated to any time and set in the other
program.
"""

import subprocess
import sys
from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.adapters import ros2_animal
from pipeline.adapters.live_animal import ZUP_FROM_WORLD, LiveAnimal
from pipeline.adapters.ros2_animal import AnimalNode
from pipeline.behavior.perception import FeatureVolume
from pipeline.core.errors import InputError
from pipeline.data.glb import Action, Skin
from pipeline.geometry import rigid
from stages.export import mjcf, reading, usd
from tests.pipeline.behavior.wandering import REST, untrained_simulator
from tests.stages.export_simulator import small_world

PERSON = np.array([0.5, 1.3, 0.5])


@pytest.fixture(scope="module")
def animal() -> LiveAnimal:
    return LiveAnimal(untrained_simulator(goal_steps=2, candidates=1), seed=3)


def exported_agent() -> reading.Agent:
    """An exported tube with the three bones of the animal."""
    mesh, _ = small_world.tube()
    skin = Skin(
        np.tile(np.arange(4, dtype=np.uint8) % 3, (len(mesh.vertices), 1)),
        np.full((len(mesh.vertices), 4), 0.25, np.float32),
        REST,
        tuple(f"bone_{bone:02d}" for bone in range(len(REST))),
    )
    still = Action("still", np.arange(5) / 30, np.tile(np.eye(4), (5, 1, 1)), np.tile(REST, (5, 1, 1, 1)))
    return reading.Agent(mesh, skin, [still], 10.0, {})


def test_poses_are_interpolated_for_any_step_length(animal):
    animal.reset(3)
    frames = [animal.simulator.reset(3)] + [animal.simulator.step(PERSON) for _ in range(10)]
    animal.reset(3)
    fine = [animal.advance(0.02, PERSON) for _ in range(50)]
    for number in (5, 10):
        np.testing.assert_allclose(
            fine[5 * number - 1].world_from_agent, frames[number].world_from_agent, atol=1e-9
        )
    middle = 0.5 * (frames[4].world_from_agent + frames[5].world_from_agent)[:3, 3]
    animal.reset(3)
    np.testing.assert_allclose(animal.advance(0.45, PERSON).world_from_agent[:3, 3], middle, atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(animal.pose.agent_from_bone[:, :3, :3]), 1, atol=1e-6)


@pytest.mark.parametrize(("seconds", "place"), [(np.nan, PERSON), (0.1, PERSON * np.nan), (-0.1, PERSON)])
def test_invalid_times_and_positions_are_refused(animal, seconds, place):
    with pytest.raises(InputError, match="SIM-012"):
        animal.advance(seconds, place)


def test_mujoco_moves_the_animal_with_a_robot_as_observer(animal, tmp_path):
    mujoco = pytest.importorskip("mujoco")
    from pipeline.adapters.mujoco_animal import MujocoAnimal

    floor = np.pad(np.ones((40, 1, 40), np.uint8), ((0, 0), (0, 5), (0, 0)))
    volume = FeatureVolume(np.zeros((0, *floor.shape)), floor, np.array([-2.0, -0.1, -2]), 0.1)
    mjcf.write(tmp_path, exported_agent(), volume)
    home = mujoco.MjSpec.from_file(str(tmp_path / "agent.xml"))
    ball = home.worldbody.add_body(name="robot", pos=[1.0, 0.5, 0.4])
    ball.add_freejoint()
    ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0, 0])
    model = home.compile()
    model.opt.timestep = 0.005
    data = mujoco.MjData(model)
    animal.reset(3)
    moving = MujocoAnimal(model, data, animal, observer="robot")
    np.testing.assert_allclose(moving.observer_world, [1.0, 0.4, -0.5])
    pose = moving.step(100)
    assert data.time == pytest.approx(0.5) and pose.time_s == pytest.approx(0.5)
    assert data.body("robot").xpos[2] == pytest.approx(0.1, abs=0.02), "it fell onto the floor"
    mujoco.mj_forward(model, data)
    bone = ZUP_FROM_WORLD @ pose.world_from_agent @ pose.agent_from_bone[1]
    np.testing.assert_allclose(data.body("bone_01").xpos, bone[:3, 3], atol=1e-9)


def test_usd_has_the_current_pose(animal, tmp_path):
    pytest.importorskip("pxr")
    from pxr import Usd, UsdSkel

    from pipeline.adapters.usd_animal import UsdAnimal

    usd.write(tmp_path, exported_agent(), small_world.room())
    stage = Usd.Stage.Open(str(tmp_path / "agent_still.usdc"))
    animal.reset(3)
    pose = UsdAnimal(stage, animal).step(0.25, PERSON)
    cache = UsdSkel.Cache()
    cache.Populate(UsdSkel.Root(stage.GetPrimAtPath("/agent")), Usd.PrimDefaultPredicate)
    query = cache.GetSkelQuery(UsdSkel.Skeleton(stage.GetPrimAtPath("/agent/skeleton")))
    found = np.array([np.array(matrix).T for matrix in query.ComputeJointSkelTransforms(7)])[1:]
    np.testing.assert_allclose(found, pose.world_from_agent @ pose.agent_from_bone, atol=1e-4)


@dataclass
class Message:
    """A ROS message with the fields that the node sets."""

    pose: object = None
    poses: object = None
    header: SimpleNamespace = field(default_factory=SimpleNamespace)


class FakeNode:
    """The part of a ROS node that the adapter uses."""

    def __init__(self):
        self.sent, self.heard, self.period_s = {}, {}, None

    def create_publisher(self, kind, topic, depth):
        return SimpleNamespace(publish=lambda message: self.sent.setdefault(topic, []).append(message))

    def create_subscription(self, kind, topic, callback, depth):
        self.heard[topic] = callback

    def create_timer(self, period_s, callback):
        self.period_s, self.tick = period_s, callback

    def get_clock(self):
        return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=lambda: "now"))


@pytest.mark.parametrize(
    "program",
    [
        "stages.annotate",
        "stages.check_captures",
        "stages.compile_gallery",
        "pipeline.adapters.ros2_animal",
        "pipeline.workflow.run",
    ],
)
def test_invalid_arguments_are_refused_with_a_code(program):
    failed = subprocess.run([sys.executable, "-m", program], capture_output=True, text=True, check=False)
    assert failed.returncode == 2
    assert failed.stderr.startswith(f"error: RUN-004 python -m {program}: ") and "usage" not in failed.stderr


def test_missing_ros_is_one_line(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["ros2_animal", "build/missing"])
    monkeypatch.setitem(sys.modules, "rclpy", None)
    with pytest.raises(SystemExit, match="2"):
        ros2_animal.main()
    said = capsys.readouterr().err
    assert "rclpy" in said and "source the setup file of ROS 2" in said and said.count("\n") == 1


def test_ros_messages_have_the_axes_of_rep_103(animal):
    """Uses fake messages, since ROS is not available as a wheel."""
    animal.reset(3)
    messages = SimpleNamespace(
        PoseStamped=Message,
        PoseArray=Message,
        Point=SimpleNamespace,
        Pose=SimpleNamespace,
        Quaternion=SimpleNamespace,
    )
    topics = FakeNode()
    node = AnimalNode(topics, messages, animal)
    for x in (1.0, np.nan):
        place = SimpleNamespace(x=x, y=2.0, z=1.4)
        topics.heard["observer"](Message(pose=SimpleNamespace(position=place)))
    np.testing.assert_allclose(node.observer_world, [1.0, 1.4, -2.0])
    assert topics.period_s == pytest.approx(0.1)
    topics.tick()
    (root,), (bones,) = topics.sent["animal"], topics.sent["bones"]
    assert root.header.frame_id == "map" and root.header.stamp == "now" and len(bones.poses) == len(REST)
    turn = root.pose.orientation
    axes = rigid.rotation_from_quaternion(np.array([turn.w, turn.x, turn.y, turn.z]))
    agent = ZUP_FROM_WORLD[:3, :3] @ animal.pose.world_from_agent[:3, :3]
    np.testing.assert_allclose(axes[:, 0], agent[:, 2], atol=1e-6, err_msg="x is ahead")
    np.testing.assert_allclose(axes[:, 2], agent[:, 1], atol=1e-6, err_msg="z is up")
