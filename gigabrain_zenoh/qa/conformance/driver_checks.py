"""The checked robot, its emulated peer, and checks of its driver without a gate."""

import abc
import asyncio
import contextlib
import functools
import math
import time
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import Any, Protocol, Self

from gigabrain_drivers.driver import catalog
from gigabrain_drivers.driver.base import Driver
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.emulators.base import Device
from gigabrain_drivers.emulators.emulator import BASE, Emulator
from gigabrain_drivers.links.link import Trace
from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import RobotState
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.settings import LinkName
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.geometry.limits import ZERO, at_rest, clamp, limits_of
from gigabrain_zenoh.qa.judging import Failed, Finding, Skipped

POLL_S = 0.004
PATIENCE_S = 10.0  # of wall time without a single tick
REST_SPEED = 0.02  # [m/s], largest true speed of a standing body
WORLD = "arena"
OPEN_TICKS = 250  # 5 s
RAMP_TICKS = 75  # 1.5 s, to reach a speed
HOLD_TICKS = 15
TOLERANCE = 0.1  # of the wanted speed, plus UNIT
UNIT = 0.02  # [m/s], [rad/s], the coarsest allowed step of commands
MAX_CALL_S = 2.0  # of `stop` and `close`
OPEN_S = 0.1
CALLS = ("stop", "stop", "close", "stop", "close")
EXCESS = 10.0  # factor on the maximal speed


class Timeline(abc.ABC):
    """Waits in ticks of a driver."""

    def __init__(self) -> None:
        self.tick = 0

    @abc.abstractmethod
    def check_alive(self) -> None:
        """Raise the error that ended the driver, if any."""

    async def until(self, condition: Callable[[], object], ticks: int) -> int | None:
        """Wait at most `ticks` for `condition`; return how many passed, None if it never held."""
        loop, begin = asyncio.get_running_loop(), self.tick
        seen, seen_s = self.tick, loop.time()
        while not condition():
            self.check_alive()
            if self.tick - begin >= ticks:
                return None
            if self.tick != seen:
                seen, seen_s = self.tick, loop.time()
            elif loop.time() - seen_s > PATIENCE_S:
                raise Failed(f"no tick for {PATIENCE_S:.0f} s")
            await asyncio.sleep(POLL_S)
        return self.tick - begin

    async def firsts(
        self, conditions: Mapping[str, Callable[[], object]], ticks: int
    ) -> dict[str, float]:
        """Return when each condition first held [ms]; stop after the last one, or after `ticks`."""
        loop = asyncio.get_running_loop()
        begin_s, found = loop.time(), dict[str, float]()

        def all_held() -> bool:
            for name, holds in conditions.items():
                if name not in found and holds():
                    found[name] = (loop.time() - begin_s) * 1e3
            return len(found) == len(conditions)

        await self.until(all_held, ticks)
        return found

    async def run_for(self, ticks: int) -> None:
        """Let `ticks` pass."""
        await self.until(lambda: False, ticks)


