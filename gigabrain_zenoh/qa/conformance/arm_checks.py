"""Checks of bodies with joints: of their driver alone, and behind the gate."""

import math
from collections.abc import Mapping

from gigabrain_schemas.base import TICK_MS
from gigabrain_schemas.body import JointDescription, RobotState
from gigabrain_zenoh.qa.conformance.driver_checks import CheckedRobot, DriverSession
from gigabrain_zenoh.qa.conformance.gated_driver import ATTEMPTS, GatedDriver
from gigabrain_zenoh.qa.judging import Failed, Finding

STILL_TICKS = 50  # 1 s, in which nothing may move
STILL_RAD = math.radians(0.5)  # largest motion meanwhile; [m] for a sliding joint
TRAVEL = 0.15  # of a joint's range, length of a commanded motion
SLACK = 0.02  # of a joint's range: servos give way to weight
TRAVEL_TICKS = 150
MOVE_TICKS = 30
SPEED_SHARE = 0.3  # of a joint's greatest speed
SLOW = 0.2  # [rad/s] or [m/s], a few encoder counts between two states
EXCESS = 1.0  # [rad] or [m], beyond a joint's range
ROUNDED = 0.01  # of a joint's range, largest rounding of its protocol
FREEZE_TICKS = 6  # 120 ms
SILENT_TICKS = 12  # 40 ms of a stream that has ended, then the ramp and the joint's own lag
FELL_RAD = math.radians(2.0)  # largest sag of an arm that holds


async def opens_still(checked: CheckedRobot) -> Finding:
    """Open the driver, and send each joint where it is: nothing moves."""
    async with DriverSession(checked) as it:
        await it.connected()
        before = _positions(it.state, checked.file.joints)
        await it.run_for(STILL_TICKS)
        it.aims = _held(it.state, checked.file.joints) or before
        await it.run_for(STILL_TICKS)
        moved = _largest_gap(before, _positions(it.state, checked.file.joints))
    return Finding(moved <= STILL_RAD, f"moved by {math.degrees(moved):.2f}°")


async def joints_obey(checked: CheckedRobot) -> Finding:
    """Send one joint after the other somewhere else: it gets there."""
    worst = ("", 0.0)
    async with DriverSession(checked) as it:
        await it.connected()
        for joint in checked.file.joints:
            here = _positions(it.state, checked.file.joints)[joint.name]
            goal, span = _aside(joint, here), joint.upper - joint.lower
            it.aims = {**it.aims, joint.name: goal}

            def off(name: str = joint.name, goal: float = goal) -> float:
                return abs(_positions(it.state, checked.file.joints)[name] - goal)

            ticks = await it.until(lambda off=off, span=span: off() <= SLACK * span, TRAVEL_TICKS)  # type: ignore[misc]
            if ticks is None:
                raise Failed(f"{joint.name} stays {off():.3f} off {goal:.3f}")
            worst = max(worst, (joint.name, off() / span), key=lambda one: one[1])
    return Finding(True, f"at most {worst[1]:.1%} of its range off: {worst[0]}")


async def joint_limits(checked: CheckedRobot) -> Finding:
    """Send joints beyond their ranges: the driver sends the end of the range, and says so."""
    async with DriverSession(checked) as it:
        await it.connected()
        for joint in checked.file.joints:
            here = _positions(it.state, checked.file.joints)
            for end, beyond in ((joint.upper, EXCESS), (joint.lower, -EXCESS)):
                sent = await it.driver.set_joint_positions({joint.name: end + beyond})
                if abs(sent[joint.name] - end) > ROUNDED * (joint.upper - joint.lower):
                    return Finding(False, f"{joint.name} was sent to {sent[joint.name]:.3f}")
            await it.driver.set_joint_positions(here)
    return Finding(True, f"{len(checked.file.joints)} joints end at their ranges")


async def joints_refuse_nan(checked: CheckedRobot) -> Finding:
    """Send NaN and infinity without a gate: nothing moves."""
    joints = checked.file.joints
    async with DriverSession(checked) as it:
        await it.connected()
        await it.run_for(STILL_TICKS)
        before = _positions(it.state, joints)
        for bad in (math.nan, math.inf, -math.inf):
            await it.driver.set_joint_positions({joint.name: bad for joint in joints})
        await it.run_for(STILL_TICKS)
        moved = _largest_gap(before, _positions(it.state, joints))
    return Finding(moved <= STILL_RAD, f"moved by {math.degrees(moved):.2f}°")


