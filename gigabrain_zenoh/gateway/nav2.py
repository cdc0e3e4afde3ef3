"""Nav2's two navigators as ROS actions, which share one robot.

As in Nav2, a new goal of the same action preempts the previous one, which ends as aborted. A goal
of the other action is rejected meanwhile. An invalid goal does not end the present one.
"""

from collections.abc import Callable
from typing import Any

from gigabrain_zenoh.config.settings import Ros2Config
from gigabrain_zenoh.gateway.goal_tasks import GoalTasks
from gigabrain_zenoh.gateway.navigation import (
    EndState,
    Navigator,
    Progress,
    feedback,
    requested,
)
from gigabrain_zenoh.gateway.navigation import Outcome as Ended
from gigabrain_zenoh.gateway.result_codes import THROUGH_POSES, TO_POSE, Codes
from gigabrain_zenoh.gateway.scene import Scene, left_out
from gigabrain_zenoh.ros2.actions import ActionServer, Goal, GoalState, Outcome
from gigabrain_zenoh.ros2.transport import RosServer, RosTransport
from gigabrain_zenoh.ros2.types import Types

TO_POSE_TYPE = "nav2_msgs/action/NavigateToPose"
THROUGH_POSES_TYPE = "nav2_msgs/action/NavigateThroughPoses"


class NavigateHandler(GoalTasks):
    """Carries out the goals of one of the actions."""

    def __init__(
        self, scene: Scene, types: Types, navigator: Navigator, type: str, codes: Codes
    ) -> None:
        super().__init__()
        self._scene, self._types, self._navigator = scene, types, navigator
        self._type, self._codes = type, codes
        self.others: list[NavigateHandler] = []

    def accept(self, message: Any) -> bool:
        """Accept any goal while no other action has the robot; `run` reports its faults."""
        return not any(other.busy for other in self.others)

    async def run(self, goal: Goal, feed: Callable[[Any], None]) -> Outcome:
        """Carry out a goal until its end."""
        message = goal.message
        poses = message.poses if self._type == THROUGH_POSES_TYPE else [message.pose]
        asked = requested(self._codes, poses, message.behavior_tree, self._scene.odom_in_map)
        if asked.fault:
            return _outcome(asked.fault)

        def tell(progress: Progress) -> None:
            made = self._types.make
            feed(feedback(made, self._type, self._scene.ros_ns(), progress))

        async def carry_out() -> Outcome:
            return _outcome(await self._navigator.carry_out(self._codes, asked.poses, tell))

        return await self.carried_out(goal, carry_out)


def _outcome(ended: Ended) -> Outcome:
    state = {
        EndState.SUCCEEDED: GoalState.SUCCEEDED,
        EndState.CANCELED: GoalState.CANCELED,
        EndState.ABORTED: GoalState.ABORTED,
    }[ended.state]
    return Outcome(state, {"error_code": ended.code, "error_msg": ended.text})


class Nav2Actions:
    """The two actions on a transport; the first also on `fleet`."""

    def __init__(
        self,
        scene: Scene,
        ros: RosTransport,
        types: Types,
        config: Ros2Config,
        fleet: RosServer | None = None,
    ) -> None:
        navigator = Navigator(scene)
        rows = (
            ("navigate_to_pose", TO_POSE_TYPE, TO_POSE),
            ("navigate_through_poses", THROUGH_POSES_TYPE, THROUGH_POSES),
        )
        handlers = {
            name: (kind, NavigateHandler(scene, types, navigator, kind, codes))
            for name, kind, codes in rows
            if not left_out(config, name)
        }
        for _, handler in handlers.values():
            handler.others = [one for _, one in handlers.values() if one is not handler]
        self._servers = [
            ActionServer(
                ros,
                types,
                name,
                kind,
                handler,
                preempts=True,
                polled=fleet if kind == TO_POSE_TYPE else None,
                now_ns=scene.bus.clock.unix_ns,
            )
            for name, (kind, handler) in handlers.items()
        ]

    async def close(self) -> None:
        """Withdraw the actions; abort their goals, and cancel their tasks."""
        for server in self._servers:
            await server.close()
