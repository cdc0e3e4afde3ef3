"""A long drive: nothing stops it without a reason, nothing is lost, nothing grows."""

import asyncio
import random
import sys
from collections.abc import Awaitable, Callable, Iterable
from pathlib import Path

import numpy as np

from gigabrain_schemas.topics import CMD_VEL, SAFETY, SCAN, STATE, WORLD
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.qa.faults.fault import Failed, Measured
from gigabrain_zenoh.qa.faults.helpers import open_files, rss_mb
from gigabrain_zenoh.qa.faults.rig import Rig
from gigabrain_zenoh.qa.faults.smooth import stops
from gigabrain_zenoh.qa.faults.subject import Subject
from gigabrain_zenoh.qa.faults.waiting import until
from gigabrain_zenoh.recording.headers import SequenceGaps, header_of
from gigabrain_zenoh.runtime.deployment import client_endpoint

QUIET_S = 20.0  # of driving that is judged, between two events of the long form
WARM_UP_S = 600.0  # of the long form, whose memory is not judged: a robot that maps still learns
HOUR_S = 3600.0
WARM_TICKS = 1000  # 20 s; a robot that has just started still takes memory
COUNTED = (STATE, SCAN, WORLD, CMD_VEL, SAFETY)
VICTIMS = ("decision", "control")  # the others live through the hour, and their memory is judged
VIEWED_S = 10.0
RECORDED_S = 15
RECORD = (
    *("-P", "-c", "from gigabrain_zenoh.cli.app import main; main()", "record"),
    *("--seconds", str(RECORDED_S)),
)


async def soak(rig: Rig) -> Measured:
    """It drives: for twenty seconds, or in the long form for 70 min in which things happen."""
    subject = await rig.robot("sim")
    onlooker, gaps = subject.onlooker, SequenceGaps()
    await subject.drive()
    await until(lambda: onlooker.state.tick >= WARM_TICKS, "it is warm")
    pids = {name: subject.pid(name) for name in subject.supervisor.statuses}
    files = {pid: open_files(pid) for pid in pids.values()}

    def see(key: str, _encoding: str, payload: bytes) -> None:
        gaps.see(key, header_of(payload))

    closes = [onlooker.bus.tap(topic.key, see) for topic in COUNTED]
    begun, stopped, events = dict(pids), 0, Events(rig, subject, pids)
    now_s = asyncio.get_running_loop().time
    growth = Growth(now_s() + WARM_UP_S)
    end_s = now_s() + (WARM_UP_S + HOUR_S if rig.long else 0.0)
    while True:
        stopped += await _quiet_stops(subject)
        if dead := [name for name, pid in pids.items() if subject.pid(name) != pid]:
            raise Failed(f"{', '.join(dead)} died of itself")
        growth.sample(subject, begun)
        if now_s() >= end_s:
            break
        await events.next()
    for close in closes:
        close()
    survivors = {name: pid for name, pid in begun.items() if pids[name] == pid}
    measured = {
        "unexplained stops": stopped,
        "open files grown": max(open_files(pid) - files[pid] for pid in survivors.values()),
        "lost": gaps.missing.total(),
    }
    return measured | (growth.mb_per_h(survivors) if rig.long else {})


async def _quiet_stops(subject: Subject) -> int:
    """Let it drive for a while in which nothing happens; return how often it stopped."""
    await subject.drive(0.3)
    start = subject.onlooker.state
    await asyncio.sleep(QUIET_S)
    return len(stops(subject.onlooker, start))


class Growth:
    """The memory of processes over time."""

    def __init__(self, from_s: float) -> None:
        """Sample from `from_s` on, by the loop's clock."""
        self._from_s = from_s
        self._samples: dict[str, list[tuple[float, float]]] = {}

    def sample(self, subject: Subject, pids: dict[str, int]) -> None:
        """Note what each of `pids` holds that is still there."""
        now_s = asyncio.get_running_loop().time()
        for name, pid in pids.items():
            if now_s >= self._from_s and subject.supervisor.statuses[name].pid == pid:
                self._samples.setdefault(name, []).append((now_s, rss_mb(pid)))

    def mb_per_h(self, names: Iterable[str]) -> dict[str, float]:
        """Return how steeply each of `names` grows [MB/h]."""
        return {f"{name} grows": slope_mb_per_h(self._samples[name]) for name in names}


def slope_mb_per_h(samples: list[tuple[float, float]]) -> float:
    """Return the growth of (time [s], memory [MB]) by linear regression [MB/h]."""
    seconds, mb = np.array(samples).T
    return float(np.polyfit(seconds / 3600.0, mb, 1)[0])


class Events:
    """What happens to a robot, at random: deaths, e-stops, viewers, recordings."""

    def __init__(self, rig: Rig, subject: Subject, pids: dict[str, int]) -> None:
        """Have them happen to a subject; `pids` are kept those of its processes."""
        self._subject, self._pids, self._chance = subject, pids, random.Random(0)
        self._folder: Path = rig.fresh_folder()
        self._kinds: tuple[Callable[[], Awaitable[None]], ...] = (
            self._death, self._estop, self._viewer, self._recording,
        )  # fmt: skip

    async def next(self) -> None:
        """Have one of them, and wait until it is over."""
        await self._chance.choice(self._kinds)()

    async def _death(self) -> None:
        victim = self._chance.choice(VICTIMS)
        await self._subject.restarted(victim, self._subject.kill(victim))
        self._pids[victim] = self._subject.pid(victim)

    async def _estop(self) -> None:
        await self._subject.person.estop("soak")
        await self._subject.onlooker.still()

    async def _viewer(self) -> None:
        viewer = await ZenohTransport.open(client_endpoint(self._subject.deployment))
        viewer.subscribe("robot/**", lambda key, payload: None, 16)
        await asyncio.sleep(VIEWED_S)
        await viewer.close()

    async def _recording(self) -> None:
        where = client_endpoint(self._subject.deployment).connect[0]
        file = self._folder / f"{self._chance.getrandbits(32):08x}.mcap"
        command = (*RECORD, "--connect", where, "-o", str(file))
        process = await asyncio.create_subprocess_exec(sys.executable, *command)
        if await process.wait():
            raise Failed(f"gigabrain record ended with {process.returncode}")
        file.unlink()
