"""Faults of clocks and counters: wall clocks, stamps, another host's clock, counters that wrap."""

import asyncio
import random

from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.topics import CMD_VEL, STATE
from gigabrain_zenoh.bus.bus import Bus, Latest
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.gate import gate
from gigabrain_zenoh.qa.faults.broken_process import Shift, drift, other_host
from gigabrain_zenoh.qa.faults.hostile import OpenGate
from gigabrain_zenoh.qa.faults.rig import (
    STOPS,
    Rig,
    broken,
    deployment_of,
    forged_command,
    forging,
    next_step,
    tampered,
)
from gigabrain_zenoh.qa.judging import Failed, Figure, Measured, fault_row
from gigabrain_zenoh.qa.probe import NODES, until
from gigabrain_zenoh.qa.robot_under_test import RobotUnderTest

BRAIN_HOST = ("perception", "decision")
JUMP_TICKS, LONG_JUMP_TICKS = 500, 3000  # 10 s, a minute
APART_TICKS, LONG_APART_TICKS = 250, 3000
WRONG_TICKS = ("future", "past")
WRONG_STAMPS = ("of-1970", "of-2100")
STAMPED_TICKS = 100
RESTING, COMMANDS = 30, 12  # good commands, and those with each offset; safety would stop it soon
TICK_OFFSETS = (-100, -9, 20, 1000)  # from the newest tick
SPEED, MOVES_M = 0.1, 0.005  # [m/s]
HOUR_NS = 3_600_000_000_000
SEQUENCES, LONG_SEQUENCES = 20_000, 1_000_000
EDGES = (0, 1, 2**15, 2**16, 2**31, 2**32, 2**53, 2**63 - 3)  # where counters wrap

TAKEN_AS_FRESH = Figure("taken as fresh")
AGE_ERROR = Figure("tick age error", "ms")
FALSELY_ACCEPTED = Figure("falsely accepted")


@fault_row(33, "", STOPS.at_most(0))
async def wall_clock_jumps(rig: Rig) -> Measured:
    """Give all processes wall clocks that jump by hours and years, each at times of its own."""
    ticks = LONG_JUMP_TICKS if rig.long else JUMP_TICKS
    return {STOPS: await _stops_with(rig, "jumps", NODES, ticks)}


async def _stops_with(rig: Rig, kind: str, names: tuple[str, ...], ticks: int) -> int:
    """Count unexplained stops of a robot whose processes have such clocks."""
    async with rig.own_robot(deployment_of(rig.options, "sim"), broken(names, kind)) as robot:
        await robot.until_driving()
        stopped = await _stops_within(robot, ticks)
        stamps = [s.stamp_ns for s in robot.probe.states]
        if "driver" in names and max(stamps) - min(stamps) < HOUR_NS:
            raise Failed("the driver's clock has not jumped")
    return stopped


async def _stops_within(robot: RobotUnderTest, ticks: int) -> int:
    start = robot.probe.state
    await robot.probe.ticks(ticks)
    return len(robot.probe.stops(start))


@fault_row(34, "", TAKEN_AS_FRESH.at_most(0))
async def stamps_of_other_times(rig: Rig) -> Measured:
    """Send scans and commands of a second ago or ahead, and scans with stamps of other years.

    The former must count as missing; the latter must make no difference.
    """
    fresh = 0
    async with tampered(rig, *WRONG_TICKS, *WRONG_STAMPS) as robot:
        probe = robot.probe
        for _ in WRONG_TICKS:
            await robot.until_driving(0.8)
            next_step(robot)
            await until(lambda: probe.state.gate.mode != "enabled", "it stops", 10.0)
            await probe.at_rest()
            fresh += await robot.travel_within(STAMPED_TICKS) > MOVES_M
            next_step(robot)
        for _ in WRONG_STAMPS:
            await robot.until_driving(0.8)
            next_step(robot)
            await robot.until_driving()
            fresh += await _stops_within(robot, STAMPED_TICKS)
            next_step(robot)
        fresh += await _commands_of_other_times(robot)
    return {TAKEN_AS_FRESH: fresh}


