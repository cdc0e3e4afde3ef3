"""Faults of the line to the body, and of the body itself. Its physics and firmware live on."""

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from gigabrain_schemas.body import RobotState
from gigabrain_zenoh.qa.conformance.noise import let_through, lost_after_garbage
from gigabrain_zenoh.qa.faults.fault import Failed, Measured
from gigabrain_zenoh.qa.faults.rig import Rig, deployment_of
from gigabrain_zenoh.qa.faults.stopping import TICK_MS
from gigabrain_zenoh.qa.faults.subject import Subject, configured
from gigabrain_zenoh.qa.faults.waiting import until
from gigabrain_zenoh.qa.line_proxy import in_front_of
from gigabrain_zenoh.qa.proxy.chaos import Chaos
from gigabrain_zenoh.qa.proxy.proxy import TcpProxy
from gigabrain_zenoh.runtime.managed_process import ProcessSpec
from gigabrain_zenoh.safety.following import WINDOW_TICKS

CHECK = "*{crc16}"  # at the end of a command; what it costs to have none: docs/firmware_line.md
LINES, LONG_LINES = 20_000, 1_000_000
BYTE_ERRORS = (0.001, 0.05)
NOISY_TICKS = 50
HEARD_MS = 25.0  # a body that reports 50 times a second or more is never older while it is heard
RESTED_TICKS = 50
REST_S = 1.0  # of simulated time, in which every body has come to rest
TURNING, ROLLING = 0.2, 0.02  # [rad/s], [m/s]
ROOM_M = 2.0  # so that it goes straight on for as long as it takes to notice
PLACES, STRAIGHT_TICKS = 5, 30  # where to try, and for how long it has to be told to go straight
RUNAWAY = 0.12  # [m/s]


async def serial_unplugged(rig: Rig) -> Measured:
    """The adapter is pulled out while it drives, and plugged in again."""
    subject = await rig.robot("serial")
    deaths = subject.supervisor.deaths
    await subject.drive()
    reported_ms = await _reported(subject, unplugged=True)
    gone = await subject.simulated(0.5)
    told_s = float(gone["motors_moved_s"]) - float(gone["faulted_s"])
    rest_m = (await subject.simulated(0.5))["distance_m"]
    back_s, again = await _back(subject)
    return {
        "reported after": reported_ms,
        "motors zero after": told_s * 1e3,
        "back after": back_s,
        "moved again": float(again["distance_m"]) - float(rest_m),
        "deaths": subject.supervisor.deaths - deaths,
    }


async def serial_noise(rig: Rig) -> Measured:
    """Bytes with flipped bits: the driver lives with them, and a checksum keeps commands right."""
    subject = await rig.robot("serial")
    deaths = subject.supervisor.deaths
    await subject.drive(room=0.8)
    for byte_errors in BYTE_ERRORS:
        await subject.break_body(base={"bit_errors": byte_errors})
        await subject.onlooker.ticks(NOISY_TICKS)
    await subject.break_body()
    lines = LONG_LINES if rig.long else LINES
    wrong = sum(let_through(CHECK, byte_errors, lines)[1] for byte_errors in BYTE_ERRORS)
    return {
        "wrong commands per million": wrong * 1e6 / lines,
        "lines lost after garbage": lost_after_garbage(CHECK, 1000),
        "deaths": subject.supervisor.deaths - deaths,
    }


async def tcp_frozen(rig: Rig) -> Measured:
    """The body's server hangs with its connection open, and thaws."""
    subject = await rig.robot("tcp")
    await subject.drive()
    reported_ms = await _reported(subject, frozen=True)
    rest = await subject.simulated(1.0)
    _, again = await _back(subject)
    return {
        "reported after": reported_ms,
        "old commands obeyed": float(again["motors_moved_s"] > rest["sim_seconds"]),
        "moved again": float(again["distance_m"]) - float(rest["distance_m"]),
    }


async def tcp_cut(rig: Rig) -> Measured:
    """The connection ends with RST, with FIN, or stays open while nothing comes through."""
    await rig.give_up()
    folder = rig.fresh_folder()
    deployment = deployment_of(rig.options, "tcp")
    async with (
        rig.new(deployment, functools.partial(_through, str(folder))) as subject,
        in_front_of(subject.ports, folder) as proxies,
    ):
        proxy = next(p for p in proxies.values() if isinstance(p, TcpProxy))
        await subject.settle()
        safe = {
            "RST": await _cut(subject, lambda: proxy.cut(reset=True)),
            "FIN": await _cut(subject, proxy.cut),
            "half-open": await _cut(subject, lambda: proxy.set(Chaos(hole=True)), proxy.set),
        }
        await subject.check()
    figures = {f"safe after {name}": cut.safe_ms for name, cut in safe.items()}
    return {
        **figures,
        "back after": max(cut.back_s for cut in safe.values()),
        "moved again": max(cut.again_m for cut in safe.values()),
    }


class Cut(NamedTuple):
    """What came of a cut connection."""

    safe_ms: float
    back_s: float
    again_m: float


async def _cut(
    subject: Subject, cut: Callable[[], None], heal: Callable[[], None] | None = None
) -> Cut:
    """Cut while it drives; heal after a second."""
    onlooker = subject.onlooker
    await subject.drive(room=0.8)
    start = onlooker.state
    cut()
    await _shut(subject)
    states = _from(subject, start)
    shut = _shut_tick(subject, start)
    heard = [s.tick for s in states if s.tick < shut and s.link.age_ms <= HEARD_MS]
    healed = start.tick
    rest = await subject.simulated(REST_S)
    if heal:
        heal()
        healed = onlooker.state.tick
    await until(lambda: onlooker.state.link.connected, "the body is heard again")
    back = next(
        s.tick for s in _from(subject, start) if s.tick > max(shut, healed) and s.link.connected
    )
    await onlooker.ticks(RESTED_TICKS)
    again_m = await subject.distance() - float(rest["distance_m"])
    last = heard[-1] if heard else start.tick
    return Cut((shut - last) * TICK_MS, (back - healed) * TICK_MS / 1e3, again_m)


