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

APPROACH_SPEED = math.radians(45)  # [rad/s], of the follower towards the leader's posture
# largest joint error [rad] at which a slow approach begins, and at which it ends:
FAR, NEAR = math.radians(60), math.radians(3)
PROGRESS_TICKS = 50  # between two lines about the approach
PREFIX = "arm_"  # of joint names of an arm on a base
HELP = "hold the leader and move it; space: e-stop; x or Ctrl-C: end"
Posture = Mapping[str, float]  # [rad] by joint


class Leader(Protocol):
    """The arm that is moved by hand."""

    async def read(self) -> Posture:
        """Return its posture. Raises ConfigError if it is lost."""


class LeaderStation:
    """Sends a leader's posture to a robot at each of its states."""

    def __init__(self, robot: Robot, leader: Leader, say: Callable[[str], None]) -> None:
        self._robot, self._leader, self._say = robot, leader, say
        self._ended, self._pressed = asyncio.Event(), False
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
        self._say(HELP)
        with stop_signals() as signalled, typed_keys(self._type):
            ends = asyncio.ensure_future(signalled.wait())
            ends.add_done_callback(lambda _: self._ended.set())
            try:
                await run_until(self._ended, self._follow(body, wanted))
            finally:
                ends.cancel()
        if self._pressed:
            reply = await self._robot.estop("teleop")
            self._say(f"CONFIRMED by {reply.robot_type}: {reply.text}")
        else:
            await self._robot.stop()
            self._say(f"{body.robot_type} holds where it is")

    def _type(self, typed: str) -> None:
        for key in keys_of(typed):
            self._pressed = self._pressed or key == " "
            if key in (" ", "x", "\x03", "\x04"):
                self._ended.set()

    async def _follow(self, body: BodyDescription, wanted: dict[str, float]) -> None:
        """Follow the leader until cancelled."""
        while True:
            sent = await self._robot.track_joint_positions(wanted, speed=self._speed)
            self._choose_speed(sent, wanted)
            wanted = follower_posture(body, await self._leader.read())

    def _choose_speed(self, sent: Posture, wanted: Posture) -> None:
        """Limit the speed until the follower has the leader's posture."""
        name = max(wanted, key=lambda one: abs(wanted[one] - sent[one]))
        off = abs(wanted[name] - sent[name])
        if self._speed and off < NEAR:
            self._say("following")
            self._speed, self._slow_ticks = None, 0
        elif self._speed or off > FAR:
            if self._slow_ticks % PROGRESS_TICKS == 0:
                degrees = math.degrees(off)
                self._say(f"slowly to the leader's posture: {name} has {degrees:.0f} deg to go")
            self._speed, self._slow_ticks = APPROACH_SPEED, self._slow_ticks + 1


def follower_posture(body: BodyDescription, posture: Posture) -> dict[str, float]:
    """Return the goal of each joint, within its range, for the posture of a leader.

    Raises Unsupported for a body without joints, and ConfigError for other joints.
    """
    if not body.joints:
        raise Unsupported(f"{body.robot_type} has no arm")
    found = {}
    for joint in body.joints:
        place = posture.get(joint.name.removeprefix(PREFIX))
        if place is not None:
            found[joint.name] = within(joint, place)
    if len(found) < len(posture):
        here, there = (", ".join(names) for names in (posture, (j.name for j in body.joints)))
        raise ConfigError(f"{body.robot_type} cannot follow a leader of {here}; it has {there}")
    return found
