"""Joint trajectories from ROS, for a topic and an action: a commander of the robot's gate.

Control's joint trajectory controller computes a command for each state of the robot. The first
trajectory asks for the body; 0.5 s after the end of the last one the body is given back. A
trajectory that the gate stops does not continue by itself.
"""

import asyncio
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from msgspec.structs import replace

from gigabrain_schemas.base import TICK_NS, TICK_S
from gigabrain_schemas.body import Body, BodyDescription, RobotState
from gigabrain_schemas.brain import Intent, JointTrajectory
from gigabrain_zenoh.client.lease import ControlLease
from gigabrain_zenoh.client.requests import enable
from gigabrain_zenoh.config.settings import Ros2Config
from gigabrain_zenoh.control.joints import SLOW
from gigabrain_zenoh.control.node import ArmControl
from gigabrain_zenoh.errors import BodyLost, Refused, StillStopping
from gigabrain_zenoh.gate.gate import CALM_TICKS
from gigabrain_zenoh.gateway.commander import NO_ROBOT, RELEASE_NS, lost, obstacle
from gigabrain_zenoh.gateway.joint_path import Code, JointPath, Tolerances, judged
from gigabrain_zenoh.gateway.scene import Scene
from gigabrain_zenoh.geometry.joint_ramp import JointPoint, held, measured, prepare

RELEASE_TICKS = RELEASE_NS // TICK_NS  # after the end of a trajectory
ARRIVED = 1e-3  # [rad] or [m], largest distance of the setpoint from the end of a trajectory
STOP_TICKS = 50  # for which it asks a stopping gate again
PAUSE = "pause for 0.5 s before it may move joints again"


class Ended(NamedTuple):
    """The result of a trajectory."""

    code: Code
    text: str = ""
    replaced: bool = False  # by a newer trajectory, which is no fault


class Progress(NamedTuple):
    """The state of all joints, in the body's order, at one time of a trajectory."""

    seconds: float  # since its start
    desired: Sequence[JointPoint]
    actual: Sequence[JointPoint]


OnProgress = Callable[[Progress], None]


