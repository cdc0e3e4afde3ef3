"""`gigabrain bench chain`: latency from scan to command, next to a bare relay, and per hop."""

import asyncio
import statistics
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec
import yaml
from msgspec import Struct
from msgspec.structs import replace

from gigabrain_drivers.driver.catalog import robot_path
from gigabrain_schemas.base import TICK_NS
from gigabrain_schemas.topics import BODY, INTENT, SCAN, STATE, WORLD, Topic
from gigabrain_zenoh import codec
from gigabrain_zenoh.bus.bridge import Bridge
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.codec import Codec
from gigabrain_zenoh.config.settings import DecisionConfig, Endpoint, PerceptionConfig
from gigabrain_zenoh.control import node as control
from gigabrain_zenoh.decision.node import DecisionLoop
from gigabrain_zenoh.diagnostics.topic_stats import HOPS, ChainMonitor, monitor_chain
from gigabrain_zenoh.launch.deployment import Deployment, client_endpoint, with_free_port
from gigabrain_zenoh.launch.processes import PROCESSES
from gigabrain_zenoh.launch.specs import process_specs
from gigabrain_zenoh.perception import node as perception
from gigabrain_zenoh.qa.bench.peer_frameworks import Framework, time_framework
from gigabrain_zenoh.qa.bench.relay import RelayRole
from gigabrain_zenoh.qa.judging import Latencies, limited, over_rounds, table_of
from gigabrain_zenoh.qa.robot_under_test import (
    LOOPBACK,
    ProcessGroup,
    client,
    measured_robot,
    report_of,
)
from gigabrain_zenoh.runtime.managed_process import ProcessSpec

if TYPE_CHECKING:
    from rich.console import Group

T = TypeVar("T")
Progress = Callable[[str], None]
MAX_P50_RATIO, MAX_P99_RATIO = 1.5, 2.0  # of our latency to the bare relay's
LISTEN_S = 4.0
SETTLE_S = 1.0  # of the relay; the chain is measured from the opening of the gate
LATE_S = 20.0  # tolerated delay of a relay's figures
RELAY = (sys.executable, "-P", "-m", "gigabrain_zenoh.qa.bench.relay")
KEYS = ("bench/scan", "bench/world", "bench/intent", "bench/cmd")
NAMES = ("source", "first", "second", "third")
STANDS_FOR = ("driver", "perception", "decision", "control")
ROUTER_ONLY = Deployment(hosts={"robot": ("router",)}, router=LOOPBACK)
TURNS = 100
# After a sleep, a process's code is in no cache: a second call within a millisecond takes a fifth
# of the first one's time. So each turn sleeps for a tick, like a process.
PAUSE_S = TICK_NS / 1e9


class RateComparison(Struct, frozen=True, kw_only=True):
    """Rounds of chain, relay and frameworks in turns at one rate; a relay without a router."""

    rate_hz: float
    chain: tuple[Latencies, ...]
    relay: tuple[Latencies, ...]
    peers: Latencies
    frameworks: dict[str, tuple[Latencies, ...]] = {}  # by name

    @property
    def ratio_p50(self) -> float:
        """Our median latency over the bare relay's."""
        return over_rounds(self.chain).p50_ms / over_rounds(self.relay).p50_ms

    @property
    def ratio_p99(self) -> float:
        """Our 99th percentile over the bare relay's."""
        return over_rounds(self.chain).p99_ms / over_rounds(self.relay).p99_ms


class Hop(Struct, frozen=True, kw_only=True):
    """Medians of one hop [ms], from publishing a message to publishing the next one."""

    name: str  # "scan → world"
    took: float  # in the running chain
    put: float  # filling in the header, encoding, and Zenoh's put
    bridge: float  # from Zenoh's thread to the event loop
    decode: float
    step: float  # the node's step; 0 in the driver, where the measurement ends

    @property
    def rest(self) -> float:
        """Zenoh, the kernel, and waiting for a core."""
        return self.took - self.put - self.bridge - self.decode - self.step


class ChainResult(Struct, frozen=True, kw_only=True):
    """Results of the whole benchmark."""

    seconds: float  # of each run
    payload_bytes: tuple[int, ...]  # scan, world, intent, command
    rates: tuple[RateComparison, ...]
    overheard: Latencies  # the chain with a subscriber on every hop; the sum of the hops
    hops: tuple[Hop, ...]