class CheckedRobot:
    """A robot by name or file. Its emulator runs inside its `async with` block.

    `folder` contains the ports and the gate's saved state.
    """

    def __init__(self, name: str, link: LinkName, folder: Path) -> None:
        if link == "real":
            raise ConfigError("the kit moves the body at once; choose link sim or emulated")
        self.name, self.link, self.folder = name, link, folder
        self.run = Run(folder=folder, link=link, world=WORLD, emulator=str(folder / "ports"))
        self.file, _, _, _ = catalog.load_link(name, self.run)
        self._emulator: Emulator | None = None
        self._way = -1

    async def __aenter__(self) -> Self:
        if self.link == "emulated":
            self._emulator = await Emulator(self.name, self.run).__aenter__()
        return self

    async def __aexit__(self, *error: Any) -> None:
        if self._emulator:
            await self._emulator.__aexit__(*error)

    def driver(self) -> Driver:
        """Return a new driver, not opened yet."""
        return catalog.make_driver(self.name, self.run)[1]

    def next_direction(self) -> int:
        """Return 1 and -1 in turn, so that the body never reaches a wall."""
        self._way = -self._way
        return self._way

    @property
    def has_base(self) -> bool:
        """True for a body that drives."""
        return self.file.drive_type != "arm"

    @property
    def has_peer(self) -> bool:
        """True if an emulated peer is at the other end of the line."""
        return self._emulator is not None

    @property
    def peer(self) -> Emulator:
        """The emulated peer. Raises Skipped without one."""
        if self._emulator is None:
            raise Skipped(f"link {self.link} has no peer that could fail")
        return self._emulator

    def break_peer(self, words: str) -> None:
        """Set the faults of the base's end of the line; an empty text clears them."""
        self.peer.set(self.peer.parse_faults(f"{BASE} {words}"))

    @property
    def promise(self) -> str:
        """Time after which the firmware stops the motors without a command, with its source."""
        device = self._emulator.stations[BASE].device if self._emulator else Device
        if device.goes_on:
            return f"never ({device.promised_in})"
        return f"{device.watchdog_ns / 1e6:.0f} ms ({device.promised_in})"

    @property
    def promised_ms(self) -> float:
        """The same time [ms]."""
        return self.peer.stations[BASE].device.watchdog_ns / 1e6

    @property
    def goes_on(self) -> bool:
        """True if the motors have no watchdog. Raises Skipped without a peer."""
        return self.peer.stations[BASE].device.goes_on

    def commanded(self, state: RobotState | None) -> tuple[float, float, float]:
        """Return the velocity commanded to the motors; without a peer, the measured one."""
        if self._emulator:
            return self._emulator.body.commanded
        velocity = state.velocity if state else None
        return (velocity.linear_x, velocity.linear_y, velocity.angular_z) if velocity else (0, 0, 0)

    def rests(self, state: RobotState | None) -> bool:
        """Return whether the body stands still: truly, or without a peer as measured."""
        if self._emulator is None:
            return state is not None and at_rest(state.velocity)
        speed = self._emulator.body.report().get("true_speed")
        still = isinstance(speed, float | int) and abs(speed) < REST_SPEED
        return still and not any(self._emulator.body.commanded)


class TracedLine(Protocol):
    """A line with a trace of its bytes."""

    trace: Trace | None


def link_of(driver: Driver) -> TracedLine:
    """Return the driver's attribute `link`. Raises Skipped without one."""
    link: TracedLine | None = getattr(driver, "link", None)
    if link is None or not hasattr(link, "trace"):
        raise Skipped("the driver has no `link` with a `trace`, so its bytes cannot be checked")
    return link


class DriverSession(Timeline):
    """Commands `wanted` and `aims` in every tick, and keeps the newest state.

    Used as `async with`.
    """

    def __init__(self, robot: CheckedRobot) -> None:
        super().__init__()
        self.driver = robot.driver()
        self.wanted = ZERO
        self.sent: Velocity | None = None  # newest velocity that the driver returned
        self.aims: Mapping[str, float] = {}  # positions of joints
        self.joints_sent: Mapping[str, float] = {}  # newest that the driver returned
        self._has_base = robot.has_base
        self.state: RobotState | None = None
        self._live: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        await self.driver.__aenter__()
        self._live = asyncio.create_task(self._run(), name="conformance session")
        return self

    async def __aexit__(self, *error: Any) -> None:
        if self._live:
            self._live.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._live
        await self.driver.__aexit__(*error)

    async def connected(self) -> int:
        """Wait until the body is received; return the number of ticks."""
        ticks = await self.until(lambda: self.state and self.state.link.connected, OPEN_TICKS)
        if ticks is None:
            raise Failed(f"the body was not received within {OPEN_TICKS} ticks")
        return ticks

    def check_alive(self) -> None:
        """Raise the error of the driver, if any."""
        if self._live and self._live.done():
            self._live.result()
            raise Failed("its ticks have ended")

    async def _run(self) -> None:
        async for passed in self.driver.ticks(Clock()):
            self.tick += passed
            self.state = await self.driver.read_state()
            if self.aims:
                self.joints_sent = await self.driver.set_joint_positions(self.aims)
            if self._has_base:
                to = self.wanted
                self.sent = await self.driver.set_base_velocity(
                    to.linear_x, to.linear_y, to.angular_z
                )


async def opens(checked: CheckedRobot) -> Finding:
    """Open the driver, and wait until the body is received."""
    begin = time.monotonic()
    async with DriverSession(checked) as it:
        await it.connected()
    return Finding(True, f"received after {(time.monotonic() - begin) * 1e3:.0f} ms")