class JointMotion:
    """A trajectory in execution."""

    def __init__(
        self, path: JointPath, tolerances: Tolerances, not_before: int, tell: OnProgress
    ) -> None:
        self.path, self.tell = path, tell
        self.begin: int | None = None  # tick; None until the gate lets joints move
        self.not_before = not_before
        self.done: asyncio.Future[Ended] = asyncio.get_running_loop().create_future()
        self._tolerances = tolerances
        joints = tolerances.body.joints
        unchecked = tuple(replace(joint, path_tolerance=0.0) for joint in joints)
        self._at_end = replace(tolerances.body, joints=unchecked)

    def end(self, how: Ended) -> None:
        """End it, if it has not ended."""
        if not self.done.done():
            self.done.set_result(how)

    def passed(self, tick: int) -> float:
        """Return the seconds since its start; negative before."""
        return -math.inf if self.begin is None else (tick - self.begin) * TICK_S

    def body(self, tick: int) -> BodyDescription:
        """Return the body with the tolerances that apply at a tick."""
        return self._tolerances.body if self.passed(tick) < self.path.seconds else self._at_end

    def intent(self, tick: int) -> Intent | None:
        """Return control's intent after the state of a tick; None before the start."""
        passed = self.passed(tick)
        if self.begin is None or passed < 0:
            return None
        start, times = tick, [passed, passed + TICK_S]
        if passed >= self.path.seconds:
            start, times = self.begin + math.ceil(self.path.seconds / TICK_S), [passed]
        rows = np.array([self.path.at(t)[0] for t in times], "<f4")
        window = JointTrajectory(
            name=self.path.names, start=start, period=TICK_S, positions=rows.tobytes()
        )
        return Intent(joint_trajectory=window, behaviour="ros2", reason="a trajectory of ROS")

    def judge(
        self, tick: int, setpoint: Sequence[JointPoint], here: Sequence[JointPoint]
    ) -> Ended | None:
        """Return its end by the measured joints, in addition to control's checks; None: not yet.

        It succeeds when the setpoint is at its end and all its joints are there. Only speeds with a
        tolerance in the goal count.
        """
        passed = self.passed(tick)
        if passed < 0:
            return None
        positions, velocities = self.path.at(passed)
        over = passed >= self.path.seconds
        speeds = self._tolerances.goal_speeds if over else self._tolerances.path_speeds
        points = {joint.name: at for joint, at in zip(self._at_end.joints, here, strict=True)}
        rows = zip(self.path.names, positions, velocities, strict=True)
        off = [(name, points[name].position - place, points[name].velocity - speed)
               for name, place, speed in rows]  # fmt: skip
        fast = [name for name, _, speed in off if abs(speed) > speeds.get(name, math.inf)]
        if fast and not over:
            return Ended(Code.PATH_TOLERANCE_VIOLATED, f"{fast[0]} has another speed than wanted")
        if not over:
            return None
        tolerance = {joint.name: joint.goal_tolerance or math.inf for joint in self._at_end.joints}
        sent = {joint.name: at for joint, at in zip(self._at_end.joints, setpoint, strict=True)}
        ends = zip(self.path.names, positions, strict=True)
        arrived = all(_is_at(sent[name], place) for name, place in ends)
        if arrived and not fast and all(abs(way) <= tolerance[name] for name, way, _ in off):
            return Ended(Code.SUCCESSFUL)
        assert self._at_end.arm
        if fast and passed > self.path.seconds + self._at_end.arm.goal_time:
            return Ended(Code.GOAL_TOLERANCE_VIOLATED, f"{fast[0]} does not come to rest")
        return None

    def progress(self, tick: int, setpoint: Sequence[JointPoint],
                 here: Sequence[JointPoint]) -> Progress:  # fmt: skip
        """Return desired and measured positions of all joints; joints without a target stay."""
        passed = max(0.0, self.passed(tick))
        positions, velocities = self.path.at(passed)
        named = dict(zip(self.path.names, zip(positions, velocities, strict=True), strict=True))
        desired = [
            JointPoint(*map(float, named[joint.name])) if joint.name in named else point
            for joint, point in zip(self._at_end.joints, setpoint, strict=True)
        ]
        return Progress(passed, desired, here)


def _is_at(point: JointPoint, place: float) -> bool:
    return abs(point.position - place) < ARRIVED and abs(point.velocity) < SLOW


