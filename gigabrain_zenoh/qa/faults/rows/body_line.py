"""Faults of the line to the body, and of its motors and telemetry."""

import functools
import itertools
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from msgspec.structs import replace

from gigabrain_drivers.bodies.line.protocol import COMMAND, LineDecoder, Template
from gigabrain_schemas.base import TICK_MS
from gigabrain_schemas.body import RobotState
from gigabrain_zenoh.config.settings import ProcessConfig
from gigabrain_zenoh.qa.faults.rig import (
    DEATHS,
    MOTORS_ZERO,
    MOVED_AGAIN,
    RESTED_TICKS,
    STAYS_STILL,
    Rig,
    deployment_of,
)
from gigabrain_zenoh.qa.judging import Failed, Figure, Measured, fault_row
from gigabrain_zenoh.qa.probe import until
from gigabrain_zenoh.qa.proxy.chaos import Chaos
from gigabrain_zenoh.qa.proxy.serial import in_front_of
from gigabrain_zenoh.qa.proxy.tcp import TcpProxy
from gigabrain_zenoh.qa.robot_under_test import RobotUnderTest, reconfigured
from gigabrain_zenoh.runtime.managed_process import ProcessSpec
from gigabrain_zenoh.safety.tracking_error import WINDOW_TICKS

# at the end of a command; docs/reference/firmware_line.md has lines without one
CHECKSUM = "*{crc16}"
LINES, LONG_LINES = 20_000, 1_000_000
CHUNK = 1000  # lines
LONGEST_GARBAGE = 64  # bytes
BYTE_ERRORS = (0.001, 0.05)
NOISY_TICKS = 50
FRESH_MS = 25.0  # a body that reports at 50 Hz or more is never older while it is received
REST_S = 1.0  # of simulated time, in which every body has come to rest
TURNING, ROLLING = 0.2, 0.02  # [rad/s], [m/s]
ROOM_M = 2.0  # so that it drives straight for as long as it takes to notice
PLACES, STRAIGHT_TICKS = 5, 30  # places to try, and how long the command there must be straight
RUNAWAY = 0.12  # [m/s]

REPORTED = Figure("reported after", "ms")
BACK = Figure("back after", "s")
WRONG_COMMANDS = Figure("wrong commands per million")
LINES_LOST = Figure("lines lost after garbage")
OLD_OBEYED = Figure("old commands obeyed")
SAFE = {name: Figure(f"safe after {name}", "ms") for name in ("RST", "FIN", "half-open")}
NOTICED = Figure("noticed after", "ms")
RUNAWAY_LATCHED = Figure("runaway latched after", "ms")
STUCK_NOTICED = Figure("stuck wheel noticed after", "ms")


@fault_row(
    12, "serial", REPORTED.at_most(100), MOTORS_ZERO.at_most(150), BACK.at_most(2), STAYS_STILL,
    DEATHS.at_most(0),
)  # fmt: skip
async def serial_unplugged(rig: Rig) -> Measured:
    """Unplug the adapter while it drives, and plug it in again."""
    robot = await rig.robot("serial")
    deaths = robot.supervisor.deaths
    await robot.until_driving()
    reported_ms = await _until_reported(robot, unplugged=True)
    gone = await robot.wait_simulated(0.5)
    zero_s = float(gone["motors_moved_s"]) - float(gone["faulted_s"])
    rest_m = (await robot.wait_simulated(0.5))["distance_m"]
    back_s, again = await _mended(robot)
    return {
        REPORTED: reported_ms,
        MOTORS_ZERO: zero_s * 1e3,
        BACK: back_s,
        MOVED_AGAIN: float(again["distance_m"]) - float(rest_m),
        DEATHS: robot.supervisor.deaths - deaths,
    }


@fault_row(13, "serial", WRONG_COMMANDS.at_most(0), LINES_LOST.at_most(2), DEATHS.at_most(0))
async def serial_noise(rig: Rig) -> Measured:
    """Flip bits on the line: the driver survives, and the checksum keeps commands right."""
    robot = await rig.robot("serial")
    deaths = robot.supervisor.deaths
    await robot.until_driving(room=0.8)
    for byte_errors in BYTE_ERRORS:
        await robot.break_body(base={"bit_errors": byte_errors})
        await robot.probe.ticks(NOISY_TICKS)
    await robot.break_body()
    lines = LONG_LINES if rig.long else LINES
    wrong = sum(let_through(CHECKSUM, byte_errors, lines)[1] for byte_errors in BYTE_ERRORS)
    return {
        WRONG_COMMANDS: wrong * 1e6 / lines,
        LINES_LOST: lost_after_garbage(CHECKSUM, 1000),
        DEATHS: robot.supervisor.deaths - deaths,
    }


def _command_line(checksum: str) -> Template:
    return Template(f"V,{{linear_x:.3f}},{{angular_z:.3f}}{checksum}\n", COMMAND)