async def _commands_of_other_times(robot: RobotUnderTest) -> int:
    """Count tick offsets with which a command of the present commander moved the body.

    All else of these commands is right; the good ones, which ask for rest, keep the gate open.
    """
    probe, fresh = robot.probe, 0
    async with forging(robot.endpoint) as forger:
        for offset in TICK_OFFSETS:
            await robot.until_driving(0.8)  # so that nothing speaks against moving
            await robot.operator.enable(probe.bus.process, take=True)
            for _ in range(RESTING):
                forger.send(CMD_VEL, _command(robot, 0.0, 0))
                await probe.ticks(1)
            rest = probe.state
            if rest.gate.mode != "enabled":
                raise Failed("the gate did not stay open for good commands")
            for _ in range(COMMANDS):
                forger.send(CMD_VEL, _command(robot, 0.0, 0))
                forger.send(CMD_VEL, _command(robot, SPEED, offset))
                await probe.ticks(1)
            fresh += probe.distance_from(rest) > MOVES_M
    return fresh


def _command(robot: RobotUnderTest, speed: float, offset: int) -> CmdVel:
    """Return a command that echoes another tick; of two in a tick the moving one is newer."""
    bus = robot.probe.bus
    tick, stamp_ns = bus.time.tick, bus.clock.unix_ns()
    seq = 2 * tick + (speed > 0)
    return forged_command(robot.probe, speed, seq, tick=tick + offset, stamp_ns=stamp_ns)


@fault_row(35, "", STOPS.at_most(0), AGE_ERROR.at_most(1))
async def hosts_with_other_clocks(rig: Rig) -> Measured:
    """Run the brain on a clock that is five seconds ahead and 200 ppm too fast."""
    ticks = LONG_APART_TICKS if rig.long else APART_TICKS
    stopped = await _stops_with(rig, "other-host", BRAIN_HOST, ticks)
    robot = await rig.robot("sim")
    error_ms = await age_error_ms(robot.probe.bus, OtherHost(), APART_TICKS)
    return {STOPS: stopped, AGE_ERROR: error_ms}


class OtherHost(Clock):
    """The clocks of a host that is five seconds ahead, and as a rule 200 ppm too fast."""

    def __init__(self, gains: Shift = drift) -> None:
        self._start_ns, self._gains = super().now_ns(), gains

    def now_ns(self) -> int:
        """Return that host's steady time; it has been up for longer."""
        now_ns = super().now_ns()
        return now_ns + 10**12 + self._gains(now_ns - self._start_ns)

    def unix_ns(self) -> int:
        """Return that host's wall time."""
        return super().unix_ns() + other_host(super().now_ns() - self._start_ns)


async def age_error_ms(bus: Bus, clock: Clock, looks: int) -> float:
    """Return the greatest error of the newest state's age by this `clock` [ms]."""
    worst_ns = 0
    # this machine may stand still between two of these calls
    earlier, there, later = (Latest(STATE, by, bus.time) for by in (Clock(), clock, Clock()))

    def take(_key: str, state: RobotState) -> None:
        for each in (earlier, there, later):
            each.store(state)

    close = bus.subscribe(STATE, take)
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


@fault_row(36, "", FALSELY_ACCEPTED.at_most(0))
async def counters_wrap(rig: Rig) -> Measured:
    """Feed the gate sequence numbers, boots and ticks about the edges of 16, 32 and 63 bits.

    A second, independent account says what may pass.
    """
    count = LONG_SEQUENCES if rig.long else SEQUENCES
    return {FALSELY_ACCEPTED: await asyncio.to_thread(_falsely_accepted, rig, count)}


def _falsely_accepted(rig: Rig, count: int) -> int:
    opened, chance, wrong = OpenGate(rig.description), random.Random(0), 0
    highest, enables, good = -1, opened.state.enables, 0
    for _ in range(count):
        if opened.state.mode != "enabled":
            opened.open()
        if opened.state.enables != enables:
            highest, enables = -1, opened.state.enables
        command = _near_an_edge(opened, chance, highest)
        accepted = opened.feed(gate.VelocityCommand(command)).ok
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
    """Return a command that may be good, or whose numbers have wrapped."""
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
