"""Faults of clocks and counters: the wall's, the robot's, another host's, and those that wrap."""

import asyncio
import random

from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.topics import CMD_VEL, STATE
from gigabrain_zenoh.bus.bus import Bus, Latest
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.gate import gate
from gigabrain_zenoh.qa.faults.bodies import description_of
from gigabrain_zenoh.qa.faults.fault import Failed, Measured
from gigabrain_zenoh.qa.faults.forger import forging
from gigabrain_zenoh.qa.faults.open_gate import OpenGate
from gigabrain_zenoh.qa.faults.rig import Rig, deployment_of
from gigabrain_zenoh.qa.faults.skewed import Shift, drift, other_host
from gigabrain_zenoh.qa.faults.smooth import stops
from gigabrain_zenoh.qa.faults.stopping import creep
from gigabrain_zenoh.qa.faults.subject import Subject
from gigabrain_zenoh.qa.faults.tampered import as_module, go_on, tampered
from gigabrain_zenoh.qa.faults.waiting import until
from gigabrain_zenoh.runtime.deployment import client_endpoint

ALL = ("driver", "perception", "decision", "control", "safety")
BRAIN_HOST = ("perception", "decision")
JUMP_TICKS, LONG_JUMP_TICKS = 500, 3000  # 10 s, a minute
APART_TICKS, LONG_APART_TICKS = 250, 3000
WRONG_TICKS = ("future", "past")
WRONG_STAMPS = ("of-1970", "of-2100")
STAMPED_TICKS = 100
RESTING, COMMANDS = 30, 12  # good ones, and those with each of these; safety would stop it soon
OFF_TICKS = (-100, -9, 20, 1000)  # from the newest tick
SPEED, MOVES = 0.1, 0.005  # [m/s], [m]
SEQUENCES, LONG_SEQUENCES = 20_000, 1_000_000
EDGES = (0, 1, 2**15, 2**16, 2**31, 2**32, 2**53, 2**63 - 3)  # where counters wrap


async def wall_clock_jumps(rig: Rig) -> Measured:
    """All processes see a wall clock that jumps by hours and years, each at times of its own."""
    ticks = LONG_JUMP_TICKS if rig.long else JUMP_TICKS
    return {"stops": await _driven_with(rig, "jumps", ALL, ticks)}


async def _driven_with(rig: Rig, kind: str, names: tuple[str, ...], ticks: int) -> int:
    """How often a robot whose processes have such clocks stopped for no reason."""
    await rig.give_up()
    change = as_module(names, "skewed", kind)
    async with rig.new(deployment_of(rig.options, "sim"), change) as subject:
        await subject.settle()
        stopped = await _stops(subject, ticks)
        stamps = [s.stamp_ns for s in subject.onlooker.states]
        if "driver" in names and max(stamps) - min(stamps) < 3_600_000_000_000:
            raise Failed("the driver's clock has not jumped")
        await subject.check()
    return stopped


async def _stops(subject: Subject, ticks: int) -> int:
    """How often it stopped within so many ticks."""
    onlooker = subject.onlooker
    await subject.drive()
    start = onlooker.state
    await onlooker.ticks(ticks)
    return len(stops(onlooker, start))


async def stamps_of_other_times(rig: Rig) -> Measured:
    """Scans and commands of a second ago or ahead count as none; what their stamps say is idle."""
    fresh = 0
    async with tampered(rig, *WRONG_TICKS, *WRONG_STAMPS) as subject:
        onlooker = subject.onlooker
        for _ in WRONG_TICKS:
            await subject.drive(0.8)
            go_on(subject)
            await until(lambda: onlooker.state.gate.mode != "enabled", "it stops", 10.0)
            await onlooker.still()
            fresh += await creep(subject, STAMPED_TICKS) > MOVES
            go_on(subject)
        for _ in WRONG_STAMPS:
            await subject.drive(0.8)
            go_on(subject)
            fresh += await _stops(subject, STAMPED_TICKS)
            go_on(subject)
        fresh += await _commands_of_other_times(subject)
    return {"taken for fresh": fresh}


async def _commands_of_other_times(subject: Subject) -> int:
    """For how many wrong ticks the body moved, told to by who holds it and asks for rest besides.

    All else of these commands is right; the good ones keep the gate open.
    """
    onlooker, fresh = subject.onlooker, 0
    async with forging(client_endpoint(subject.deployment)) as forger:
        for off in OFF_TICKS:
            await subject.drive(0.8)  # so that nothing speaks against moving
            await subject.person.enable(onlooker.bus.process, take=True)
            for _ in range(RESTING):
                forger.send(CMD_VEL, _command(subject, 0.0, 0))
                await onlooker.ticks(1)
            rest = onlooker.state
            if rest.gate.mode != "enabled":
                raise Failed("the gate did not stay open for good commands")
            for _ in range(COMMANDS):
                forger.send(CMD_VEL, _command(subject, 0.0, 0))
                forger.send(CMD_VEL, _command(subject, SPEED, off))
                await onlooker.ticks(1)
            fresh += onlooker.moved(rest) > MOVES
    return fresh


