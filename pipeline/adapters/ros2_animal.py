"""The animal of a build as a ROS 2 node: it perceives a pose of someone and publishes its own.

    python -m pipeline.adapters.ros2_animal build/cat [--home build/other] [--seed 0]

Subscribes `observer` (`geometry_msgs/PoseStamped`, +z up, meters): where the eyes of a person or the camera
of a robot are. Publishes, ten times a second of the node's clock (`use_sim_time` works), `animal`
(`PoseStamped`: the root, x ahead and z up as REP 103 has it) and `bones` (`PoseArray`, bones at their
centers), all in the frame `map`. Needs ROS 2 (`rclpy`, `geometry_msgs`), which no wheel brings along.
"""

import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.adapters.live_animal import ZUP_FROM_WORLD, LiveAnimal
from pipeline.behavior.trajectories import RATE_HZ
from pipeline.core.errors import CommandLine, exit_code
from pipeline.geometry import rigid

FRAME = "map"
AGENT_FROM_BODY = np.array([[0.0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
"""From REP 103 (x ahead, y left, z up) to the agent's axes (z ahead, x left, y up)."""
FAR_M = 1000.0
"""An observer of whom nothing has been heard stands so far away that nobody perceives it."""


class AnimalNode:
    """Owns a ROS 2 node; the messages' module is given, so that it is known without ROS too."""

    def __init__(self, node: Any, messages: Any, animal: LiveAnimal):
        """Declare topics and timer on an `rclpy` node; ``messages`` is `geometry_msgs.msg`."""
        self.node, self.messages, self.animal = node, messages, animal
        self.observer_world = np.array([FAR_M, 0.0, 0.0])
        self.root = node.create_publisher(messages.PoseStamped, "animal", 10)
        self.bones = node.create_publisher(messages.PoseArray, "bones", 10)
        node.create_subscription(messages.PoseStamped, "observer", self.see, 10)
        node.create_timer(1 / RATE_HZ, self.step)

    def see(self, message: Any) -> None:
        """Keep where the observer is."""
        place = message.pose.position
        seen = ZUP_FROM_WORLD[:3, :3].T @ np.array([place.x, place.y, place.z])
        if np.isfinite(seen).all():  # a tracker that has lost the observer may send NaN
            self.observer_world = seen

    def step(self) -> None:
        """Let 0.1 s pass and publish."""
        pose = self.animal.advance(1 / RATE_HZ, self.observer_world)
        zup_from_agent = ZUP_FROM_WORLD @ pose.world_from_agent
        root = self.messages.PoseStamped(pose=self._pose(zup_from_agent @ AGENT_FROM_BODY))
        bones = self.messages.PoseArray(
            poses=[self._pose(zup_from_agent @ bone) for bone in pose.agent_from_bone]
        )
        for message in (root, bones):
            message.header.frame_id = FRAME
            message.header.stamp = self.node.get_clock().now().to_msg()
        self.root.publish(root)
        self.bones.publish(bones)

    def _pose(self, zup_from_body: Float[np.ndarray, "4 4"]) -> Any:
        place = self.messages.Point(**dict(zip("xyz", zup_from_body[:3, 3].tolist(), strict=True)))
        turn = rigid.quaternion_from_rotation(zup_from_body[:3, :3]).tolist()
        turn = self.messages.Quaternion(**dict(zip("wxyz", turn, strict=True)))
        return self.messages.Pose(position=place, orientation=turn)


def main() -> int:
    """Run the node until ROS shuts it down; return 2 for a build or options that cannot be used."""
    parser = CommandLine(__doc__, prog="python -m pipeline.adapters.ros2_animal")
    parser.add_argument("build", type=Path)
    parser.add_argument("--home", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    asked, for_ros = parser.parse_known_args()
    try:
        rclpy, messages = import_module("rclpy"), import_module("geometry_msgs.msg")
    except ModuleNotFoundError as error:
        parser.exit(2, f"{error}: source the setup file of ROS 2 (/opt/ros/.../setup.bash) first\n")
    animal = LiveAnimal.open(asked.build, home=asked.home, seed=asked.seed)
    rclpy.init(args=for_ros)
    node = rclpy.create_node("animal")
    AnimalNode(node, messages, animal)
    try:
        rclpy.spin(node)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
