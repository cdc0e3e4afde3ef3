"""Makes an arm follow a leader arm that a person moves by hand."""

import asyncio
import math
from collections.abc import Callable, Mapping
from typing import Protocol

from gigabrain_schemas.body import BodyDescription
from gigabrain_zenoh.client.robot import Robot
from gigabrain_zenoh.errors import ConfigError, Refused, Unsupported
from gigabrain_zenoh.geometry.joint_ramp import within
from gigabrain_zenoh.host.signals import run_until, stop_signals
from gigabrain_zenoh.ui.teleop_station import keys_of, typed_keys

APPROACH_SPEED = math.radians(45)  # [rad/s], maximum while the follower is far from the leader
MAX_FOLLOW_ERROR = math.radians(60)  # [rad]; a larger joint error starts a slow approach
MAX_APPROACHED_ERROR = math.radians(3)  # [rad]; the approach ends when all errors are smaller
PROGRESS_TICKS = 50  # between two lines about the approach
JOINT_PREFIX = "arm_"  # joint names of an arm on a base start with it
HELP = "hold the leader and move it; space: e-stop; x or Ctrl-C: end"
Posture = Mapping[str, float]  # [rad] by joint


class Leader(Protocol):
    """The arm that is moved by hand."""

    async def read(self) -> Posture:
        """Return its posture. Raises ConfigError if it is lost."""


class LeaderStation:
    """Sends a leader's posture to a robot, once for each of the robot's states."""

    def __init__(self, robot: Robot, leader: Leader, show: Callable[[str], None]) -> None:
        self._robot, self._leader, self._show = robot, leader, show
        self._ended, self._estop_pressed = asyncio.Event(), False
        self._speed: float | None = APPROACH_SPEED
        self._slow_ticks = 0  # duration of the approach

    async def drive(self, take: bool) -> None:
        """Lead until a key or a signal ends it; then the robot holds its position.

        Raises ConfigError if the leader is lost, or has other joints than the robot. Raises Refused
        if another commander has the robot and `take` is not set, or takes it later.
        """
        body = await self._robot.read_body()
        wanted = follower_posture(body, await self._leader.read())
        state = await self._robot.read_state()
        if state.gate.mode == "enabled" and not take:
            raise Refused(f"{state.gate.commander} drives; take it over with --take")
        await self._robot.enable(take=take)
        self._show(HELP)
        with stop_signals() as signalled, typed_keys(self._on_typed):
            waiting = asyncio.ensure_future(signalled.wait())
            waiting.add_done_callback(lambda _: self._ended.set())
            try:
                await run_until(self._ended, self._follow(body, wanted))
            finally:
                waiting.cancel()
        if self._estop_pressed:
            reply = await self._robot.estop("teleop")
            self._show(f"CONFIRMED by {reply.robot_type}: {reply.text}")
        else:
            await self._robot.stop()
            self._show(f"{body.robot_type} holds where it is")

    def _on_typed(self, typed: str) -> None:
        for key in keys_of(typed):
            self._estop_pressed = self._estop_pressed or key == " "
            if key in (" ", "x", "\x03", "\x04"):
                self._ended.set()

    async def _follow(self, body: BodyDescription, wanted: dict[str, float]) -> None:
        """Follow the leader until cancelled."""
        while True:
            sent = await self._robot.track_joint_positions(wanted, speed=self._speed)
            self._choose_speed(sent, wanted)
            wanted = follower_posture(body, await self._leader.read())

    def _choose_speed(self, sent: Posture, wanted: Posture) -> None:
        """Limit the speed while the follower approaches the leader's posture."""
        name = max(wanted, key=lambda joint: abs(wanted[joint] - sent[joint]))
        error = abs(wanted[name] - sent[name])
        if self._speed and error < MAX_APPROACHED_ERROR:
            self._show("following")
            self._speed, self._slow_ticks = None, 0
        elif self._speed or error > MAX_FOLLOW_ERROR:
            if self._slow_ticks % PROGRESS_TICKS == 0:
                degrees = math.degrees(error)
                self._show(f"slowly to the leader's posture: {name} has {degrees:.0f} deg to go")
            self._speed, self._slow_ticks = APPROACH_SPEED, self._slow_ticks + 1


def follower_posture(body: BodyDescription, posture: Posture) -> dict[str, float]:
    """Return the goal of each joint, within its range, for the posture of a leader.

    Raises Unsupported for a body without joints, and ConfigError for other joints.
    """
    if not body.joints:
        raise Unsupported(f"{body.robot_type} has no arm")
    goals = {}
    for joint in body.joints:
        position = posture.get(joint.name.removeprefix(JOINT_PREFIX))
        if position is not None:
            goals[joint.name] = within(joint, position)
    if len(goals) < len(posture):
        leader, own = (", ".join(names) for names in (posture, (j.name for j in body.joints)))
        raise ConfigError(f"{body.robot_type} cannot follow a leader of {leader}; it has {own}")
    return goals
