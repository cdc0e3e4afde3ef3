"""`gigabrain bench chain --with tools`: the chain alone and with all tools beside it, in turns.

Each round times the chain alone before and after: how far these two lie apart is what the machine
does by itself, and nothing smaller than that can be told of the tools.
"""

import statistics
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from msgspec import Struct
from msgspec.structs import replace

from gigabrain_schemas.safety import Health
from gigabrain_schemas.topics import HEALTH
from gigabrain_zenoh.config.settings import FoxgloveConfig, PageConfig, RecorderConfig
from gigabrain_zenoh.qa.bench.figures import Figures
from gigabrain_zenoh.qa.bench.onlookers import ECHO, Ports, looking_on
from gigabrain_zenoh.qa.bench.runs import brain, chain_figures, time_chain
from gigabrain_zenoh.runtime.deployment import ROBOT, Deployment

TOOLS = {"recorder": 3.0, "page": 2.0, "foxglove": 2.0, ECHO: None}  # [% of a core] at most
SETTLE_S = 2.0  # until the tools are connected, and health has forgotten how they started
ADDED = 5.0  # [%] at most, to the p99 from scan to command


class Tool(Struct, frozen=True, kw_only=True):
    """What one tool needs."""

    name: str
    cpu: float  # of one core, mean over the rounds
    limit: float | None = None  # [%]


class Beside(Struct, frozen=True, kw_only=True):
    """One rate: the rounds, which were run in turns."""

    rate_hz: float
    alone: tuple[Figures, ...]
    tools: tuple[Figures, ...]
    again: tuple[Figures, ...]  # alone once more, after the tools

    @property
    def added_p99(self) -> tuple[float, float, float]:
        """What the tools add to the p99 of the runs before and after [%]: least, median, most."""
        turns = zip(self.alone, self.tools, self.again, strict=True)
        return _spread(2 * tools.p99_ms / (a.p99_ms + b.p99_ms) for a, tools, b in turns)

    @property
    def noise_p99(self) -> tuple[float, float, float]:
        """The same of the second run alone, against the first."""
        turns = zip(self.alone, self.again, strict=True)
        return _spread(b.p99_ms / a.p99_ms for a, b in turns)

    @property
    def noisy(self) -> bool:
        """Whether the machine by itself does more than tools may add, so that nothing is shown."""
        return max(map(abs, self.noise_p99)) > ADDED


def _spread(ratios: Iterable[float]) -> tuple[float, float, float]:
    added = [100 * (ratio - 1) for ratio in ratios]
    return min(added), statistics.median(added), max(added)


class ToolsResult(Struct, frozen=True, kw_only=True):
    """The whole benchmark."""

    seconds: float  # of each run
    recorded_hz: float  # messages a second that the recorder took
    rates: tuple[Beside, ...]
    tools: tuple[Tool, ...]


class _Run(Struct, frozen=True):
    """One run with tools."""

    figures: Figures
    cpu: dict[str, float]  # of one core
    recorded_hz: float


async def measure_with_tools(
    seconds: float, rounds: int, rates_hz: Sequence[float], say: Callable[[str], None]
) -> ToolsResult:
    """Run it all. Raises GigabrainError when a process dies on the way."""
    compared, runs = [], list[_Run]()
    with tempfile.TemporaryDirectory(prefix="gigabrain-bench-") as name:
        for rate_hz in rates_hz:
            alone, beside, again = [], list[_Run](), []
            for i in range(1, rounds + 1):
                say(f"{rate_hz:g} Hz, round {i} of {rounds}: chain alone")
                alone.append(await time_chain(rate_hz, seconds, Path(name)))
                say(f"{rate_hz:g} Hz, round {i} of {rounds}: chain with tools")
                beside.append(await _time_with_tools(rate_hz, seconds, Path(name)))
                say(f"{rate_hz:g} Hz, round {i} of {rounds}: chain alone again")
                again.append(await time_chain(rate_hz, seconds, Path(name)))
            compared.append(
                Beside(
                    rate_hz=rate_hz,
                    alone=tuple(alone),
                    tools=tuple(run.figures for run in beside),
                    again=tuple(again),
                )
            )
            runs += beside
    return ToolsResult(
        seconds=seconds,
        recorded_hz=statistics.fmean(run.recorded_hz for run in runs),
        rates=tuple(compared),
        tools=tuple(_tool(name, runs) for name in TOOLS),
    )


def _tool(name: str, runs: Sequence[_Run]) -> Tool:
    cpu = statistics.fmean(run.cpu.get(name, 0.0) for run in runs)
    return Tool(name=name, cpu=cpu, limit=TOOLS[name])


async def _time_with_tools(rate_hz: float, seconds: float, folder: Path) -> _Run:
    ports = Ports.free()

    def add_tools(deployment: Deployment) -> Deployment:
        return replace(
            deployment,
            router=ports.endpoint,
            hosts={"robot": (*ROBOT, "recorder", "page", "foxglove")},
            recorder=RecorderConfig(folder=str(folder / "bags"), keep_free_mb=0),
            page=PageConfig(port=ports.page),
            foxglove=FoxgloveConfig(port=ports.foxglove, secret=str(folder / "secret")),
        )

    told: defaultdict[str, list[Health]] = defaultdict(list)
    async with brain(rate_hz, folder, add_tools) as (group, bus):
        async with looking_on(ports) as echo:
            await group.go_on(SETTLE_S)
            close = bus.subscribe(HEALTH, lambda _key, health: told[health.process].append(health))
            spent_s = echo.cpu_s()
            await group.go_on(seconds)
            cpu = {ECHO: (echo.cpu_s() - spent_s) / seconds}
            close()
        figures = await chain_figures(bus)
    for name, healths in told.items():
        cpu[name] = statistics.fmean(health.cpu for health in healths)
    recorded = [health.counters.get("recorded", 0) for health in told["recorder"]]
    rate = (recorded[-1] - recorded[0]) / max(len(recorded) - 1, 1)
    return _Run(figures=figures, cpu=cpu, recorded_hz=rate)
