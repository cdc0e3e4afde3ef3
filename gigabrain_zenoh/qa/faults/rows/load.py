"""Faults of load and time: a busy machine, a flooded network, and a long drive."""

import asyncio
import os
import random
import statistics
import sys
from collections import deque
from collections.abc import Awaitable, Callable, Iterable
from contextlib import AsyncExitStack
from pathlib import Path

import numpy as np

from gigabrain_schemas.base import TICK_NS
from gigabrain_schemas.logs import AuditRequest
from gigabrain_schemas.topics import AUDIT_LOG, CMD_VEL, SAFETY, SCAN, STATE, WORLD
from gigabrain_zenoh.bus.headers import SequenceGaps, header_of
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.host.bounded import percentile
from gigabrain_zenoh.qa.faults import cpu_load
from gigabrain_zenoh.qa.faults.rig import BRAKES, MEMORY_GROWN, STOPS, ZERO, Rig, Stop, stop_by
from gigabrain_zenoh.qa.faults.rows.estop import LATCHED, ZERO_P99, PressLog
from gigabrain_zenoh.qa.judging import Failed, Figure, Measured, fault_row
from gigabrain_zenoh.qa.probe import until
from gigabrain_zenoh.qa.robot_under_test import RobotUnderTest, open_files, rss_mb

SPINNERS_PER_CORE = 4
OTHER_LOADS = ("fill", "litter", "parse")
LOADED_S, LONG_LOADED_S = 10.0, 600.0
SETTLE_S = 3.0  # until the loads are at work
ESTOPS = 10  # after each death
PRESSES, LONG_PRESSES = 100, 300
RECENT_TICKS = 250  # window; its most punctual tick defines when the others were due
FLOODED_S, LONG_FLOODED_S = 8.0, 60.0
RATE_HZ, LONG_RATE_HZ = 2000, 10_000  # of the flooder's commands
LARGE_BYTES, LONG_LARGE_BYTES = 1_000_000, 10_000_000  # of a message twice a second
MIN_SHARE = 0.5  # of that rate, for a valid flood
QUIET_S = 20.0  # of judged driving, between two events of the long form
WARM_UP_S = 600.0  # of the long form; memory is not judged while the robot still maps
HOUR_S = 3600.0
WARM_TICKS = 1000  # 20 s; a robot that has just started still takes memory
COUNTED = (STATE, SCAN, WORLD, CMD_VEL, SAFETY)
VICTIMS = ("decision", "control")  # the others survive, and their memory is judged
SURVIVORS = ("perception", "driver", "safety", "router")
VIEWED_S = 10.0
RECORD = (
    *("-P", "-c", "from gigabrain_zenoh.cli.app import main; main()", "record"),
    *("--seconds", "15"),
)

TICK_LATE = Figure("gate tick late p99.9", "ms", wall=True)
MISSED_ESTOPS = Figure("missed e-stops")
DRIVER_CPU = Figure("cpu of the driver", "%", wall=True)
ESTOP_P99 = Figure("e-stop p99", "ms", wall=True)
UNNAMED = Figure("flooder missing in the audit log")
FILES_GROWN = Figure("open files grown")
LOST = Figure("messages lost")
GROWS = {name: Figure(f"{name} grows", "MB/h", long=True) for name in SURVIVORS}


class TickLateness:
    """Measures the driver's delay by its stamps, relative to its most punctual recent tick."""

    def __init__(self, robot: RobotUnderTest) -> None:
        self._recent: deque[int] = deque(maxlen=RECENT_TICKS)
        self._late_ms: list[float] = []
        self._boot = 0
        self.close = robot.probe.bus.tap(STATE.key, self._on_state)

    def _on_state(self, _key: str, _encoding: str, payload: bytes) -> None:
        header = header_of(payload)
        if header.boot != self._boot:
            self._recent.clear()
            self._boot = header.boot
        offset = header.stamp_ns - header.tick * TICK_NS
        self._recent.append(offset)
        self._late_ms.append((offset - min(self._recent)) / 1e6)

    @property
    def p999_ms(self) -> float:
        """The 99.9th percentile [ms]."""
        return percentile(sorted(self._late_ms), 0.999) or float("nan")


