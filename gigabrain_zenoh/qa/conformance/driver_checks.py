"""Checks of a driver by itself: opens, obeys within limits, returns what it sent, never raises."""

import asyncio
import functools
import math
import time
from collections.abc import Awaitable, Callable

from gigabrain_schemas.base import Velocity
from gigabrain_zenoh.geometry.limits import clamp, limits_of
from gigabrain_zenoh.qa.conformance.robot import CheckedRobot, DriverSession
from gigabrain_zenoh.qa.judging import Finding

RAMP_TICKS = 75  # 1.5 s, to get to a speed
HOLD_TICKS = 15
TOLERANCE = 0.1  # of the wanted speed, and
UNIT = 0.02  # [m/s], [rad/s]: the coarsest step in which a body may take its commands
MAX_CALL_S = 2.0  # of `stop` and `close`
OPEN_S = 0.1
CALLS = ("stop", "stop", "close", "stop", "close")
EXCESS = 10.0  # times the greatest speed


async def opens(checked: CheckedRobot) -> Finding:
    """Open the driver, and wait until the body is received."""
    begin = time.monotonic()
    async with DriverSession(checked) as it:
        await it.connected()
    return Finding(True, f"received after {(time.monotonic() - begin) * 1e3:.0f} ms")


async def obeys(checked: CheckedRobot) -> Finding:
    """Drive forward, then turn: the measured speed reaches the commanded one."""
    robot, measured_texts = checked.file, []
    wishes = (
        ("linear_x", Velocity(linear_x=0.5 * robot.max_linear_speed)),
        ("angular_z", Velocity(angular_z=-0.5 * robot.max_angular_speed)),
    )
    async with DriverSession(checked) as it:
        await it.connected()
        for axis, wish in wishes:
            it.wanted, wanted = wish, getattr(wish, axis)
            slack = TOLERANCE * abs(wanted) + UNIT

            there = functools.partial(_near, it, axis, wanted, slack)
            ticks = await it.until(there, RAMP_TICKS)
            measured = getattr(it.state.velocity, axis) if it.state else math.nan
            if ticks is None:
                return Finding(False, f"{axis} {measured:.3f} instead of {wanted:.3f}")
            measured_texts.append(f"{axis} {measured:.3f} of {wanted:.3f} after {ticks} ticks")
    return Finding(True, "; ".join(measured_texts))


def _near(it: DriverSession, axis: str, wanted: float, slack: float) -> bool:
    assert it.state
    measured: float = getattr(it.state.velocity, axis)
    return abs(measured - wanted) <= slack


async def limits(checked: CheckedRobot) -> Finding:
    """Command ten times the greatest speed: the driver sends at most the greatest speed."""
    robot = checked.file
    most = Velocity(linear_x=robot.max_linear_speed, angular_z=robot.max_angular_speed)
    worst = 0.0
    async with DriverSession(checked) as it:
        await it.connected()
        for asked in (
            Velocity(linear_x=EXCESS * most.linear_x),
            Velocity(angular_z=-EXCESS * most.angular_z),
            Velocity(linear_x=-EXCESS * most.linear_x, angular_z=EXCESS * most.angular_z),
        ):
            it.wanted = asked
            await it.run_for(HOLD_TICKS)
            sent = it.sent or Velocity()
            commanded = checked.commanded(it.state)
            worst = max(
                worst,
                abs(sent.linear_x) / most.linear_x,
                abs(sent.angular_z) / most.angular_z,
                abs(commanded[0]) / (most.linear_x * (1 + TOLERANCE)),
                abs(commanded[2]) / (most.angular_z * (1 + TOLERANCE)),
            )
    return Finding(worst <= 1.001, f"at most {worst:.2f} of max speed")


async def returns(checked: CheckedRobot) -> Finding:
    """Compare the returned velocity with the one that the body was commanded.

    Without a peer, the measured velocity stands for the commanded one.
    """
    robot = checked.file
    most = (robot.max_linear_speed, robot.max_lateral_speed, robot.max_angular_speed)
    slack = [UNIT + (0.0 if checked.has_peer else TOLERANCE * axis) for axis in most]
    asked = Velocity(
        linear_x=-0.41234 * most[0], linear_y=0.5 * most[1], angular_z=0.31234 * most[2]
    )
    async with DriverSession(checked) as it:
        await it.connected()
        it.wanted = asked

        def off() -> list[float]:
            pairs = zip(_axes(it.sent or Velocity()), checked.commanded(it.state), strict=True)
            return [abs(sent - commanded) for sent, commanded in pairs]

        def close() -> bool:
            return all(error <= most for error, most in zip(off(), slack, strict=True))

        await it.run_for(2)
        ticks = await it.until(close, RAMP_TICKS)
        worst, sent = max(off()), it.sent or Velocity()
    within = _axes(clamp(asked, limits_of(robot)))
    honest = all(abs(a - b) <= UNIT for a, b in zip(_axes(sent), within, strict=True) if b)
    speeds = ", ".join(f"{speed:.4f}" for speed in _axes(sent))
    return Finding(
        honest and ticks is not None, f"returned {speeds}; commanded differs by {worst:.4f}"
    )


def _axes(velocity: Velocity) -> tuple[float, float, float]:
    return velocity.linear_x, velocity.linear_y, velocity.angular_z


async def refuses_nan(checked: CheckedRobot) -> Finding:
    """Command NaN and infinity without a gate: the driver sends zero."""
    async with DriverSession(checked) as it:
        await it.connected()
        for bad in (math.nan, math.inf, -math.inf):
            sent = await it.driver.set_base_velocity(bad, 0.0, 0.5 * checked.file.max_angular_speed)
            speeds = (sent.linear_x, sent.linear_y, sent.angular_z)
            if any(speeds):
                return Finding(False, f"{bad} became {speeds}")
    return Finding(True, "nan, inf and -inf all became zero")


async def never_raises(checked: CheckedRobot) -> Finding:
    """Call `stop` and `close` before open, twice, after close, with the line cut or frozen."""
    states = ("never opened", "opened", *(("unplugged", "frozen") if checked.has_peer else ()))
    raised: list[str] = []
    for state in states:
        driver = checked.driver()
        if state != "never opened":
            await driver.open()
            await asyncio.sleep(OPEN_S)
        if state in ("unplugged", "frozen"):
            checked.break_peer(state)
        for what in CALLS:
            if error := await _raised(getattr(driver, what)):
                raised.append(f"{what}, {state}: {error}")
        if checked.has_peer:
            checked.break_peer("")
    return Finding(
        not raised, raised[0] if raised else f"{len(CALLS)} calls in: {', '.join(states)}"
    )


async def _raised(call: Callable[[], Awaitable[None]]) -> str:
    """Return the error that `call` raised; empty for none."""
    try:
        async with asyncio.timeout(MAX_CALL_S):
            await call()
    except TimeoutError:
        return f"took over {MAX_CALL_S:g} s"
    except Exception as error:  # noqa: BLE001 - any error of the driver is a finding
        return repr(error)
    return ""
