"""AgileX Piper on its real link: six joints and a gripper on CAN.

The arm holds the last position that it received, so it stays there if the driver dies. The driver
never uses the arm's own stop, which lets it sink (see protocol.py).
"""

import asyncio
import contextlib
import logging
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

from msgspec import Meta
from msgspec.structs import replace

from gigabrain_drivers.bodies.piper import protocol as piper
from gigabrain_drivers.bodies.piper.feedback import Feedback
from gigabrain_drivers.driver.base import Driver
from gigabrain_drivers.driver.robot import LinkOptions, RobotFile, Run
from gigabrain_drivers.links.can_link import (
    CanDecoder,
    CanFrame,
    CanLink,
    CanSpelling,
    check_can_port,
    records,
)
from gigabrain_drivers.links.frames import Wording
from gigabrain_drivers.links.link import Link
from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import Joint, LinkHealth, RobotState
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.errors import BodyLost
from gigabrain_zenoh.logs import Fault

log = logging.getLogger(__name__)

LOST_NS = 100_000_000  # the arm counts as lost after this time without reports of all joints
CHECK_PERIOD_NS = 20_000_000  # between two checks of its reports
ENABLE_PERIOD_NS = 100_000_000  # between two attempts to switch its motors on
ENABLE_TIMEOUT_NS = 3_000_000_000  # then a motor that stays off is reported
LOG_AFTER_NS = 500_000_000  # a problem is logged after this time
NOTHING_COMES = "no arm reports: is its power on, and its CAN cable plugged in?"