async def measure_chain(
    seconds: float,
    rounds: int,
    rates_hz: Sequence[float],
    show: Progress,
    frameworks: Sequence[Framework] = (),
) -> ChainResult:
    """Run the benchmark, with relays of `frameworks`. Raises GigabrainError if a process dies."""
    with tempfile.TemporaryDirectory(prefix="gigabrain-bench-") as name:
        folder = Path(name)
        show(f"listening to the chain at {rates_hz[0]:g} Hz")
        monitor, monitored = await listen_to_chain(rates_hz[0], min(seconds, LISTEN_S), folder)
        sizes = monitor.sizes()
        compared = [
            await _compare(rate, seconds, rounds, sizes, folder, show, frameworks)
            for rate in rates_hz
        ]
        show("timing what each hop does")
        hops = await measure_hops(monitor, monitored)
    return ChainResult(
        seconds=seconds,
        payload_bytes=tuple(sizes),
        rates=tuple(compared),
        overheard=monitored,
        hops=tuple(hops),
    )


async def _compare(
    rate_hz: float,
    seconds: float,
    rounds: int,
    sizes: Sequence[int],
    folder: Path,
    show: Progress,
    frameworks: Sequence[Framework],
) -> RateComparison:
    chain, relay = [], []
    others: dict[str, list[Latencies]] = {one.name: [] for one in frameworks}
    for i in range(1, rounds + 1):
        show(f"{rate_hz:g} Hz, round {i} of {rounds}: chain")
        chain.append(await time_chain(rate_hz, seconds, folder))
        show(f"{rate_hz:g} Hz, round {i} of {rounds}: bare relay")
        relay.append(await time_relay(rate_hz, seconds, sizes, folder))
        for one in frameworks:
            show(f"{rate_hz:g} Hz, round {i} of {rounds}: {one.name}")
            others[one.name].append(await time_framework(one, rate_hz, seconds, SETTLE_S, sizes))
    show(f"{rate_hz:g} Hz: bare relay without a router")
    peers = await time_peers(rate_hz, seconds, sizes)
    return RateComparison(
        rate_hz=rate_hz,
        chain=tuple(chain),
        relay=tuple(relay),
        peers=peers,
        frameworks={name: tuple(times) for name, times in others.items()},
    )


@asynccontextmanager
async def brain(rate_hz: float, folder: Path) -> AsyncIterator[tuple[ProcessGroup, Bus]]:
    """Run our processes as `gigabrain up` does; yield when the gate is open.

    Safety is not part of the chain, but without it the gate does not open.
    """
    deployment = Deployment(body=str(_mock_body(rate_hz, folder)), resume="auto", router=LOOPBACK)
    async with measured_robot(deployment, folder) as (group, bus):
        while not (await report_of(bus)).get("scan_to_cmd_n"):
            await group.poll()
        yield group, bus


def _mock_body(rate_hz: float, folder: Path) -> Path:
    """Write the file of a body without physics, with a lidar of this rate."""
    robot = yaml.safe_load(robot_path("mock").read_text(encoding="utf-8"))
    robot["lidar"]["rate_hz"] = rate_hz
    path = folder / "mock.yaml"
    path.write_text(yaml.safe_dump(robot), encoding="utf-8")
    return path


async def time_chain(rate_hz: float, seconds: float, folder: Path) -> Latencies:
    """Measure the latency from scan to command by the driver's clock."""
    async with brain(rate_hz, folder) as (group, bus):
        await group.run_for(seconds)
        return await _chain_latencies(bus)


async def listen_to_chain(
    rate_hz: float, seconds: float, folder: Path
) -> tuple[ChainMonitor, Latencies]:
    """Measure with a subscriber on every hop, which slows the chain a little."""
    async with brain(rate_hz, folder) as (group, bus):
        monitor = monitor_chain(bus)
        await group.run_for(seconds)
        await group.until(lambda: monitor.complete, "a message of every hop")
        return monitor, await _chain_latencies(bus)


async def _chain_latencies(bus: Bus) -> Latencies:
    report = await report_of(bus)
    names = Latencies.__struct_fields__
    return msgspec.convert({name: report.get(f"scan_to_cmd_{name}") for name in names}, Latencies)


async def time_relay(
    rate_hz: float, seconds: float, sizes: Sequence[int], folder: Path
) -> Latencies:
    """Time four bare processes that are connected by a router like ours."""
    deployment = with_free_port(ROUTER_ONLY)
    router = process_specs(deployment, "robot", folder, folder / "state")
    endpoints = [client_endpoint(deployment)] * len(NAMES)
    return await _run_relay(router, relay_roles(rate_hz, seconds, sizes, endpoints))