def _command(subject: Subject, speed: float, off: int) -> CmdVel:
    """One that echoes a tick `off` the newest; of two in a tick the moving one counts as newer."""
    time = subject.onlooker.bus.time
    return CmdVel(
        linear_x=speed,
        source=subject.onlooker.bus.process,
        stamp_ns=subject.onlooker.bus.clock.unix_ns(),
        boot=time.boot,
        tick=time.tick + off,
        basis=time.tick,
        seq=2 * time.tick + (speed > 0),
    )


async def hosts_with_other_clocks(rig: Rig) -> Measured:
    """The brain's host is five seconds ahead and 200 ppm too fast; ages are the same there."""
    ticks = LONG_APART_TICKS if rig.long else APART_TICKS
    stopped = await _driven_with(rig, "other-host", BRAIN_HOST, ticks)
    subject = await rig.robot("sim")
    error_ms = await age_error_ms(subject.onlooker.bus, OtherHost(), APART_TICKS)
    return {"stops": stopped, "tick age error": error_ms}


class OtherHost(Clock):
    """The clocks of a host that is five seconds ahead, and as a rule 200 ppm too fast."""

    def __init__(self, gains: Shift = drift) -> None:
        self._start_ns, self._gains = super().now_ns(), gains

    def now_ns(self) -> int:
        """As that host has it, which has been up for longer."""
        now_ns = super().now_ns()
        return now_ns + 10**12 + self._gains(now_ns - self._start_ns)

    def unix_ns(self) -> int:
        """As that host has it."""
        return super().unix_ns() + other_host(super().now_ns() - self._start_ns)


async def age_error_ms(bus: Bus, clock: Clock, looks: int) -> float:
    """How far one by this `clock` is off about the age of the newest state, at most [ms]."""
    worst_ns = 0
    # this machine may stand still between two of these calls
    earlier, there, later = (Latest(STATE, by, bus.time) for by in (Clock(), clock, Clock()))

    def hear(_key: str, state: RobotState) -> None:
        for each in (earlier, there, later):
            each.take(state)

    close = bus.subscribe(STATE, hear)
    try:
        for _ in range(looks):
            await asyncio.sleep(0.02)
            ages = later.age_ns(), there.age_ns(), earlier.age_ns()
            least, age, most = (each or 0 for each in ages)
            if None not in ages:
                worst_ns = max(worst_ns, least - age, age - most)
    finally:
        close()
    return worst_ns / 1e6


async def counters_wrap(rig: Rig) -> Measured:
    """Sequence numbers and boots about the edges of 16, 32 and 63 bits, old and new, at the gate.

    A second opinion keeps count of what may pass.
    """
    count = LONG_SEQUENCES if rig.long else SEQUENCES
    return {"falsely accepted": await asyncio.to_thread(_falsely_accepted, rig, count)}


def _falsely_accepted(rig: Rig, count: int) -> int:
    opened, chance, wrong = OpenGate(description_of(rig)), random.Random(0), 0
    highest, enables, good = -1, opened.state.enables, 0
    for _ in range(count):
        if opened.state.mode != "enabled":
            opened.open()
        if opened.state.enables != enables:
            highest, enables = -1, opened.state.enables
        command = _near_an_edge(opened, chance, highest)
        accepted = opened.feed(gate.Command(command)).ok
        echo = opened.state.tick - command.tick
        mine = command.boot == opened.state.boot and 0 <= echo <= 7
        wrong += accepted and not (mine and command.seq > highest)
        if accepted:
            highest, good = max(highest, command.seq), good + 1
        if chance.random() < 0.5:
            opened.tick()
    if not good:
        raise Failed("the gate has accepted nothing at all")
    return wrong


def _near_an_edge(opened: OpenGate, chance: random.Random, highest: int) -> CmdVel:
    """A command that may be good, or whose numbers have wrapped."""
    near = (highest + 1, highest, highest - 1, highest % 2**16, highest % 2**32)
    edge = chance.choice(EDGES) + chance.randrange(3)
    seq = chance.choice((*near, highest + 1, highest + 1)) if chance.random() < 0.99 else edge
    boot = opened.state.boot
    tick = max(0, opened.state.tick - chance.choice((0, 0, 0, 1, 7, 8, 2**16, -1, -(2**16))))
    return CmdVel(
        linear_x=SPEED,
        source="script",
        boot=chance.choice((boot, boot, boot, boot - 1, boot + 2**16, boot + 2**32)),
        tick=tick,
        seq=max(0, seq),
    )