class PiperOptions(LinkOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The arm's part of a robot's file."""

    port: str = "can0"  # a SocketCAN interface
    gripper_torque: Annotated[float, Meta(gt=0.0, le=piper.MAX_GRIPPER_TORQUE)] = 1.0
    # [N m], maximum of its motor

    def __post_init__(self) -> None:
        check_can_port(self.port)


class PiperDriver(Driver):
    """Switches on the motors at the arm's position, and sends positions at once."""

    Options = PiperOptions

    def __init__(
        self,
        robot: RobotFile,
        options: PiperOptions,
        run: Run,
        *,
        clock: Clock | None = None,
        link: Link | None = None,
    ) -> None:
        """`link` replaces the CAN bus in the options."""
        super().__init__(robot, options, run)
        self._clock = clock or Clock()
        self.link = link or CanLink(options.port, self._clock, piper.RECEIVED)
        self.link.wording = Wording(CanSpelling(piper.describe), CanSpelling(piper.describe))
        self.link.on_bytes, self.link.on_open = self._received, self._opened
        self.link.on_lost = self._lost
        self._names = [joint.name for joint in robot.joints]
        self._decoder, self._feedback = CanDecoder(), Feedback(robot.joints)
        self._torque = options.gripper_torque
        self._targets: list[float] | None = None  # of all joints; None: their present positions
        self._joints: tuple[Joint, ...] = ()  # measured before the newest connection
        self._hold_on = True  # the motors should be on
        self._were_on = False
        self._enabling_ns: int | None = None  # start of switching them on
        self._asked_ns = 0
        self._unreported = False  # a loss was not reported yet
        self._unplaced = True  # the gate does not yet know the position after a new connection
        self._open = False
        self._well_ns = self._clock.now_ns()
        self._fault, self._named = Fault(log), set[str]()  # problems since all was well
        self._task: asyncio.Task[None] | None = None

    @classmethod
    def check(cls, robot: RobotFile, options: Any) -> None:
        """Raise ValueError if the joints are not those of a Piper."""
        parts = [joint.part for joint in robot.joints]
        if parts not in (["arm"] * piper.JOINTS, ["arm"] * piper.JOINTS + ["gripper"]):
            raise ValueError("joints: expected the six of a Piper, and its gripper last if any")

    @property
    def problem(self) -> str:
        """The reason in one line why the arm cannot be moved, or an empty text."""
        if self.link.problem:
            return self.link.problem
        if not self._fresh():
            return NOTHING_COMES
        if text := self._feedback.problem():
            return text
        waited_ns = self._clock.now_ns() - (self._enabling_ns or self._clock.now_ns())
        if waited_ns > ENABLE_TIMEOUT_NS:
            motor = self._feedback.motors_on.index(False) + 1
            return f"motor {motor} does not switch on: switch the arm off and on"
        return ""

    async def open(self) -> None:
        """Start connecting to the arm, which may appear later. It does not move."""
        self._open = self._hold_on = True
        self.link.open()
        self._task = asyncio.create_task(self._watch(), name="piper watch")

    async def close(self) -> None:
        """Disconnect; the arm holds its position, and motors stay as they are."""
        task, self._task = self._task, None
        await self.stop()
        if task:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
        self._open = False
        await self.link.close()

    async def stop(self) -> None:
        """Hold the last sent position, or the present one."""
        if self._movable():
            self._send(self._targets or self._feedback.positions)

    async def limp(self) -> None:
        """Switch off all joints, so that the arm may fall, until the next positions.

        Raises BodyLost.
        """
        if not self._fresh():
            raise BodyLost(f"{self.link}: {self.problem}")
        frames = [piper.enable(on=False)]
        if len(self._names) > piper.JOINTS:
            width = 2 * self._feedback.positions[-1]
            frames.append(piper.move_gripper(width, 0.0, piper.GRIPPER_OFF))
        if not self.link.write(records(frames)):
            raise BodyLost(f"{self.link}: {self.problem}")
        self._hold_on = self._were_on = False
        self._targets = self._enabling_ns = None

    async def set_joint_positions(self, positions: Mapping[str, float]) -> Mapping[str, float]:
        """Move joints together [rad] or [m]; if one is not a number, all stay.

        Returns the sent positions; while the arm cannot move, those that it will hold. Raises
        Unsupported, and BodyLost before the arm has reported.
        """
        within = self.bounded_joints(positions)
        measured = [joint.position for joint in self._measured()]
        if not self._open or not measured:
            raise BodyLost(f"{self.link}: {self.problem or NOTHING_COMES}")
        if not self._hold_on:
            self._hold_on, self._asked_ns = True, 0
        elif self._movable() and within.keys() == positions.keys():
            self._targets = self._quantised(within)
            self._send(self._targets)
        held = dict(zip(self._names, self._targets or measured, strict=True))
        return {name: held[name] for name in positions}

    async def read_state(self) -> RobotState:
        """Return the arm's reports; `link` shows whether they are recent and without faults.

        The first state of a connection is always limp, so that the gate starts from its position.
        """
        limp = self._feedback.complete and (self._unplaced or not all(self._feedback.motors_on))
        self._unplaced = self._unplaced and not self._feedback.complete
        return RobotState(
            robot_type=self.robot.robot_type,
            pose=Pose(x=0.0, y=0.0, yaw=0.0),
            velocity=Velocity(),
            joints=self._measured(),
            joints_sent=tuple(self._targets or ()),
            limp=limp,
            link=self._health(),
        )

    def _measured(self) -> tuple[Joint, ...]:
        """Return the newest joints, if necessary of the previous connection."""
        if not self._feedback.complete:
            return self._joints
        return self._feedback.joints(self._clock.now_ns())

    def _fresh(self) -> bool:
        stamp_ns = self._feedback.stamp_ns()
        recent = stamp_ns is not None and self._clock.now_ns() - stamp_ns <= LOST_NS
        return recent and self._feedback.complete and self.link.connected

    def _movable(self) -> bool:
        """Return whether positions reach motors that hold, and should hold.

        Otherwise a position would switch on a limp gripper.
        """
        feedback = self._feedback
        holds = self._hold_on and all(feedback.motors_on)
        return holds and self._fresh() and not feedback.problem()

    def _quantised(self, positions: Mapping[str, float]) -> list[float]:
        """Return the targets of all joints, rounded to the arm's units."""
        now = self._targets or self._feedback.positions
        goals = []
        for joint, present in zip(self.robot.joints, now, strict=True):
            unit = piper.ANGLE_UNIT if joint.part == "arm" else piper.WIDTH_UNIT / 2
            goals.append(round(positions.get(joint.name, present) / unit) * unit)
        return goals

    def _send(self, targets: Sequence[float], *more: CanFrame) -> None:
        """Send positions of all joints, and the mode that follows them."""
        frames = [
            *piper.move(targets[: piper.JOINTS]),
            piper.mode(piper.BY_CAN, piper.MOVE_J, piper.FULL_SPEED),
            *(piper.move_gripper(2 * at, self._torque) for at in targets[piper.JOINTS :]),
            *more,
        ]
        self.link.write(records(frames))

    def _opened(self) -> None:
        """Reset all state for a new connection."""
        self._joints = self._measured()
        self._feedback.clear()
        self._targets, self._enabling_ns, self._unplaced = None, None, True

    def _lost(self, _why: str) -> None:
        self._unreported = self._unreported or self._feedback.complete

    def _received(self, data: bytes) -> None:
        now_ns = self._clock.now_ns()
        for frame in self._decoder.feed(data):
            self._feedback.take(frame, now_ns)
        self.link.errors = self._decoder.errors + self._feedback.errors

    async def _watch(self) -> None:
        async for now_ns in self._clock.every(CHECK_PERIOD_NS):
            self._supervise(now_ns)
            self._log_problem(now_ns)

    def _supervise(self, now_ns: int) -> None:
        """Switch on motors at their positions, and notice those that switch off by themselves."""
        if not self._fresh():
            self._targets = None
            return
        on = self._feedback.motors_on
        if all(on):
            self._were_on, self._enabling_ns = self._hold_on, None
            return
        if self._were_on:
            log.warning("motor %d has switched itself off; enable the robot again", _off(on))
            self._were_on = self._hold_on = False
            self._targets, self._unreported = None, True
        if self._hold_on and not self._feedback.problem():
            self._switch_on(now_ns)

    def _switch_on(self, now_ns: int) -> None:
        """Send the present position, then switch on; after a reset the arm needs both twice."""
        self._enabling_ns = self._enabling_ns or now_ns
        if now_ns - self._asked_ns >= ENABLE_PERIOD_NS:
            self._asked_ns = now_ns
            self._send(self._feedback.positions, piper.enable(on=True))

    def _log_problem(self, now_ns: int) -> None:
        """Log each lasting problem once when it begins, and the end of all once.

        A silent bus is opened again and again, so two problems alternate.
        """
        problem = self.problem
        if not problem:
            self._well_ns, self._named = now_ns, set()
            self._fault.end(f"{self.link}: the arm reports, and all is well")
        elif now_ns - self._well_ns >= LOG_AFTER_NS and problem not in self._named:
            self._named.add(problem)
            self._fault = Fault(log)
            self._fault.begin(problem if str(self.link) in problem else f"{self.link}: {problem}")

    def _health(self) -> LinkHealth:
        """Return the link's health: connected if the arm reports and has no fault."""
        reported, self._unreported = not self._unreported, False
        stamp_ns = self._feedback.stamp_ns()
        age_ns = self._clock.now_ns() - stamp_ns if stamp_ns is not None else self.link.age_ns
        return replace(
            self.link.health,
            connected=self._fresh() and reported and not self._feedback.problem(),
            age_ms=age_ns / 1e6,
        )


def _off(on: Sequence[bool]) -> int:
    """Return the number of the first motor that is off."""
    return on.index(False) + 1