def let_through(checksum: str, byte_errors: float, lines: int, seed: int = 0) -> tuple[int, int]:
    """Return (right, wrong) commands read of `lines`, with one flipped bit in a share of bytes.

    A million lines give the table in docs/reference/firmware_line.md.
    """
    template = _command_line(checksum)
    noise, decoder = np.random.default_rng(seed), LineDecoder((template,))
    sent: deque[dict[str, float]] = deque(maxlen=2 * CHUNK)
    right = wrong = 0
    for _ in range(lines // CHUNK):
        speeds = noise.uniform((-0.4, -1.2), (0.4, 1.2), (CHUNK, 2)).round(3).tolist()
        chunk = [{"linear_x": x + 0.0, "angular_z": z + 0.0} for x, z in speeds]
        sent.extend(chunk)
        data = np.frombuffer(b"".join(map(template.encode, chunk)), np.uint8).copy()
        hit = noise.random(len(data)) < byte_errors
        data[hit] ^= 1 << noise.integers(0, 8, int(hit.sum()), np.uint8)
        known = {(c["linear_x"], c["angular_z"]) for c in sent}
        for values in decoder.feed(data.tobytes()):
            if (values["linear_x"], values["angular_z"]) in known:
                right += 1
            else:
                wrong += 1
    return right, wrong


def lost_after_garbage(checksum: str, times: int, seed: int = 0) -> int:
    """Return the most whole lines in a row that were not read after garbage, of `times` tries."""
    template, noise = _command_line(checksum), np.random.default_rng(seed)
    line, worst = template.encode({"linear_x": 0.2, "angular_z": 0.1}), 0
    for _ in range(times):
        decoder = LineDecoder((template,))
        decoder.feed(noise.bytes(int(noise.integers(1, LONGEST_GARBAGE))))
        lost = 0
        while not decoder.feed(line):
            lost += 1
        worst = max(worst, lost)
    return worst


@fault_row(14, "tcp", REPORTED.at_most(250), OLD_OBEYED.at_most(0), STAYS_STILL)
async def tcp_frozen(rig: Rig) -> Measured:
    """Freeze the body's server with its connection open, and thaw it."""
    robot = await rig.robot("tcp")
    await robot.until_driving()
    reported_ms = await _until_reported(robot, frozen=True)
    rest = await robot.wait_simulated(1.0)
    _, again = await _mended(robot)
    return {
        REPORTED: reported_ms,
        OLD_OBEYED: float(again["motors_moved_s"] > rest["sim_seconds"]),
        MOVED_AGAIN: float(again["distance_m"]) - float(rest["distance_m"]),
    }


@fault_row(
    15, "tcp", SAFE["RST"].at_most(100), SAFE["FIN"].at_most(100),
    SAFE["half-open"].at_most(250), BACK.at_most(1), STAYS_STILL,
)  # fmt: skip
async def tcp_cut(rig: Rig) -> Measured:
    """End the connection with RST, with FIN, or leave it open while nothing comes through."""
    await rig.end_robot()
    folder = rig.fresh_folder()
    change = functools.partial(_with_ports_in, str(folder))
    async with (
        rig.new(deployment_of(rig.options, "tcp"), change) as robot,
        in_front_of(robot.ports, folder) as proxies,
    ):
        proxy = next(p for p in proxies.values() if isinstance(p, TcpProxy))
        await robot.settle()
        cuts = {
            "RST": await _cut(robot, lambda: proxy.cut(reset=True)),
            "FIN": await _cut(robot, proxy.cut),
            "half-open": await _cut(robot, lambda: proxy.set(Chaos(hole=True)), proxy.set),
        }
        await robot.check()
    return {
        **{SAFE[name]: cut.safe_ms for name, cut in cuts.items()},
        BACK: max(cut.back_s for cut in cuts.values()),
        MOVED_AGAIN: max(cut.again_m for cut in cuts.values()),
    }


def _with_ports_in(folder: str, specs: list[ProcessSpec]) -> list[ProcessSpec]:
    """Have the driver look for its body's ports in `folder`."""

    def there(config: ProcessConfig) -> ProcessConfig:
        return replace(config, settings={**config.settings, "emulator": folder})

    return [reconfigured(spec, there) if spec.name == "driver" else spec for spec in specs]


class Cut(NamedTuple):
    """Times and travel after a cut connection."""

    safe_ms: float
    back_s: float
    again_m: float


async def _cut(
    robot: RobotUnderTest, cut: Callable[[], None], heal: Callable[[], None] | None = None
) -> Cut:
    """Cut the line while the body drives; heal it after a second."""
    probe = robot.probe
    await robot.until_driving(room=0.8)
    start = probe.state
    cut()
    await until(lambda: probe.state.gate.mode != "enabled", "the gate shuts", within_s=10.0)
    states = probe.since(start)
    shut = next(s.tick for s in states if s.gate.mode != "enabled")
    fresh = [s.tick for s in states if s.tick < shut and s.link.age_ms <= FRESH_MS]
    healed = start.tick
    rest = await robot.wait_simulated(REST_S)
    if heal:
        heal()
        healed = probe.state.tick
    await until(lambda: probe.state.link.connected, "the body is received again")
    back = next(
        s.tick for s in probe.since(start) if s.tick > max(shut, healed) and s.link.connected
    )
    await probe.ticks(RESTED_TICKS)
    again_m = await robot.travelled() - float(rest["distance_m"])
    last = fresh[-1] if fresh else start.tick
    return Cut((shut - last) * TICK_MS, (back - healed) * TICK_MS / 1e3, again_m)


@fault_row(16, "serial", NOTICED.at_most(500))
async def telemetry_frozen(rig: Rig) -> Measured:
    """Have the body report the same values over and over."""
    robot = await rig.robot("serial")
    states = await _until_noticed(robot, "telemetry_frozen", frozen_values=True)
    changes = (
        new.tick
        for old, new in itertools.pairwise(states)
        if (old.pose, old.velocity) != (new.pose, new.velocity)
    )
    frozen = max(changes, default=states[0].tick)
    return {NOTICED: (states[-1].tick - frozen) * TICK_MS}


@fault_row(17, "serial", RUNAWAY_LATCHED.at_most(500), STUCK_NOTICED.at_most(500))
async def motors_disobey(rig: Rig) -> Measured:
    """Block a wheel, and then have wheels turn at command zero."""
    robot = await rig.robot("serial")
    probe = robot.probe
    causes = ("runaway", "stuck", "not_following")
    states = await _until_noticed(robot, *causes, stuck_wheel=True)
    stuck_ms = (states[-1].tick - first_disobeyed(states)) * TICK_MS
    await probe.at_rest()
    await robot.release()
    await probe.at_rest(25)
    start = probe.state
    await robot.break_body(base={"runaway": RUNAWAY})
    await until(lambda: "runaway" in probe.causes, "runaway latches", within_s=3.0)
    await robot.break_body()
    latched = next(s.tick for s in probe.since(start) if s.gate.mode == "latched")
    rolling = next(s.tick for s in probe.since(start) if s.velocity.linear_x > ROLLING)
    return {RUNAWAY_LATCHED: (latched - rolling) * TICK_MS, STUCK_NOTICED: stuck_ms}


async def _until_noticed(robot: RobotUnderTest, *codes: str, **fault: Any) -> list[RobotState]:
    """Break the body while it drives; return all states until it is stopped for these causes.

    Where the robot had to turn away from something meanwhile, it tries at another place.
    """
    probe = robot.probe
    for _ in range(PLACES):
        await robot.until_driving(ROOM_M)
        start = probe.state
        await robot.break_body(base=fault)
        await probe.ticks(2 * STRAIGHT_TICKS)
        states = probe.since(start)
        shut = next((s for s in states if s.gate.mode != "enabled"), None)
        straight = [abs(s.sent.angular_z) < TURNING for s in probe.since(start)]
        await robot.break_body()
        if shut or any(all(straight[k : k + STRAIGHT_TICKS]) for k in range(STRAIGHT_TICKS)):
            break
    if shut is None:
        raise Failed(f"not noticed within {2 * STRAIGHT_TICKS} ticks")
    causes = {cause.code for cause in shut.gate.causes}
    if not causes & set(codes):
        raise Failed(f"stopped for {', '.join(causes) or 'nothing'}, not for {codes[0]}")
    return [s for s in probe.since(start) if s.tick <= shut.tick]


def first_disobeyed(states: Sequence[RobotState]) -> int:
    """Return the first tick in which the body turns unlike all recent commands.

    Recent commands are those of 0.3 s, the longest lag of a body.
    """
    for k, state in enumerate(states):
        recent = [one.sent.angular_z for one in states[max(0, k - WINDOW_TICKS) : k + 1]]
        if all(abs(state.velocity.angular_z - one) > TURNING for one in (0.0, *recent)):
            return state.tick
    return states[0].tick


async def _until_reported(robot: RobotUnderTest, **fault: Any) -> float:
    """Break the line; return the time from the last report to the reported loss [ms]."""
    probe, start = robot.probe, robot.probe.state
    await robot.break_body(base=fault)
    await until(lambda: not probe.state.link.connected, "the loss is reported")
    states = probe.since(start)
    lost = next(state for state in states if not state.link.connected)
    fresh = [s for s in states if s.tick < lost.tick and s.link.age_ms <= FRESH_MS]
    if lost.gate.mode == "enabled":
        raise Failed("the gate is open although the body is lost")
    return (lost.tick - (fresh[-1].tick if fresh else start.tick)) * TICK_MS


async def _mended(robot: RobotUnderTest) -> tuple[float, dict[str, Any]]:
    """Mend the line; return the time until the body is received [s], and the truth after a rest."""
    probe = robot.probe
    mended = probe.state.tick
    await robot.break_body()
    await until(lambda: probe.state.link.connected, "the body is received again")
    back_s = (probe.state.tick - mended) * TICK_MS / 1e3
    await probe.ticks(RESTED_TICKS)
    if probe.state.gate.mode == "enabled":
        raise Failed("the gate has opened by itself")
    return back_s, await robot.truth()
