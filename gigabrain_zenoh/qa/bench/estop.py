"""`gigabrain bench estop`: time from a press to the gate's zero, and the body's travel to rest."""

import asyncio
import contextlib
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from msgspec import Struct

from gigabrain_schemas.body import RobotState
from gigabrain_schemas.requests import EnableRequest, ReleaseRequest
from gigabrain_schemas.topics import ENABLE, RELEASE, STATE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.client.requests import press_estop
from gigabrain_zenoh.config.settings import DecisionConfig
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.gate.gate import BRAIN
from gigabrain_zenoh.host.bounded import percentile
from gigabrain_zenoh.launch.deployment import Deployment, client_endpoint, with_free_port
from gigabrain_zenoh.qa.faults.cpu_load import PROGRAM, endpoint_text
from gigabrain_zenoh.qa.judging import limited, table_of
from gigabrain_zenoh.qa.probe import path_until_rest
from gigabrain_zenoh.qa.robot_under_test import LOOPBACK, ProcessGroup, measured_robot
from gigabrain_zenoh.runtime.managed_process import ProcessSpec

if TYPE_CHECKING:
    from rich.console import Group

Progress = Callable[[str], None]
SPEED = 0.26  # [m/s]
DRIVING_SHARE = 0.9  # of SPEED, above which the robot counts as driving
MAX_REST_SPEED = 0.005  # [m/s]
MAX_P99_MS, MAX_MS, MAX_TRAVEL_M = 50.0, 100.0, 0.06  # targets
PAUSE_S = 0.02  # between two presses of a latched robot


class PressTimes(Struct, frozen=True, kw_only=True):
    """Times and travel of some presses."""

    name: str
    ms: tuple[float, ...]  # from the press to its answer
    travel_m: tuple[float, ...]  # from the press to rest, for presses while driving

    def p(self, share: float) -> float:
        """Return a percentile of the times [ms]."""
        return percentile(sorted(self.ms), share) or 0.0


class EstopResult(Struct, frozen=True, kw_only=True):
    """Presses on an idle and on a flooded network."""

    body: str
    rounds: tuple[PressTimes, ...]


async def measure_estop(body: str, driving: int, latched: int, show: Progress) -> EstopResult:
    """Press while the robot drives and while it is latched, on an idle and a flooded network."""
    decision = DecisionConfig(settings={"max_linear_speed": SPEED})
    deployment = with_free_port(
        Deployment(body=body, resume="manual", router=LOOPBACK, decision=decision)
    )
    endpoint = endpoint_text(client_endpoint(deployment))
    show(f"starting {body}")
    async with measured_robot(deployment) as (group, bus):
        operator = _Operator(bus, group)
        idle = await operator.presses("idle", driving, latched, show)
        async with ProcessGroup([ProcessSpec("flood", (*PROGRAM, "pictures", endpoint))]) as flood:
            await flood.until_ready()
            flooded = await operator.presses("flooded", driving, latched, show)
    return EstopResult(body=body, rounds=(idle, flooded))


class _Operator:
    """Presses, releases, enables, and observes the body."""

    def __init__(self, bus: Bus, group: ProcessGroup) -> None:
        self._bus, self._group = bus, group
        self._trail: list[RobotState] = []
        self._enabling = False  # True while a request to enable waits for its reply
        self._state = bus.latest(STATE, self._trail.append)

    async def presses(self, name: str, driving: int, latched: int, show: Progress) -> PressTimes:
        """Press `driving` times while the robot drives, and `latched` times while it is latched."""
        times, travels = [], []
        for count in range(driving):
            show(f"{name}: press {count + 1} of {driving} while it drives")
            await self._group.until(self._is_driving, "the robot drives")
            start = self._trail[-1]
            self._trail.clear()
            times.append(await self._press())
            await self._group.until(lambda: any(map(_rests, self._trail)), "the body rests")
            travels.append(path_until_rest([start, *self._trail], _rests) or 0.0)
        for _ in range(latched):
            times.append(await self._press())
            await asyncio.sleep(PAUSE_S)
        return PressTimes(name=name, ms=tuple(times), travel_m=tuple(travels))

    async def _press(self) -> float:
        begin_s = time.perf_counter()
        await press_estop(self._bus, "bench")
        return (time.perf_counter() - begin_s) * 1e3

    def _is_driving(self) -> bool:
        """Return whether the robot drives; enable it if the gate is shut."""
        state = self._state.fresh()
        if state is None:
            return False
        if state.gate.mode != "enabled" and not self._enabling:
            self._enabling = True
            asyncio.get_running_loop().create_task(self._enable(state.gate.estop_generation))
        return state.velocity.linear_x > DRIVING_SHARE * SPEED

    async def _enable(self, generation: int) -> None:
        """Release, then enable. The gate refuses until the body rests; the caller tries again."""
        with contextlib.suppress(Refused):
            await self._bus.ask(RELEASE, ReleaseRequest(estop_generation=generation))
            await self._bus.ask(ENABLE, EnableRequest(source=BRAIN))
        self._enabling = False


def _rests(state: RobotState) -> bool:
    return state.gate.mode == "latched" and abs(state.velocity.linear_x) < MAX_REST_SPEED


def estop_page(result: EstopResult) -> "Group":
    """Return the page that `gigabrain bench estop` prints."""
    from rich.console import Group
    from rich.text import Text

    table = table_of("network", "presses", "p50 [ms]", "p99 [ms]", "max [ms]", "travel [m]")
    for one in result.rounds:
        table.add_row(
            one.name,
            f"{len(one.ms)}",
            f"{one.p(0.5):.1f}",
            limited(one.p(0.99), MAX_P99_MS, 1),
            limited(max(one.ms), MAX_MS, 1),
            limited(max(one.travel_m, default=0.0), MAX_TRAVEL_M, 3),
        )
    title = f"\nE-stop of {result.body}: from the press to the answer that the gate is at zero"
    note = (
        "flooded: a hundred pictures of 1 MB and a thousand commands a second. Travel is by "
        "odometry, of the presses at 0.26 m/s; half of it is braking."
    )
    return Group(Text(title, style="bold"), table, Text(note, style="dim"))
