"""`gigabrain arm`: the joints of an arm, by hand. People read and type degrees."""

import asyncio
import getpass
import math
import sys
from collections.abc import Awaitable, Callable
from typing import Annotated

from cyclopts import Parameter

from gigabrain_schemas.body import BodyDescription, Joint, JointDescription, RobotState
from gigabrain_schemas.requests import GateReply
from gigabrain_zenoh.cli.options import LOCAL, RobotAddress, Take, check_finite, print_line
from gigabrain_zenoh.client.robot import Robot
from gigabrain_zenoh.errors import ConfigError, Unsupported, unknown
from gigabrain_zenoh.host.signals import run_async

Distance = Annotated[float, Parameter(allow_leading_hyphen=True)]
BAR = 20  # characters of a joint's range
WATCH_S = 0.2
SLOW = math.radians(45)  # [rad/s], of an arm that a person sends somewhere
SURE = "all joints are let go of, and the arm may fall; hold it, and type yes: "


def state(*, watch: bool = False, at: RobotAddress = LOCAL) -> None:
    """Show the joints: position, speed, effort, temperature, and where each is in its range.

    Example: gigabrain arm state

    Args:
        watch: Go on showing them, until Ctrl-C.
    """

    async def show(robot: Robot) -> None:
        body = await _arm(robot)
        if not watch:
            for line in lines(body, await robot.read_state()):
                print_line(line)
            return
        from rich.live import Live
        from rich.text import Text

        with Live(auto_refresh=False) as live:
            while True:
                table = "\n".join(lines(body, await robot.read_state()))
                live.update(Text(table), refresh=True)
                await asyncio.sleep(WATCH_S)

    _with_robot(at, "", show)


def jog(joint: str, distance: Distance, /, *, take: Take = False, at: RobotAddress = LOCAL) -> None:
    """Move one joint by some degrees, or millimetres if it slides, slowly.

    Example: gigabrain arm jog shoulder_pan 10 --take

    Args:
        joint: Name of the joint; see `gigabrain arm state`.
        distance: How far, from where it was sent; negative for the other way.
    """
    check_finite("distance", distance)

    async def move(robot: Robot) -> None:
        body = await _arm(robot)
        known = [one.name for one in body.joints]
        if joint not in known:
            raise unknown("joint", joint, known)
        one, sent = body.joints[known.index(joint)], (await robot.read_state()).joints_sent
        scale, unit = shown_in(one)
        place = sent[known.index(joint)] + distance / scale
        if not one.lower <= place <= one.upper:
            low, high, there = (scale * at for at in (one.lower, one.upper, place))
            raise ConfigError(
                f"{joint}: it goes from {low:.1f} to {high:.1f} {unit}, not to {there:.1f}"
            )
        await _move(robot, take, {joint: place})

    _with_robot(at, "arm", move)


def home(*, take: Take = False, at: RobotAddress = LOCAL) -> None:
    """Move the arm, slowly, to the posture in which it is out of the way.

    Example: gigabrain arm home --take
    """

    async def move(robot: Robot) -> None:
        body = await _arm(robot)
        assert body.arm
        names = [joint.name for joint in body.joints]
        await _move(robot, take, dict(zip(names, body.arm.home, strict=True)))

    _with_robot(at, "arm", move)


def limp(*, yes: bool = False, at: RobotAddress = LOCAL) -> None:
    """Let go of all joints, so that a person can move them. The arm may fall: hold it.

    Example: gigabrain arm limp --yes

    It is refused while the gate is enabled: press the e-stop first.

    Args:
        yes: Do not ask.
    """
    if not yes:
        if not sys.stdin.isatty():
            raise ConfigError("arm limp asks a person first; give --yes where nobody can answer")
        if input(SURE).strip().lower() != "yes":
            print_line("nothing is done")
            return
    _ask(at, lambda robot: robot.limp())


def hold(*, at: RobotAddress = LOCAL) -> None:
    """Hold limp joints again, where they are.

    Example: gigabrain arm hold
    """
    _ask(at, lambda robot: robot.hold())


def _ask(at: RobotAddress, request: Callable[[Robot], Awaitable[GateReply]]) -> None:
    async def ask(robot: Robot) -> None:
        await _arm(robot)
        reply = await request(robot)
        print_line(f"{reply.robot_type}: {reply.text}")

    _with_robot(at, "cli", ask)


def _with_robot(at: RobotAddress, name: str, do: Callable[[Robot], Awaitable[None]]) -> None:
    async def run() -> None:
        async with at.robot(f"{getpass.getuser()}-{name}" if name else "") as robot:
            await do(robot)

    run_async(run())


async def _arm(robot: Robot) -> BodyDescription:
    """Return the description of a body with an arm. Raises Unsupported."""
    body = await robot.read_body()
    if not body.joints:
        raise Unsupported(f"{body.robot_type} has no arm")
    return body


async def _move(robot: Robot, take: bool, positions: dict[str, float]) -> None:
    """Move the joints, and print where they are."""
    if take:
        await robot.enable(take=True)
    found = await robot.set_joint_positions(positions, speed=SLOW)
    for joint in (await robot.read_body()).joints:
        if joint.name in positions:
            scale, unit = shown_in(joint)
            print_line(f"{joint.name} is at {scale * found[joint.name]:.1f} {unit}")


def shown_in(joint: JointDescription) -> tuple[float, str]:
    """Return the factor and the unit in which people read a joint's positions."""
    return (1e3, "mm") if joint.unit == "m" else (math.degrees(1.0), "°")


def lines(body: BodyDescription, state: RobotState) -> list[str]:
    """Return a table of the joints, in degrees, or millimetres of those that slide."""
    measured = {joint.name: joint for joint in state.joints}
    sent = dict(zip((joint.name for joint in body.joints), state.joints_sent, strict=False))
    gate = state.gate
    limp = ", limp" if state.limp else ""
    rows = [f"{state.robot_type}: {gate.mode}, commander {gate.commander or 'none'}{limp}"]
    width = max(len(joint.name) for joint in body.joints)
    rows.append(
        f"{'joint':{width}} {'position':>9} {'sent':>8} {'speed':>9} {'effort':>14} "
        f"{'motor':>6}  range"
    )
    for joint in body.joints:
        found = measured.get(joint.name)
        text = _row(joint, found, sent.get(joint.name)) if found else "not measured"
        rows.append(f"{joint.name:{width}} {text}")
    return rows


def _row(joint: JointDescription, found: Joint, sent: float | None) -> str:
    effort = "" if found.effort is None else f"{found.effort:+.2f}"
    if effort and joint.max_effort:
        effort += f" ({abs(found.effort or 0.0) / joint.max_effort:.0%})"
    motor = "" if found.temperature is None else f"{found.temperature:.0f} °C"
    scale, unit = shown_in(joint)
    wanted = "" if sent is None else f"{scale * sent:+.1f}{unit}"
    here, speed = f"{scale * found.position:+.1f}{unit}", f"{scale * found.velocity:+.0f} {unit}/s"
    low, high = (f"{scale * end:+.0f}{unit}" for end in (joint.lower, joint.upper))
    return (
        f"{here:>9} {wanted:>8} {speed:>9} {effort:>14} {motor:>6}  "
        f"{low:>6} {bar(joint, found.position)} {high}"
    )


def bar(joint: JointDescription, position: float) -> str:
    """Return a joint's range with its place in it."""
    share = (position - joint.lower) / (joint.upper - joint.lower)
    place = round(max(0.0, min(1.0, share)) * (BAR - 1))
    return "─" * place + "●" + "─" * (BAR - 1 - place)
