"""`gigabrain arm`: shows and moves the joints of an arm. Angles are in degrees."""

import asyncio
import math
import re
import sys
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from gigabrain_schemas.body import BodyDescription, Joint, JointDescription, RobotState
from gigabrain_schemas.requests import GateReply
from gigabrain_zenoh.cli.options import LOCAL, RobotAddress, Take, check_name, print_line
from gigabrain_zenoh.cli.task import Mode, Wait, send
from gigabrain_zenoh.client.arm import held_posture
from gigabrain_zenoh.client.robot import Robot
from gigabrain_zenoh.decision.tasks.arm_steps import describe, describe_point
from gigabrain_zenoh.errors import ConfigError, Unsupported, unknown
from gigabrain_zenoh.host.signals import run_async
from gigabrain_zenoh.host.this_process import user_name

if TYPE_CHECKING:
    from gigabrain_zenoh.decision.tasks.mission import Mission

Metres = Annotated[float, Parameter(allow_leading_hyphen=True)]
Distance = Annotated[float, Parameter(allow_leading_hyphen=True)]
BAR_CHARS = 20  # width of the bar of a joint's range
WATCH_PERIOD_S = 0.2
MAX_LABEL_CHARS = 64
HAND_SPEED = math.radians(45)  # [rad/s], speed limit of motions by hand
LIMP_PROMPT = "the motors switch off, and the arm may fall; hold it, then type yes: "