async def enables_still(gated: GatedDriver) -> Finding:
    """Release and enable: nothing moves."""
    joints = gated.robot.joints
    await gated.until(lambda: gated.state, MOVE_TICKS)
    await gated.run_for(STILL_TICKS)
    before = _positions(gated.state, joints)
    await gated.enable()
    await gated.run_for(STILL_TICKS)
    moved = _largest_gap(before, _positions(gated.state, joints))
    return Finding(moved <= STILL_RAD, f"moved by {math.degrees(moved):.2f}°")


async def joints_silence(gated: GatedDriver) -> Finding:
    """Stop commanding while a joint moves: it comes to rest, and is held."""
    await _move(gated)
    gated.joint_speeds = {}
    return await _frozen(gated, SILENT_TICKS)


async def joints_estop(gated: GatedDriver) -> Finding:
    """Press the e-stop while a joint moves: it comes to rest, and is held."""
    await _move(gated)
    await gated.press_estop()
    return await _frozen(gated, FREEZE_TICKS)


async def _move(gated: GatedDriver) -> None:
    """Open the gate, and have the first joint move."""
    joint = gated.robot.joints[0]
    await gated.until(lambda: gated.state, MOVE_TICKS)
    for _ in range(ATTEMPTS):
        gated.joint_speeds = {joint.name: 0.0}
        await gated.enable()
        here = _positions(gated.state, gated.robot.joints)[joint.name]
        way = -1 if here > (joint.lower + joint.upper) / 2 else 1
        gated.joint_speeds = {joint.name: way * SPEED_SHARE * joint.max_speed}
        await gated.run_for(MOVE_TICKS)
        if _speed(gated.state, joint.name) > SPEED_SHARE * joint.max_speed / 2:
            return
        if gated.mode == "enabled":
            break
    raise Failed(f"{joint.name} did not move; gate {gated.mode}: {', '.join(gated.causes)}")


async def _frozen(gated: GatedDriver, most: int) -> Finding:
    """Check that the joints come to rest within `most` ticks, and stay there for a second."""
    joints, begin, moving = gated.robot.joints, gated.tick, 0
    stopped = _positions(gated.state, joints)
    while gated.tick - begin < most + STILL_TICKS:
        await gated.run_for(1)
        if any(_speed(gated.state, joint.name) > SLOW for joint in joints):
            moving = gated.tick - begin
        if gated.tick - begin <= max(most, moving):
            stopped = _positions(gated.state, joints)
    sagged = _largest_gap(stopped, _positions(gated.state, joints))
    return Finding(
        moving < most and sagged <= FELL_RAD,
        f"moving for {moving} ticks, then by {math.degrees(sagged):.2f}° in a second",
        late_ms=max(moving + 1 - most, 0) * TICK_MS,
    )


def _aside(joint: JointDescription, here: float) -> float:
    """Return a goal beside a joint's position, towards the middle of its range."""
    way = 1 if here < (joint.lower + joint.upper) / 2 else -1
    return here + way * TRAVEL * (joint.upper - joint.lower)


def _positions(state: RobotState | None, joints: tuple[JointDescription, ...]) -> dict[str, float]:
    measured = {joint.name: joint.position for joint in state.joints} if state else {}
    if missing := [joint.name for joint in joints if joint.name not in measured]:
        raise Failed(f"joints that it does not report: {', '.join(missing)}")
    return {joint.name: measured[joint.name] for joint in joints}


def _held(state: RobotState | None, joints: tuple[JointDescription, ...]) -> dict[str, float]:
    """Return the positions that the body reports to hold; empty if it reports none."""
    if state is None or not state.joints_sent:
        return {}
    return dict(zip((joint.name for joint in joints), state.joints_sent, strict=True))


def _speed(state: RobotState | None, name: str) -> float:
    speeds = [abs(joint.velocity) for joint in state.joints if joint.name == name] if state else []
    return speeds[0] if speeds else 0.0


def _largest_gap(before: Mapping[str, float], after: Mapping[str, float]) -> float:
    return max(abs(after[name] - position) for name, position in before.items())