async def time_peers(rate_hz: float, seconds: float, sizes: Sequence[int]) -> Latencies:
    """Time four bare processes that are connected directly: shows the cost of the router."""
    addresses = tuple(with_free_port(Deployment(router=LOOPBACK)).router for _ in NAMES)
    endpoints = [Endpoint(listen=(addresses[i],), connect=addresses[:i]) for i in range(len(NAMES))]
    return await _run_relay([], relay_roles(rate_hz, seconds, sizes, endpoints))


def relay_roles(
    rate_hz: float, seconds: float, sizes: Sequence[int], endpoints: Sequence[Endpoint]
) -> list[RelayRole]:
    """Return the role of each process of a relay; the first is the source."""
    return [
        RelayRole(
            gets=KEYS[i - 1],
            puts=KEYS[i],
            size=sizes[i],
            endpoint=endpoints[i],
            first=PROCESSES[STANDS_FOR[i]].stops,
            rate_hz=0.0 if i else rate_hz,
            settle_s=SETTLE_S,
            seconds=seconds,
        )
        for i in range(len(KEYS))
    ]


async def _run_relay(router: Sequence[ProcessSpec], roles: Sequence[RelayRole]) -> Latencies:
    after = tuple(spec.name for spec in router)
    specs = [
        ProcessSpec(name, (*RELAY, msgspec.json.encode(role).decode()), after)
        for name, role in zip(NAMES, roles, strict=True)
    ]
    timeout_s = SETTLE_S + roles[0].seconds + LATE_S
    async with ProcessGroup([*router, *specs]) as group:
        await group.until_ready()
        found: list[Any] = []

        def measured() -> bool:
            found[:] = [one["figures"] for one in group.records if one.get("event") == "figures"]
            return bool(found)

        await group.until(measured, "the relay's figures", timeout_s)
        return msgspec.convert(found[0], Latencies)


class HopTimer:
    """Measures durations by name."""

    def __init__(self) -> None:
        self._ms: defaultdict[str, list[float]] = defaultdict(list)

    def __call__(self, name: str, work: Callable[[], T]) -> T:
        """Call `work`, add its duration, and return its result."""
        begin = time.perf_counter_ns()
        result = work()
        self.add(name, time.perf_counter_ns() - begin)
        return result

    def add(self, name: str, duration_ns: int) -> None:
        """Add a duration [ns]."""
        self._ms[name].append(duration_ns / 1e6)

    def median(self, name: str) -> float:
        """Return the median [ms]; 0 without durations."""
        return statistics.median(self._ms.get(name, (0.0,)))


async def measure_hops(monitor: ChainMonitor, total: Latencies) -> list[Hop]:
    """Time the work of each hop alone, beside the hop's time in the running chain."""
    timer = HopTimer()
    deployment = with_free_port(ROUTER_ONLY)
    async with (
        measured_robot(deployment) as (_, sender),
        client(client_endpoint(deployment)) as receiver,
    ):
        for topic in HOPS:  # without a subscriber, no message is sent
            receiver.subscribe(topic, lambda _key, _message: None)
        await _time_turns(monitor, sender, timer)
    await _time_bridge(timer)
    return [_hop(monitor, total, timer, topic) for topic in HOPS]


async def _time_turns(monitor: ChainMonitor, bus: Bus, timer: HopTimer) -> None:
    """Time the work of all nodes for one scan, in each turn."""
    first, loop = monitor.get(STATE).tick, DecisionLoop(DecisionConfig())
    payloads = {topic.key: codec.encode(monitor.get(topic)) for topic in HOPS}
    decoders = {topic.key: Codec(topic.type, topic.max_bytes).decode for topic in HOPS}
    for tick in range(first, first + TURNS):
        steps = _steps_at(tick, monitor, loop)
        await asyncio.sleep(PAUSE_S)
        for topic in HOPS:
            timer(f"put {topic.key}", partial(bus.publish, topic, monitor.get(topic), basis=tick))
            timer(f"decode {topic.key}", partial(decoders[topic.key], payloads[topic.key]))
            if topic.key in steps:
                timer(f"step {topic.key}", steps[topic.key])