def state(*, watch: bool = False, at: RobotAddress = LOCAL) -> None:
    """Show the joints: position, speed, effort, temperature, and where each is in its range.

    Example: gigabrain arm state

    Args:
        watch: Update continuously, until Ctrl-C.
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
                await asyncio.sleep(WATCH_PERIOD_S)

    _with_robot(at, "", show)


def jog(joint: str, distance: Distance, /, *, take: Take = False, at: RobotAddress = LOCAL) -> None:
    """Move one joint slowly, in degrees, or in mm if it is prismatic.

    Example: gigabrain arm jog shoulder_pan 10 --take

    Args:
        joint: Name of the joint; see `gigabrain arm state`.
        distance: Distance from the last commanded position; may be negative. For a limp joint:
            distance from its measured position.
    """

    check_name("JOINT", joint)

    async def move(robot: Robot) -> None:
        body = await _arm(robot)
        names = [each.name for each in body.joints]
        if joint not in names:
            raise unknown("joint", joint, names)
        index, posture = names.index(joint), held_posture(body, await robot.read_state())
        limits = body.joints[index]
        scale, unit = shown_in(limits)
        goal = posture[index].position + distance / scale
        if not limits.lower <= goal <= limits.upper:
            low, high, wanted = (scale * at for at in (limits.lower, limits.upper, goal))
            raise ConfigError(
                f"{joint}: expected a goal from {low:.1f} to {high:.1f} {unit}, got {wanted:.1f}"
            )
        await _move(robot, take, {joint: goal})

    _with_robot(at, "arm", move)


def home(*, take: Take = False, at: RobotAddress = LOCAL) -> None:
    """Move the arm slowly to its home posture, out of the way.

    Example: gigabrain arm home --take
    """

    async def move(robot: Robot) -> None:
        body = await _arm(robot)
        assert body.arm
        names = [joint.name for joint in body.joints]
        await _move(robot, take, dict(zip(names, body.arm.home, strict=True)))

    _with_robot(at, "arm", move)


def goto(
    x: Metres,
    y: Metres,
    z: Metres,
    /,
    *,
    pitch: Distance | None = None,
    mode: Mode = "replace",
    wait: Wait = True,
    at: RobotAddress = LOCAL,
) -> None:
    """Move the tool to a point, around obstacles.

    Example: gigabrain arm goto 0.22 0.05 0.12 --pitch 60

    If it cannot, it prints why. For a point out of reach it prints the nearest one.

    Args:
        x: Forwards, from the arm's base [m].
        y: To the left [m].
        z: Up [m].
        pitch: Angle of the tool below the horizontal [degrees]. Default: any.
    """
    from gigabrain_zenoh.decision.tasks.arm_steps import Reach
    from gigabrain_zenoh.decision.tasks.mission import Mission, Step

    down = _radians(pitch)
    _carry_out(at, Mission(do=(Step(reach=Reach(at=(x, y, z), pitch=down)),)), mode, wait)


def pick(
    x: Metres,
    y: Metres,
    z: Metres,
    /,
    *,
    box: tuple[float, float, float] | None = None,
    cylinder: tuple[float, float] | None = None,
    sphere: float | None = None,
    yaw: Distance = 0.0,
    mode: Mode = "replace",
    wait: Wait = True,
    at: RobotAddress = LOCAL,
) -> None:
    """Pick up a thing whose middle is at a point.

    Example: gigabrain arm pick 0.2388 0 0.015 --box 0.03 0.03 0.03

    Args:
        x: Forwards, from the arm's base [m].
        y: To the left [m].
        z: Up [m].
        box: Its lengths along x, y and z [m].
        cylinder: Its radius and its height [m].
        sphere: Its radius [m].
        yaw: Rotation of the thing about the vertical [degrees].
    """
    from gigabrain_zenoh.decision.tasks.arm_steps import Solid
    from gigabrain_zenoh.decision.tasks.mission import Mission, Step

    shapes = sum(shape is not None for shape in (box, cylinder, sphere))
    if shapes != 1:
        raise ConfigError(f"arm pick: expected one of --box, --cylinder and --sphere, got {shapes}")
    thing = Solid(box=box, cylinder=cylinder, sphere=sphere, at=(x, y, z), yaw=math.radians(yaw))
    name = f"the thing at {describe_point((x, y, z))}"  # differs from a thing in the gripper
    _carry_out(at, Mission(things={name: thing}, do=(Step(pick=name),)), mode, wait)


def pick_seen(
    label: str, /, *, mode: Mode = "replace", wait: Wait = True, at: RobotAddress = LOCAL
) -> None:
    """Pick up a thing that the camera recognises; a robot that drives looks for one first.

    Example: gigabrain pick can

    It needs a depth camera, and the process `recognition`: start the robot with --cameras.

    Args:
        label: Class of the thing; docs/how-to/recognition.md lists them.
    """
    from gigabrain_zenoh.decision.tasks.arm_steps import Solid
    from gigabrain_zenoh.decision.tasks.mission import Mission, Step

    if not 0 < len(label) <= MAX_LABEL_CHARS:
        raise ConfigError(
            f"pick: expected a class of at most {MAX_LABEL_CHARS} characters, such as can"
        )
    mission = Mission(things={label: Solid(label=label)}, do=(Step(pick=label),))
    _carry_out(at, mission, mode, wait)


def place(
    x: Metres,
    y: Metres,
    z: Metres,
    /,
    *,
    mode: Mode = "replace",
    wait: Wait = True,
    at: RobotAddress = LOCAL,
) -> None:
    """Put down what the gripper holds, its middle at a point.

    Example: gigabrain arm place 0.14 0.15 0.015

    Args:
        x: Forwards, from the arm's base [m].
        y: To the left [m].
        z: Up [m].
    """
    from gigabrain_zenoh.decision.tasks.mission import Mission, Step

    _carry_out(at, Mission(do=(Step(place=(x, y, z)),)), mode, wait)


def press(
    x: Metres,
    y: Metres,
    z: Metres,
    /,
    *,
    pitch: Distance | None = None,
    depth: float = 0.03,
    force: float = 4.0,
    seconds: float = 0.5,
    mode: Mode = "replace",
    wait: Wait = True,
    at: RobotAddress = LOCAL,
) -> None:
    """Press a place with the closed gripper, such as a button, and go back.

    Example: gigabrain arm press 0.25 0 0.05 --pitch 90

    Args:
        x: Forwards, from the arm's base [m].
        y: To the left [m].
        z: Up [m].
        pitch: Angle of the tool below the horizontal [degrees]. Default: any.
        depth: Maximum travel beyond the point [m].
        force: Force to press with [N].
        seconds: Time to press [s].
    """
    from gigabrain_zenoh.decision.tasks.arm_steps import Press
    from gigabrain_zenoh.decision.tasks.mission import Mission, Step

    down = _radians(pitch)
    what = Press(at=(x, y, z), pitch=down, depth=depth, force=force, seconds=seconds)
    _carry_out(at, Mission(do=(Step(press=what),)), mode, wait)


def hand_over(
    *,
    to: tuple[float, float, float] | None = None,
    pitch: Distance | None = None,
    seconds: float = 60.0,
    mode: Mode = "replace",
    wait: Wait = True,
    at: RobotAddress = LOCAL,
) -> None:
    """Hand what the gripper holds to a person: the gripper opens when the person pulls.

    Example: gigabrain arm hand-over

    `gigabrain task resume` opens it, too.

    Args:
        to: Point to hand over at: x y z from the arm's base [m]. Default: ahead of the arm.
        pitch: Angle of the tool below the horizontal [degrees]. Default: any.
        seconds: Time to wait for the person [s]; then it keeps the thing.
    """
    from gigabrain_zenoh.decision.tasks.arm_steps import HandOver
    from gigabrain_zenoh.decision.tasks.mission import Mission, Step

    down = _radians(pitch)
    what = HandOver(at=to, pitch=down, seconds=seconds)
    _carry_out(at, Mission(do=(Step(hand_over=what),)), mode, wait)


def limp(*, yes: bool = False, at: RobotAddress = LOCAL) -> None:
    """Switch joint torque off, to move the joints by hand. The arm may fall: hold it.

    Example: gigabrain arm limp --yes

    It is refused while the gate is enabled: press the e-stop first.

    Args:
        yes: Do not ask.
    """
    if not yes:
        if not sys.stdin.isatty():
            raise ConfigError("arm limp needs an answer, but there is no terminal; add --yes")
        print(LIMP_PROMPT, end="", flush=True)
        if sys.stdin.readline().strip().lower() != "yes":  # empty at Ctrl-D
            print_line("nothing was done")
            return
    _ask(at, lambda robot: robot.limp())


def hold(*, at: RobotAddress = LOCAL) -> None:
    """Hold limp joints again, where they are.

    Example: gigabrain arm hold
    """
    _ask(at, lambda robot: robot.hold())


def _radians(degrees: float | None) -> float | None:
    return None if degrees is None else math.radians(degrees)


def _carry_out(at: RobotAddress, mission: "Mission", mode: Mode, wait: bool) -> None:
    from gigabrain_zenoh.decision.tasks.mission import text_of
    from gigabrain_zenoh.decision.tasks.mission_files import loads

    text, label = text_of(mission), describe(mission.arm_actions[0])
    try:
        loads(text, "arm")  # raises for wrong numbers, before connecting
    except ConfigError as error:  # the user has typed no file with lines and steps
        raise ConfigError(re.sub(r"^arm:\d+: (do\[0\]\.|things\.)?", "arm: ", str(error))) from None
    send(at, lambda tasks: tasks.carry_out(text, how=mode, label=label), wait)


def _ask(at: RobotAddress, request: Callable[[Robot], Awaitable[GateReply]]) -> None:
    async def ask(robot: Robot) -> None:
        await _arm(robot)
        reply = await request(robot)
        print_line(f"{reply.robot_type}: {reply.text}")

    _with_robot(at, "cli", ask)


def _with_robot(at: RobotAddress, name: str, do: Callable[[Robot], Awaitable[None]]) -> None:
    async def run() -> None:
        async with at.robot(f"{user_name()}-{name}" if name else "") as robot:
            await do(robot)

    run_async(run())


async def _arm(robot: Robot) -> BodyDescription:
    """Return the description of a body with an arm. Raises Unsupported."""
    body = await robot.read_body()
    if not body.joints:
        raise Unsupported(f"{body.robot_type} has no arm")
    return body


async def _move(robot: Robot, take: bool, positions: dict[str, float]) -> None:
    """Move the joints, and print their measured positions."""
    if take:
        await robot.enable(take=True)
    found = await robot.set_joint_positions(positions, speed=HAND_SPEED)
    for joint in (await robot.read_body()).joints:
        if joint.name in positions:
            scale, unit = shown_in(joint)
            print_line(f"{joint.name} is at {scale * found[joint.name]:.1f} {unit}")


def shown_in(joint: JointDescription) -> tuple[float, str]:
    """Return the factor to the unit in which a joint's positions are shown, and that unit."""
    return (1e3, "mm") if joint.unit == "m" else (math.degrees(1.0), "°")


def lines(body: BodyDescription, state: RobotState) -> list[str]:
    """Return the lines of a table of the joints, in degrees, or in millimetres if they slide."""
    measured = {joint.name: joint for joint in state.joints}
    positions = () if state.limp else state.joints_sent  # limp joints are not held there
    sent = dict(zip((joint.name for joint in body.joints), positions, strict=False))
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
    """Return a bar of a joint's range, with a mark at its position."""
    share = (position - joint.lower) / (joint.upper - joint.lower)
    place = round(max(0.0, min(1.0, share)) * (BAR_CHARS - 1))
    return "─" * place + "●" + "─" * (BAR_CHARS - 1 - place)
