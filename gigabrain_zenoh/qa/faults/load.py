"""Faults of load: a machine that is busy with other things, and a flood."""

import asyncio
import os
import statistics
from collections import deque

import msgspec

from gigabrain_schemas.audit import AuditRequest
from gigabrain_schemas.base import TICK_NS
from gigabrain_schemas.topics import AUDIT_LOG, STATE
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.host.bounded import percentile
from gigabrain_zenoh.qa.faults.estop import Presses
from gigabrain_zenoh.qa.faults.fault import Failed, Measured
from gigabrain_zenoh.qa.faults.flooder import NAME
from gigabrain_zenoh.qa.faults.helpers import helper, helpers, rss_mb
from gigabrain_zenoh.qa.faults.rig import Rig
from gigabrain_zenoh.qa.faults.stopping import Stop, stop_by
from gigabrain_zenoh.qa.faults.subject import Subject
from gigabrain_zenoh.recording.headers import header_of
from gigabrain_zenoh.runtime.deployment import client_endpoint

HOGS = 4  # for each core
OTHERS = ["fill", "litter", "parse"]
HOGGED_S, LONG_HOGGED_S = 10.0, 600.0
SETTLE_S = 3.0  # until the hogs are at work
ESTOPS = 10  # after each death
PRESSES, LONG_PRESSES = 100, 300
RECENT = 250  # ticks within which the promptest says when the others were due
FLOODED_S, LONG_FLOODED_S = 8.0, 60.0
RATE_HZ, LONG_RATE_HZ = 2000, 10_000  # of its commands
LARGE_BYTES, LONG_LARGE_BYTES = 1_000_000, 10_000_000  # of a message twice a second
LEAST_SHARE = 0.5  # of that rate, else it was no flood


class Lateness:
    """How late the driver ticks, by its own stamps: against the promptest of late."""

    def __init__(self, subject: Subject) -> None:
        self._recent: deque[int] = deque(maxlen=RECENT)
        self._late_ms: list[float] = []
        self._boot = 0
        self.close = subject.onlooker.bus.tap(STATE.key, self._hear)

    def _hear(self, _key: str, _encoding: str, payload: bytes) -> None:
        header = header_of(payload)
        if header.boot != self._boot:
            self._recent.clear()
            self._boot = header.boot
        offset = header.stamp_ns - header.tick * TICK_NS
        self._recent.append(offset)
        self._late_ms.append((offset - min(self._recent)) / 1e6)

    @property
    def p999_ms(self) -> float:
        """What one tick in a thousand exceeds."""
        return percentile(sorted(self._late_ms), 0.999) or float("nan")


async def cpu_hogs(rig: Rig) -> Measured:
    """Four busy processes for each core, and others that eat memory, litter, and parse."""
    subject = await rig.robot("sim")
    stops, missed = list[Stop](), 0
    hogs = ["spin"] * (HOGS * (os.cpu_count() or 1)) + OTHERS
    async with helpers("hogs", hogs):
        await asyncio.sleep(SETTLE_S)
        late = Lateness(subject)
        end_s = asyncio.get_running_loop().time() + (LONG_HOGGED_S if rig.long else HOGGED_S)
        while not stops or asyncio.get_running_loop().time() < end_s:
            pid = subject.pid("decision")
            stops.append(await stop_by(subject, lambda: subject.kill("decision"), "decision"))
            await subject.restarted("decision", pid)
            missed += await _missed(subject, ESTOPS)
        late.close()
    return {
        "gate tick late p99.9": late.p999_ms,
        "brakes after": max(stop.brakes_ms for stop in stops),
        "zero after": max(stop.zero_ms for stop in stops),
        "missed e-stops": missed,
    }


async def _missed(subject: Subject, count: int) -> int:
    """How many of so many e-stops were not confirmed, or have not latched the gate."""
    missed, onlooker = 0, subject.onlooker
    for _ in range(count):
        generation = onlooker.state.gate.estop_generation
        try:
            await subject.person.estop("fault suite")
        except Refused:
            missed += 1
            continue
        await onlooker.ticks(2)
        newest = onlooker.state.gate
        missed += newest.mode != "latched" or newest.estop_generation <= generation
    return missed


async def flood(rig: Rig) -> Measured:
    """2 kHz of commands and of questions, 1 MB at a time; in the long form 10 kHz and 10 MB."""
    subject = await rig.robot("sim")
    endpoint = msgspec.json.encode(client_endpoint(subject.deployment)).decode()
    pid, seconds = subject.pid("driver"), LONG_FLOODED_S if rig.long else FLOODED_S
    rate_hz = LONG_RATE_HZ if rig.long else RATE_HZ
    presses = Presses(subject)
    large = LONG_LARGE_BYTES if rig.long else LARGE_BYTES
    await subject.drive()
    before_mb, most_mb, cpu = rss_mb(pid), 0.0, list[float]()
    subject.onlooker.deafen(True)
    async with helper("flooder", str(rate_hz), str(large), endpoint) as flooder:
        counting = asyncio.create_task(_sent(flooder))
        for _ in range(round(seconds)):
            await asyncio.sleep(1.0)
            cpu.append(subject.onlooker.health["driver"].cpu)
            most_mb = max(most_mb, rss_mb(pid))
        named = await _named(subject)
        for _ in range(LONG_PRESSES if rig.long else PRESSES):
            await presses.press(lambda: subject.person.estop("fault suite"))
    subject.onlooker.deafen(False)
    sent = await counting
    if sent < LEAST_SHARE * rate_hz * seconds:
        raise Failed(f"only {sent} commands were sent")
    return {
        "cpu of the driver": 100.0 * statistics.median(cpu),
        "memory grown": most_mb - before_mb,
        "latched after": presses.figures()["latched after"],
        "e-stop p99": presses.figures()["zero p99"],
        "flooder unnamed": float(not named),
    }


async def _sent(flooder: asyncio.subprocess.Process) -> int:
    """How many commands it has sent, in the end."""
    sent = 0
    assert flooder.stdout
    async for line in flooder.stdout:
        sent = int(line) if line.strip().isdigit() else sent
    return sent


async def _named(subject: Subject) -> bool:
    """Whether the audit log says whose commands are not obeyed."""
    pages = await subject.onlooker.bus.ask(AUDIT_LOG, AuditRequest(newest=1000), timeout_s=5.0)
    records = [record for page in pages for record in page.records]
    return any(record.what == "refused" and record.source == NAME for record in records)
