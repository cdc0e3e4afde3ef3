"""`gigabrain bench estop`: from the press to the gate's zero, and how far the body goes on."""

import asyncio
import contextlib
import math
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import msgspec
from msgspec import Struct

from gigabrain_schemas.body import RobotState
from gigabrain_schemas.requests import EnableRequest, ReleaseRequest
from gigabrain_schemas.topics import ENABLE, RELEASE, STATE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.client.estop import press
from gigabrain_zenoh.config.settings import DecisionConfig
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.gate.gate import BRAIN
from gigabrain_zenoh.host.bounded import percentile
from gigabrain_zenoh.launch.specs import process_specs
from gigabrain_zenoh.qa.bench.group import Group, client, running
from gigabrain_zenoh.qa.bench.runs import LOOPBACK
from gigabrain_zenoh.runtime.deployment import Deployment, client_endpoint, with_free_port
from gigabrain_zenoh.runtime.managed_process import ProcessSpec

SPEED = 0.26  # [m/s]
FAST = 0.9  # share of it, from which on the robot counts as driving
STILL = 0.005  # [m/s]
P99_MS, MAX_MS, TRAVEL_M = 50.0, 100.0, 0.06  # targets
FLOOD = (sys.executable, "-P", "-m", "gigabrain_zenoh.qa.bench.flood")
APART_S = 0.02  # between two presses while it is latched


class Presses(Struct, frozen=True, kw_only=True):
    """What came of some presses."""

    name: str
    ms: tuple[float, ...]  # from the press until the answer was there
    travel_m: tuple[float, ...]  # from the press to rest, of those that were pressed while driving

    def p(self, share: float) -> float:
        """A percentile of the times [ms]."""
        return percentile(sorted(self.ms), share) or 0.0


class EstopResult(Struct, frozen=True, kw_only=True):
    """Idle and under flood."""

    body: str
    rounds: tuple[Presses, ...]


async def measure_estop(
    body: str, driving: int, latched: int, say: Callable[[str], None]
) -> EstopResult:
    """Press while it drives, and while it is latched; idle, and while others flood the network."""
    deployment = with_free_port(
        Deployment(
            body=body, resume="manual", router=LOOPBACK, decision=DecisionConfig(linear_speed=SPEED)
        )
    )
    endpoint = client_endpoint(deployment)
    with tempfile.TemporaryDirectory(prefix="gigabrain-bench-") as name:
        specs = process_specs(deployment, "robot", Path(name), Path(name) / "state")
        say(f"starting {body}")
        async with running(specs) as group, client(endpoint) as bus:
            person = _Person(bus, group)
            idle = await person.presses("idle", driving, latched, say)
            flood = ProcessSpec("flood", (*FLOOD, msgspec.json.encode(endpoint).decode()))
            async with running([flood]):
                flooded = await person.presses("flooded", driving, latched, say)
    return EstopResult(body=body, rounds=(idle, flooded))


class _Person:
    """Presses, lets go, enables, and watches the body."""

    def __init__(self, bus: Bus, group: Group) -> None:
        self._bus, self._group = bus, group
        self._trail: list[RobotState] = []
        self._asked = False  # whether somebody is about to set it going
        self._state = bus.latest(STATE, self._trail.append)

    async def presses(
        self, name: str, driving: int, latched: int, say: Callable[[str], None]
    ) -> Presses:
        """So many while it drives, and so many while it is latched."""
        times, travels = [], []
        for count in range(driving):
            say(f"{name}: press {count + 1} of {driving} while it drives")
            await self._group.until(self._fast)
            start = self._trail[-1]
            self._trail.clear()
            times.append(await self._press())
            await self._group.until(lambda: any(map(_rests, self._trail)))
            travels.append(_travel(start, self._trail))
            if count == driving - 1:
                break
        for _ in range(latched):
            times.append(await self._press())
            await asyncio.sleep(APART_S)
        return Presses(name=name, ms=tuple(times), travel_m=tuple(travels))

    async def _press(self) -> float:
        began = time.perf_counter()
        await press(self._bus, "bench")
        return (time.perf_counter() - began) * 1e3

    def _fast(self) -> bool:
        """Whether it drives; sets it going where it does not."""
        state = self._state.fresh()
        if state is None:
            return False
        if state.gate.mode != "enabled" and not self._asked:
            self._asked = True
            asyncio.get_running_loop().create_task(self._set_going(state.gate.estop_generation))
        return state.velocity.linear_x > FAST * SPEED

    async def _set_going(self, generation: int) -> None:
        """As a person does: release, then enable; refused until it rests, and tried again."""
        with contextlib.suppress(Refused):
            await self._bus.ask(RELEASE, ReleaseRequest(estop_generation=generation))
            await self._bus.ask(ENABLE, EnableRequest(source=BRAIN))
        self._asked = False


def _rests(state: RobotState) -> bool:
    return state.gate.mode == "latched" and abs(state.velocity.linear_x) < STILL


def _travel(start: RobotState, trail: list[RobotState]) -> float:
    """The path [m] by odometry until the body first rested."""
    path, before = 0.0, start
    for state in trail:
        path += math.hypot(state.pose.x - before.pose.x, state.pose.y - before.pose.y)
        before = state
        if _rests(state):
            break
    return path