@fault_row(
    37, "sim", TICK_LATE.at_most(40), BRAKES.at_most(250), ZERO.at_most(610),
    MISSED_ESTOPS.at_most(0), loads=True,
)  # fmt: skip
async def busy_machine(rig: Rig) -> Measured:
    """Run four busy processes per core, and others that fill memory, make garbage and parse."""
    robot = await rig.robot("sim")
    stops, missed = list[Stop](), 0
    loads = ("spin",) * (SPINNERS_PER_CORE * (os.cpu_count() or 1)) + OTHER_LOADS
    async with AsyncExitStack() as stack:
        for load in loads:
            await stack.enter_async_context(cpu_load.running(load))
        await asyncio.sleep(SETTLE_S)
        late = TickLateness(robot)
        end_s = asyncio.get_running_loop().time() + (LONG_LOADED_S if rig.long else LOADED_S)
        while not stops or asyncio.get_running_loop().time() < end_s:
            pid = robot.pid("decision")
            stops.append(await stop_by(robot, lambda: robot.kill("decision"), "decision"))
            await robot.until_restarted("decision", pid)
            missed += await _missed(robot, ESTOPS)
        late.close()
    return {
        TICK_LATE: late.p999_ms,
        BRAKES: max(stop.brakes_ms for stop in stops),
        ZERO: max(stop.zero_ms for stop in stops),
        MISSED_ESTOPS: missed,
    }


async def _missed(robot: RobotUnderTest, count: int) -> int:
    """Press the e-stop `count` times; return how many were not confirmed or did not latch."""
    missed, probe = 0, robot.probe
    for _ in range(count):
        generation = probe.state.gate.estop_generation
        try:
            await robot.operator.estop("fault suite")
        except Refused:
            missed += 1
            continue
        await probe.ticks(2)
        newest = probe.state.gate
        missed += newest.mode != "latched" or newest.estop_generation <= generation
    return missed


@fault_row(
    38, "sim", DRIVER_CPU.at_most(50), MEMORY_GROWN.at_most(50), LATCHED.at_most(100),
    ESTOP_P99.at_most(50), UNNAMED.at_most(0), loads=True,
)  # fmt: skip
async def flood(rig: Rig) -> Measured:
    """Send 2 kHz of commands, queries and 1 MB messages; 10 kHz and 10 MB in the long form."""
    robot = await rig.robot("sim")
    endpoint = cpu_load.endpoint_text(robot.endpoint)
    pid, seconds = robot.pid("driver"), LONG_FLOODED_S if rig.long else FLOODED_S
    rate_hz = LONG_RATE_HZ if rig.long else RATE_HZ
    presses = PressLog(robot)
    large = LONG_LARGE_BYTES if rig.long else LARGE_BYTES
    await robot.until_driving()
    before_mb, most_mb, cpu = rss_mb(pid), 0.0, list[float]()
    robot.probe.ignore_commands(True)
    async with cpu_load.running("flood", str(rate_hz), str(large), endpoint) as flooder:
        counting = asyncio.create_task(_sent(flooder))
        for _ in range(round(seconds)):
            await asyncio.sleep(1.0)
            cpu.append(robot.probe.health["driver"].cpu)
            most_mb = max(most_mb, rss_mb(pid))
        named = await _in_audit_log(robot, cpu_load.FLOODER)
        for _ in range(LONG_PRESSES if rig.long else PRESSES):
            await presses.press(lambda: robot.operator.estop("fault suite"))
    robot.probe.ignore_commands(False)
    sent = await counting
    if sent < MIN_SHARE * rate_hz * seconds:
        raise Failed(f"only {sent} commands were sent")
    figures = presses.figures()
    return {
        DRIVER_CPU: 100.0 * statistics.median(cpu),
        MEMORY_GROWN: most_mb - before_mb,
        LATCHED: figures[LATCHED],
        ESTOP_P99: figures[ZERO_P99],
        UNNAMED: float(not named),
    }


async def _sent(flooder: asyncio.subprocess.Process) -> int:
    """Return how many commands the flooder has sent by its end."""
    sent = 0
    assert flooder.stdout
    async for line in flooder.stdout:
        sent = int(line) if line.strip().isdigit() else sent
    return sent


async def _in_audit_log(robot: RobotUnderTest, source: str) -> bool:
    """Return whether the audit log names `source` as refused."""
    pages = await robot.probe.bus.ask(AUDIT_LOG, AuditRequest(newest=1000), timeout_s=5.0)
    records = [record for page in pages for record in page.records]
    return any(record.what == "refused" and record.source == source for record in records)