async def obeys(checked: CheckedRobot) -> Finding:
    """Drive forward, sideways where it can, and turn: the measured speed reaches the commanded."""
    robot, measured_texts = checked.file, []
    along, turn = 0.5 * robot.max_linear_speed, -0.5 * robot.max_angular_speed
    car = robot.drive_type == "ackermann"  # it turns only while it drives
    wishes = [("linear_x", Velocity(linear_x=along))]
    if robot.max_lateral_speed:
        wishes.append(("linear_y", Velocity(linear_y=0.5 * robot.max_lateral_speed)))
    wishes.append(("angular_z", Velocity(linear_x=along if car else 0.0, angular_z=turn)))
    async with DriverSession(checked) as it:
        await it.connected()
        for axis, wish in wishes:
            it.wanted, wanted = wish, getattr(wish, axis)
            slack = TOLERANCE * abs(wanted) + UNIT

            there = functools.partial(_near, it, axis, wanted, slack)
            ticks = await it.until(there, RAMP_TICKS)
            measured = getattr(it.state.velocity, axis) if it.state else math.nan
            if ticks is None:
                raise Failed(f"{axis} {measured:.3f} instead of {wanted:.3f}")
            measured_texts.append(f"{axis} {measured:.3f} of {wanted:.3f} after {ticks} ticks")
    return Finding(True, "; ".join(measured_texts))


def _near(it: DriverSession, axis: str, wanted: float, slack: float) -> bool:
    assert it.state
    measured: float = getattr(it.state.velocity, axis)
    return abs(measured - wanted) <= slack


async def limits(checked: CheckedRobot) -> Finding:
    """Command ten times the greatest speeds: the driver sends at most these."""
    most, worst = _max_speeds(checked), 0.0
    slack = [TOLERANCE * limit for limit in most]
    if not checked.has_peer:
        slack[1] = 3 * TOLERANCE * most[1] + UNIT  # a walking body sways
    async with DriverSession(checked) as it:
        await it.connected()
        for x, y, turn in ((1, 0, 0), (0, 1, 0), (0, 0, -1), (-1, -1, 1)):
            it.wanted = Velocity(
                linear_x=x * EXCESS * most[0],
                linear_y=y * EXCESS * most[1],
                angular_z=turn * EXCESS * most[2],
            )
            await it.run_for(HOLD_TICKS)
            sent, commanded = _axes(it.sent or Velocity()), checked.commanded(it.state)
            for axis, limit in enumerate(most):
                if limit:
                    worst = max(worst, abs(sent[axis]) / limit)
                    worst = max(worst, abs(commanded[axis]) / (limit + slack[axis]))
    return Finding(worst <= 1.001, f"at most {worst:.2f} of max speed")


async def returns(checked: CheckedRobot) -> Finding:
    """Compare the returned velocity with the one that the body was commanded.

    Without a peer, the measured velocity stands for the commanded one.
    """
    most = _max_speeds(checked)
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
    within = _axes(clamp(asked, limits_of(checked.file)))
    honest = all(abs(a - b) <= UNIT for a, b in zip(_axes(sent), within, strict=True) if b)
    speeds = ", ".join(f"{speed:.4f}" for speed in _axes(sent))
    return Finding(
        honest and ticks is not None, f"returned {speeds}; commanded differs by {worst:.4f}"
    )


def _max_speeds(checked: CheckedRobot) -> tuple[float, float, float]:
    robot = checked.file
    return robot.max_linear_speed, robot.max_lateral_speed, robot.max_angular_speed


def _axes(velocity: Velocity) -> tuple[float, float, float]:
    return velocity.linear_x, velocity.linear_y, velocity.angular_z


async def refuses_nan(checked: CheckedRobot) -> Finding:
    """Command NaN and infinity in each axis, without a gate: the driver sends zero."""
    x, y, turn = (0.5 * most for most in _max_speeds(checked))
    async with DriverSession(checked) as it:
        await it.connected()
        for bad in (math.nan, math.inf, -math.inf):
            for asked in ((bad, y, turn), (x, bad, turn), (x, y, bad)):
                speeds = _axes(await it.driver.set_base_velocity(*asked))
                if any(speeds):
                    return Finding(False, f"{asked} became {speeds}")
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
