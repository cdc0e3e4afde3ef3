"""ROS interfaces that move joints: topic joint_trajectory, action follow_joint_trajectory.

Both are offered after the description of a body with joints.
"""

import asyncio
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from gigabrain_schemas.body import Body
from gigabrain_zenoh.config.settings import Ros2Config
from gigabrain_zenoh.errors import GigabrainError, Refused
from gigabrain_zenoh.gateway.background import Background
from gigabrain_zenoh.gateway.commander import Silence
from gigabrain_zenoh.gateway.conversions.diagnostics import Status
from gigabrain_zenoh.gateway.conversions.frames import Make, header
from gigabrain_zenoh.gateway.goal_tasks import GoalTasks
from gigabrain_zenoh.gateway.joint_path import Code, Unfit, tolerances
from gigabrain_zenoh.gateway.joints import Ended, JointCommander, JointMotion, Progress
from gigabrain_zenoh.gateway.scene import Scene, left_out
from gigabrain_zenoh.gateway.topic_requests import TopicRequests
from gigabrain_zenoh.ros2.actions import ActionServer, Goal, GoalState, Outcome
from gigabrain_zenoh.ros2.transport import RosTransport
from gigabrain_zenoh.ros2.types import Types

TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
FOLLOW_TYPE = "control_msgs/action/FollowJointTrajectory"
TOPIC, ACTION = "joint_trajectory", "follow_joint_trajectory"
MAX_BYTES = 256 << 10  # of a trajectory: 1500 points of six joints, with accelerations
FEEDBACK_TICKS = 2  # 40 ms, between two feedbacks


def feedback(make: Make, names: Sequence[str], at_ns: int, progress: Progress) -> Any:
    """Return the feedback of FollowJointTrajectory, with all joints."""
    desired, actual = (
        np.array([(point.position, point.velocity) for point in points])
        for points in (progress.desired, progress.actual)
    )
    since = round(progress.seconds * 1e9)
    parts = {"desired": desired, "actual": actual, "error": desired - actual}
    return make(
        f"{FOLLOW_TYPE}_Feedback",
        header=header(make, at_ns, ""),
        joint_names=list(names),
        **{name: _point(make, rows, since) for name, rows in parts.items()},
    )


def _point(make: Make, rows: Any, since_ns: int) -> Any:
    sec, nanosec = divmod(since_ns, 10**9)
    return make(
        "trajectory_msgs/msg/JointTrajectoryPoint",
        positions=rows[:, 0].copy(),
        velocities=rows[:, 1].copy(),
        time_from_start=make("builtin_interfaces/msg/Duration", sec=sec, nanosec=nanosec),
    )


class FollowHandler(GoalTasks):
    """Carries out the goals of the action."""

    def __init__(self, scene: Scene, types: Types, commander: JointCommander) -> None:
        super().__init__()
        self._scene, self._types, self._commander = scene, types, commander

    def accept(self, message: Any) -> bool:
        """Accept any goal; `run` reports its faults by code."""
        return True

    async def run(self, goal: Goal, feed: Callable[[Any], None]) -> Outcome:
        """Follow the trajectory of a goal until its end."""
        body = self._scene.description
        assert body  # the action is offered only for a known body
        told_tick = 0

        def tell(progress: Progress) -> None:
            nonlocal told_tick
            tick = self._scene.bus.time.tick
            if tick - told_tick >= FEEDBACK_TICKS:
                told_tick = tick
                names = [joint.name for joint in body.joints]
                feed(feedback(self._types.make, names, self._scene.ros_ns(), progress))

        try:
            message = goal.message
            if message.multi_dof_trajectory.points or message.multi_dof_trajectory.joint_names:
                raise Unfit(Code.INVALID_JOINTS, "it has no joints of several degrees of freedom")
            allowed = tolerances(body, message)
            path, waits_s = self._commander.judge(message.trajectory)
        except GigabrainError as error:
            return _outcome(_ended(error))

        async def carry_out() -> Outcome:
            motion: JointMotion | None = None
            try:
                motion = await self._commander.begin(path, waits_s, allowed, tell)
                return _outcome(await motion.done)
            except GigabrainError as error:
                return _outcome(_ended(error))
            except asyncio.CancelledError:
                if motion:
                    self._commander.cancel(motion)
                raise

        return await self.carried_out(goal, carry_out)


def _ended(error: GigabrainError) -> Ended:
    return Ended(error.code if isinstance(error, Unfit) else Code.INVALID_GOAL, str(error))


def _outcome(how: Ended) -> Outcome:
    succeeded = how.code is Code.SUCCESSFUL and not how.replaced
    state = GoalState.SUCCEEDED if succeeded else GoalState.ABORTED
    return Outcome(state, {"error_code": int(how.code), "error_string": how.text})


class JointRequests:
    """The topic and the action on a transport."""

    def __init__(
        self, scene: Scene, ros: RosTransport, types: Types, config: Ros2Config, work: Background
    ) -> None:
        self._scene, self._ros, self._types, self._config = scene, ros, types, config
        self._work = work
        self._requests = TopicRequests(scene.bus, ros, types, work)
        self._commander: JointCommander | None = None
        self._server: ActionServer | None = None
        self._silence = Silence()  # since the last trajectory on the topic
        scene.on_body.append(self._offer)
        scene.on_state.append(lambda _: self._listen())

    def forget(self, why: str) -> None:
        """Stop commanding joints at once."""
        if self._commander:
            self._commander.forget(why)

    def status(self) -> list[Status]:
        """Return a line of diagnostics with the topic's last refusal."""
        return self._requests.status()

    async def close(self) -> None:
        """Withdraw the action; its goal ends as aborted."""
        if self._server:
            await self._server.close()

    def _offer(self, body: Body) -> None:
        if self._commander or not body.description.joints:
            return
        self._commander = JointCommander(self._scene, self._config)
        if not left_out(self._config, TOPIC):
            self._requests.serve(TOPIC, TRAJECTORY, self._obey, MAX_BYTES)
        if not left_out(self._config, ACTION):
            self._server = ActionServer(
                self._ros,
                self._types,
                ACTION,
                FOLLOW_TYPE,
                FollowHandler(self._scene, self._types, self._commander),
                preempts=True,
                max_bytes=MAX_BYTES,
                now_ns=self._scene.bus.clock.unix_ns,
            )

    def _listen(self) -> None:
        self._silence = self._silence.then(self._scene.bus.clock.now_ns())

    async def _obey(self, message: Any) -> str:
        """Begin to follow a trajectory of the topic; it replaces any other."""
        commander, body = self._commander, self._scene.description
        assert commander
        assert body
        self._listen()
        if self._silence.is_pause:
            commander.blocked = ""
        self._silence = Silence.broken(self._silence.until_ns)
        if commander.blocked:
            raise Refused(commander.blocked)
        path, waits_s = commander.judge(message)
        motion = await commander.begin(path, waits_s, tolerances(body), lambda _: None)
        self._work.start(self._watch(motion))
        return ""

    async def _watch(self, motion: JointMotion) -> None:
        """Report a trajectory's end in diagnostics, if it was a fault."""
        how = await motion.done
        if how.code is not Code.SUCCESSFUL:
            self._requests.fail(TOPIC, f"stopped: {how.text}")