@fault_row(
    39, "sim", STOPS.at_most(0), FILES_GROWN.at_most(0), LOST.at_most(0),
    *(figure.at_most(1) for figure in GROWS.values()),
)  # fmt: skip
async def soak(rig: Rig) -> Measured:
    """Drive for twenty seconds; in the long form for 70 min with deaths, e-stops and viewers."""
    robot = await rig.robot("sim")
    probe, gaps = robot.probe, SequenceGaps()
    await robot.until_driving()
    await until(lambda: probe.state.tick >= WARM_TICKS, "20 s since the start")
    pids = {name: robot.pid(name) for name in robot.supervisor.statuses}
    files = {pid: open_files(pid) for pid in pids.values()}

    def count(key: str, _encoding: str, payload: bytes) -> None:
        gaps.count(key, header_of(payload))

    closes = [probe.bus.tap(topic.key, count) for topic in COUNTED]
    begun, stopped, events = dict(pids), 0, SoakEvents(rig, robot, pids)
    now_s = asyncio.get_running_loop().time
    memory = MemorySlopes(now_s() + WARM_UP_S)
    end_s = now_s() + (WARM_UP_S + HOUR_S if rig.long else 0.0)
    while True:
        await robot.until_driving(0.3)
        start = probe.state
        await asyncio.sleep(QUIET_S)
        stopped += len(probe.stops(start))
        if dead := [name for name, pid in pids.items() if robot.pid(name) != pid]:
            raise Failed(f"{', '.join(dead)} died by itself")
        memory.sample(robot, begun)
        if now_s() >= end_s:
            break
        await events.next()
    for close in closes:
        close()
    survivors = {name: pid for name, pid in begun.items() if pids[name] == pid}
    measured = {
        STOPS: stopped,
        FILES_GROWN: max(open_files(pid) - files[pid] for pid in survivors.values()),
        LOST: gaps.missing.total(),
    }
    return {**measured, **(memory.figures(survivors) if rig.long else {})}


class MemorySlopes:
    """Samples the memory of processes, from `from_s` on by the loop's clock."""

    def __init__(self, from_s: float) -> None:
        self._from_s = from_s
        self._samples: dict[str, list[tuple[float, float]]] = {}

    def sample(self, robot: RobotUnderTest, pids: dict[str, int]) -> None:
        """Sample each of `pids` that still runs."""
        now_s = asyncio.get_running_loop().time()
        for name, pid in pids.items():
            if now_s >= self._from_s and robot.supervisor.statuses[name].pid == pid:
                self._samples.setdefault(name, []).append((now_s, rss_mb(pid)))

    def figures(self, names: Iterable[str]) -> Measured:
        """Return how steeply each of `names` grows [MB/h]."""
        return {GROWS[one]: slope_mb_per_h(self._samples[one]) for one in names if one in GROWS}


def slope_mb_per_h(samples: list[tuple[float, float]]) -> float:
    """Return the growth of (time [s], memory [MB]) by linear regression [MB/h]."""
    seconds, mb = np.array(samples).T
    return float(np.polyfit(seconds / HOUR_S, mb, 1)[0])


class SoakEvents:
    """Random events of a soak: deaths, e-stops, viewers and recordings."""

    def __init__(self, rig: Rig, robot: RobotUnderTest, pids: dict[str, int]) -> None:
        """Keep `pids` up to date with the robot's processes."""
        self._robot, self._pids, self._chance = robot, pids, random.Random(0)
        self._folder: Path = rig.fresh_folder()
        self._kinds: tuple[Callable[[], Awaitable[None]], ...] = (
            self._death, self._estop, self._viewer, self._recording,
        )  # fmt: skip

    async def next(self) -> None:
        """Cause one of them, and wait until it is over."""
        await self._chance.choice(self._kinds)()

    async def _death(self) -> None:
        victim = self._chance.choice(VICTIMS)
        await self._robot.kill_and_restart(victim)
        self._pids[victim] = self._robot.pid(victim)

    async def _estop(self) -> None:
        await self._robot.operator.estop("soak")
        await self._robot.probe.at_rest()

    async def _viewer(self) -> None:
        viewer = await ZenohTransport.open(self._robot.endpoint)
        viewer.subscribe("robot/**", lambda key, payload: None, 16)
        await asyncio.sleep(VIEWED_S)
        await viewer.close()

    async def _recording(self) -> None:
        endpoint = self._robot.endpoint.connect[0]
        file = self._folder / f"{self._chance.getrandbits(32):08x}.mcap"
        command = (*RECORD, "--connect", endpoint, "-o", str(file))
        process = await asyncio.create_subprocess_exec(sys.executable, *command)
        if await process.wait():
            raise Failed(f"gigabrain record ended with {process.returncode}")
        file.unlink()