class JointCommander:
    """Follows one trajectory at a time; a newer one replaces it."""

    def __init__(self, scene: Scene, config: Ros2Config) -> None:
        self._scene, self._bus, self._take = scene, scene.bus, config.take
        self._name = scene.bus.process
        self._lease, self._asking = ControlLease(self._name), asyncio.Lock()
        self._arm = ArmControl(scene.bus, self._name)
        self._motion: JointMotion | None = None  # even after its success: joints stay there
        self._until_tick = 0  # joints are held until this tick
        self.blocked = ""  # why a stream of trajectories must pause first
        scene.on_state.append(self._observe)

    def judge(self, message: Any) -> tuple[JointPath, float]:
        """Return the path of a JointTrajectory, and the seconds until its start.

        Raises Unfit, and BodyLost while the robot is silent.
        """
        state, body = self._known()
        now = self._arm.memory.setpoint if self._moves(state) else ()
        now = now or held(body.description, state)
        if not now:
            raise BodyLost("its joints are not measured; look at /joint_states")
        return judged(body.description, message, now, self._scene.ros_ns())

    async def begin(
        self, path: JointPath, waits_s: float, tolerances: Tolerances, tell: OnProgress
    ) -> JointMotion:
        """Begin to follow a path, which replaces the present one; its `done` gets the result.

        Raises Refused if the gate does not grant the body, and BodyLost.
        """
        async with self._asking:
            await self._acquire()
        state, _ = self._known()
        motion = JointMotion(path, tolerances, state.tick + math.ceil(waits_s / TICK_S), tell)
        self._drop(Ended(Code.SUCCESSFUL, "replaced by a newer trajectory", replaced=True))
        self._motion, self._until_tick = motion, state.tick + RELEASE_TICKS
        return motion

    def cancel(self, motion: JointMotion) -> None:
        """Stop the joints, if they still follow this motion."""
        if self._motion is motion:
            self._drop(Ended(Code.SUCCESSFUL, "cancelled"))

    def forget(self, why: str) -> None:
        """Stop commanding at once, as for an e-stop."""
        if self._motion and not self._motion.done.done():
            self.blocked = f"{why}; {PAUSE}"
        self._until_tick = 0
        self._drop(Ended(Code.INVALID_GOAL, why))

    def _known(self) -> tuple[RobotState, Body]:
        """Return the newest state and the body. Raises BodyLost."""
        state, body = self._scene.fresh_state, self._scene.body
        if state is None or body is None:
            raise BodyLost(NO_ROBOT)
        return state, body

    def _moves(self, state: RobotState) -> bool:
        """Return whether it commands joints now."""
        return state.tick < self._until_tick and self._lease.has(state)

    async def _acquire(self) -> None:
        """Ask the gate for the body, unless it already obeys this commander."""
        state, body = self._known()
        prepare(len(body.description.joints))
        if self._lease.has(state):
            return
        if text := obstacle(state.gate, self._name, take=self._take):
            raise Refused(text)
        if state.gate.mode == "latched":
            causes = "; ".join(cause.text for cause in state.gate.causes)
            raise Refused(f"latched: {causes}; call the service release first")
        if state.limp:
            raise Refused("its joints are limp; hold them first: gigabrain arm hold")
        for left in reversed(range(STOP_TICKS)):
            try:
                reply = await enable(self._bus, self._name, take=self._take)
            except StillStopping:
                if not left:
                    raise
                await self._bus.clock.sleep_ns(TICK_NS)
            else:
                self._lease.granted(self._bus.time.boot, reply.gate)
                return

    def _observe(self, state: RobotState) -> None:
        """Send the command for a state during a trajectory, and 0.5 s after its end."""
        self._lease.update(state)
        body, motion = self._scene.body, self._motion
        ended = motion is None or motion.done.done()
        if state.tick >= self._until_tick and ended:
            self._motion = None
            return
        if body is None or not body.description.joints:
            self.forget("the body has no joints any more")
            return
        if not self._lease.has(state):
            self.forget(lost(state.gate, self._name))
            return
        if motion is None:
            self._arm.act(state, body, None)
            return
        if not ended:
            self._until_tick = state.tick + RELEASE_TICKS
        if motion.begin is None and self._ready(state):
            motion.begin = max(state.tick, motion.not_before)
        about = replace(body, description=motion.body(state.tick))
        self._arm.act(state, about, motion.intent(state.tick))
        if not ended:
            self._follow(motion, state, body)

    def _ready(self, state: RobotState) -> bool:
        """Return whether the gate lets joints move: not in the first ticks after an enable."""
        memory = self._arm.memory
        same = (memory.boot, memory.enables) == (state.boot, state.gate.enables)
        return same and state.tick - memory.enabled_tick > CALM_TICKS

    def _follow(self, motion: JointMotion, state: RobotState, body: Body) -> None:
        """Report progress, and end the trajectory if it is over."""
        memory, here = self._arm.memory, measured(body.description, state)
        if not here or not memory.setpoint:
            return
        if motion.begin is not None:
            motion.tell(motion.progress(state.tick, memory.setpoint, here))
        code = {
            "path_tolerance": Code.PATH_TOLERANCE_VIOLATED,
            "goal_tolerance": Code.GOAL_TOLERANCE_VIOLATED,
        }.get(memory.problem)
        how = (
            Ended(code, memory.detail) if code else motion.judge(state.tick, memory.setpoint, here)
        )
        if how and how.code is Code.SUCCESSFUL:
            motion.end(how)
        elif how and motion.begin is not None:
            self._drop(how)

    def _drop(self, how: Ended) -> None:
        """End the present trajectory, and stop the joints."""
        motion, self._motion = self._motion, None
        if motion:
            motion.end(how)