def _steps_at(
    tick: int, monitor: ChainMonitor, loop: DecisionLoop
) -> dict[str, Callable[[], object]]:
    """Return the work of each message's receiver in a tick."""
    body, scan = monitor.get(BODY).description, monitor.get(SCAN)
    state = replace(monitor.get(STATE), tick=tick)
    world = replace(monitor.get(WORLD), tick=tick, basis=tick)
    intent = replace(monitor.get(INTENT), tick=tick, basis=tick)
    inputs = control.ControlInputs(state=state, intent=intent)
    return {
        SCAN.key: partial(perception.step, PerceptionConfig(), body, scan),
        WORLD.key: partial(loop.step, state, world),
        INTENT.key: partial(control.step, body, control.ControlMemory(boot=state.boot), inputs),
    }


async def _time_bridge(timer: HopTimer) -> None:
    """Time the handover from a thread like Zenoh's to the event loop."""
    bridge = Bridge()

    def arrived(posted_ns: int) -> None:
        timer.add("bridge", time.perf_counter_ns() - posted_ns)

    def post() -> None:
        for _ in range(TURNS):
            time.sleep(PAUSE_S)
            bridge.post(arrived, time.perf_counter_ns())

    await asyncio.to_thread(post)
    await asyncio.sleep(PAUSE_S)
    bridge.close()


def _hop(monitor: ChainMonitor, total: Latencies, timer: HopTimer, topic: Topic[Any]) -> Hop:
    """Return the hop that begins with `topic`. The last one ends in the driver."""
    after = HOPS[HOPS.index(topic) + 1] if topic is not HOPS[-1] else None
    took = (
        monitor.between(topic, after) if after else total.p50_ms - monitor.between(HOPS[0], topic)
    )
    return Hop(
        name=f"{_short_name(topic)} → {_short_name(after) if after else 'driver'}",
        took=took,
        put=timer.median(f"put {topic.key}"),
        bridge=timer.median("bridge"),
        decode=timer.median(f"decode {topic.key}"),
        step=timer.median(f"step {topic.key}"),
    )


def _short_name(topic: Topic[Any]) -> str:
    return topic.key.rpartition("/")[2]


def chain_page(result: ChainResult) -> "Group":
    """Return the page that `gigabrain bench chain` prints."""
    from rich.console import Group
    from rich.text import Text

    compared = table_of(
        "rate", "what", "n", "p50 [ms]", "p99 [ms]", "ratio p50", "ratio p99", left=2
    )

    def row(rate: str, what: str, one: Latencies, *ratios: Text) -> None:
        compared.add_row(rate, what, str(one.n), f"{one.p50_ms:.2f}", f"{one.p99_ms:.2f}", *ratios)

    for one in result.rates:
        row(f"{one.rate_hz:g} Hz", "bare relay", over_rounds(one.relay))
        ratios = (
            limited(one.ratio_p50, MAX_P50_RATIO, 2), limited(one.ratio_p99, MAX_P99_RATIO, 2),
        )  # fmt: skip
        row("", "gigabrain", over_rounds(one.chain), *ratios)
        row("", "no router", one.peers)
        for name, times in one.frameworks.items():
            row("", name, over_rounds(times))
        compared.add_section()
    hops = table_of("hop", "took", "encode, put", "bridge", "decode", "step", "rest")
    for hop in result.hops:
        parts = (hop.took, hop.put, hop.bridge, hop.decode, hop.step, hop.rest)
        hops.add_row(hop.name, *(f"{part:.3f}" for part in parts))
    runs = f"runs of {result.seconds:g} s in turns, median of {len(result.rates[0].chain)}"
    sent = ", ".join(str(size) for size in result.payload_bytes)
    relay = (
        f"The relay is four plain Zenoh processes on a router like ours, which pass on what they "
        f"get ({sent} bytes). Our processes run as under `gigabrain up`. Safety is no part of the "
        "chain, but without it the gate stays shut."
    )
    timed = (
        "Work of each kind is timed by itself in a process that sleeps a tick in between, as ours "
        "do. The rest is Zenoh, the kernel, and waiting for a core."
    )
    overheard = f"{result.overheard.p50_ms:.2f} ms with a subscriber on each hop"
    return Group(
        Text(f"\nScan to command ({runs})", style="bold"), compared, Text(relay, style="dim"),
        Text(f"\nCost of each hop [ms] ({overheard})", style="bold"), hops,
        Text(timed, style="dim"),
    )  # fmt: skip
