"""Move two joints of a gigabrain arm and back: a client of follow_joint_trajectory in rclpy.

python move_arm.py [JOINT JOINT]. It plans from joint_states, and prints how far off joints are.
"""

import sys
from collections.abc import Sequence

import rclpy
from builtin_interfaces.msg import Duration
from control_msgs.action import FollowJointTrajectory
from rclpy.action import ActionClient
from rclpy.node import Node
from rclpy.utilities import remove_ros_args
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

WAY = 0.3  # [rad]


class MoveArm(Node):
    """Knows where the joints are, and sends one goal."""

    def __init__(self) -> None:
        super().__init__("move_arm")
        self.places: dict[str, float] = {}
        self.client = ActionClient(self, FollowJointTrajectory, "follow_joint_trajectory")
        self.create_subscription(JointState, "joint_states", self.look, 10)

    def look(self, message: JointState) -> None:
        """Keep the newest positions."""
        self.places = dict(zip(message.name, message.position, strict=True))

    def goal(self, names: Sequence[str]) -> FollowJointTrajectory.Goal:
        """Return a goal: some way and back in four seconds, smoothly."""
        here = [self.places[name] for name in names]
        rest = [0.0] * len(names)
        there = [place + WAY for place in here]
        points = [
            JointTrajectoryPoint(
                positions=places, velocities=rest, time_from_start=Duration(sec=seconds)
            )
            for seconds, places in ((0, here), (2, there), (4, here))
        ]
        trajectory = JointTrajectory(joint_names=list(names), points=points)
        return FollowJointTrajectory.Goal(trajectory=trajectory)

    def feedback(self, message: FollowJointTrajectory.Impl.FeedbackMessage) -> None:
        """Print how far the farthest joint is off."""
        error = max(map(abs, message.feedback.error.positions))
        print(f"{message.feedback.desired.time_from_start.sec} s: {error:.3f} rad off", flush=True)


rclpy.init()
names = remove_ros_args(sys.argv)[1:] or ["shoulder_pan", "wrist_flex"]
node = MoveArm()
node.client.wait_for_server()
while not node.places:
    rclpy.spin_once(node)
sending = node.client.send_goal_async(node.goal(names), feedback_callback=node.feedback)
rclpy.spin_until_future_complete(node, sending)
ending = sending.result().get_result_async()
rclpy.spin_until_future_complete(node, ending)
result = ending.result().result
print(f"ended with code {result.error_code} {result.error_string}".rstrip())
node.destroy_node()
rclpy.try_shutdown()
sys.exit(0 if result.error_code == FollowJointTrajectory.Result.SUCCESSFUL else 1)