def _through(folder: str, specs: list[ProcessSpec]) -> list[ProcessSpec]:
    """The same processes, with a driver that looks for its body's ports in `folder`."""
    return [
        spec if spec.name != "driver" else configured(spec, {"emulator": folder}) for spec in specs
    ]


async def telemetry_frozen(rig: Rig) -> Measured:
    """The body goes on reporting, always the same."""
    subject = await rig.robot("serial")
    states = await _noticed(subject, "telemetry_frozen", frozen_values=True)
    changes = (
        new.tick
        for old, new in itertools.pairwise(states)
        if (old.pose, old.velocity) != (new.pose, new.velocity)
    )
    frozen = max(changes, default=states[0].tick)
    return {"noticed after": (states[-1].tick - frozen) * TICK_MS}


async def motors_disobey(rig: Rig) -> Measured:
    """A wheel that does not turn, and wheels that turn at command zero."""
    subject = await rig.robot("serial")
    onlooker = subject.onlooker
    states = await _noticed(subject, "runaway", "stuck", "not_following", stuck_wheel=True)
    stuck_ms = (states[-1].tick - first_disobeyed(states)) * TICK_MS
    await onlooker.still()
    await subject.release()
    await onlooker.still(25)
    start = onlooker.state
    await subject.break_body(base={"runaway": RUNAWAY})
    await until(lambda: "runaway" in _codes(onlooker.state), "runaway latches", within_s=3.0)
    await subject.break_body()
    latched = next(s.tick for s in _from(subject, start) if s.gate.mode == "latched")
    rolling = next(s.tick for s in _from(subject, start) if s.velocity.linear_x > ROLLING)
    return {
        "runaway latched after": (latched - rolling) * TICK_MS,
        "stuck wheel noticed after": stuck_ms,
    }


async def _noticed(subject: Subject, *codes: str, **fault: Any) -> list[RobotState]:
    """Break the body while it drives; return all states until it is stopped for these causes.

    Where the robot had to turn away from something meanwhile, it is driven to another place first.
    """
    onlooker = subject.onlooker
    for _ in range(PLACES):
        await subject.drive(ROOM_M)
        start = onlooker.state
        await subject.break_body(base=fault)
        await onlooker.ticks(2 * STRAIGHT_TICKS)
        shut = next((s for s in _from(subject, start) if s.gate.mode != "enabled"), None)
        told = [abs(s.sent.angular_z) < TURNING for s in _from(subject, start)]
        await subject.break_body()
        if shut or any(all(told[k : k + STRAIGHT_TICKS]) for k in range(STRAIGHT_TICKS)):
            break
    if shut is None:
        raise Failed(f"not noticed within {2 * STRAIGHT_TICKS} ticks")
    if not _codes(shut) & set(codes):
        raise Failed(f"stopped for {', '.join(_codes(shut)) or 'nothing'}, not for {codes[0]}")
    return [s for s in _from(subject, start) if s.tick <= shut.tick]


def first_disobeyed(states: Sequence[RobotState]) -> int:
    """Return the first tick in which the body turns unlike all that it was told of late.

    0.3 s are a body's own lag. What turns as it was told then, does not disobey yet.
    """
    for k, state in enumerate(states):
        told = [one.sent.angular_z for one in states[max(0, k - WINDOW_TICKS) : k + 1]]
        if all(abs(state.velocity.angular_z - one) > TURNING for one in (0.0, *told)):
            return state.tick
    return states[0].tick


def _codes(state: RobotState) -> set[str]:
    """Why the gate is shut."""
    return {cause.code for cause in state.gate.causes}


async def _reported(subject: Subject, **fault: Any) -> float:
    """Break the body's line; until robot/state says so, from the last word of the body [ms]."""
    onlooker, start = subject.onlooker, subject.onlooker.state
    await subject.break_body(base=fault)
    await until(lambda: not onlooker.state.link.connected, "the loss is reported")
    states = _from(subject, start)
    lost = next(state for state in states if not state.link.connected)
    heard = [s for s in states if s.tick < lost.tick and s.link.age_ms <= HEARD_MS]
    if lost.gate.mode == "enabled":
        raise Failed("the gate is open although the body is lost")
    return (lost.tick - (heard[-1].tick if heard else start.tick)) * TICK_MS


async def _back(subject: Subject) -> tuple[float, dict[str, Any]]:
    """Mend the line; (until the body is heard [s], the truth a while later)."""
    onlooker = subject.onlooker
    mended = onlooker.state.tick
    await subject.break_body()
    await until(lambda: onlooker.state.link.connected, "the body is heard again")
    back_s = (onlooker.state.tick - mended) * TICK_MS / 1e3
    await onlooker.ticks(RESTED_TICKS)
    if onlooker.state.gate.mode == "enabled":
        raise Failed("the gate is open although nobody has opened it")
    return back_s, await subject.truth()


async def _shut(subject: Subject) -> None:
    onlooker = subject.onlooker
    await until(lambda: onlooker.state.gate.mode != "enabled", "the gate shuts", within_s=10.0)


def _from(subject: Subject, start: RobotState) -> list[RobotState]:
    """All states of the same boot since `start`."""
    states = subject.onlooker.states
    return [s for s in states if s.boot == start.boot and s.tick >= start.tick]


def _shut_tick(subject: Subject, start: RobotState) -> int:
    return next(s.tick for s in _from(subject, start) if s.gate.mode != "enabled")
