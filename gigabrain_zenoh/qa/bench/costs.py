"""Where the chain's time goes: what each hop does, timed by itself on what was overheard."""

import asyncio
import statistics
import time
from collections import defaultdict
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from msgspec import Struct
from msgspec.structs import replace

from gigabrain_schemas.base import TICK_NS
from gigabrain_schemas.topics import BODY, INTENT, SCAN, STATE, WORLD, Topic
from gigabrain_zenoh import codec
from gigabrain_zenoh.bus.bridge import Bridge
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.codec import Codec
from gigabrain_zenoh.config.settings import DecisionConfig, PerceptionConfig
from gigabrain_zenoh.control import node as control
from gigabrain_zenoh.decision.node import Thinker
from gigabrain_zenoh.diagnostics.rates import HOPS, Heard
from gigabrain_zenoh.launch.specs import process_specs
from gigabrain_zenoh.perception import node as perception
from gigabrain_zenoh.qa.bench.figures import Figures
from gigabrain_zenoh.qa.bench.group import client, running
from gigabrain_zenoh.qa.bench.runs import LOOPBACK
from gigabrain_zenoh.runtime.deployment import Deployment, client_endpoint, with_free_port

T = TypeVar("T")
TURNS = 100
# A process that has slept finds its code in no cache: the second call within a millisecond would
# cost a fifth of the first. So each turn sleeps as long as a process does between two ticks.
PAUSE_S = TICK_NS / 1e9


class Hop(Struct, frozen=True, kw_only=True):
    """One hop, from a message's departure to the next one's [ms, medians]."""

    name: str  # "scan → world"
    took: float  # in the running chain
    put: float  # filling in the header, encoding, and Zenoh's put
    bridge: float  # from Zenoh's thread to the event loop
    decode: float
    step: float  # the node's work; 0 at the driver, where the clock is stopped

    @property
    def rest(self) -> float:
        """Zenoh, the kernel, and waiting for a core."""
        return self.took - self.put - self.bridge - self.decode - self.step


class Timed:
    """Durations by name."""

    def __init__(self) -> None:
        self._ms: defaultdict[str, list[float]] = defaultdict(list)

    def __call__(self, name: str, work: Callable[[], T]) -> T:
        """Do `work`, and note how long it took."""
        begin = time.perf_counter_ns()
        result = work()
        self.add(name, time.perf_counter_ns() - begin)
        return result

    def add(self, name: str, duration_ns: int) -> None:
        """Note a duration."""
        self._ms[name].append(duration_ns / 1e6)

    def median(self, name: str) -> float:
        """The median [ms]; 0 for what was never done."""
        return statistics.median(self._ms.get(name, (0.0,)))


async def measure_hops(heard: Heard, total: Figures, folder: Path) -> list[Hop]:
    """What each hop spends on what, beside how long it took in the chain that was overheard."""
    timed = Timed()
    deployment = with_free_port(Deployment(hosts={"robot": ("router",)}, router=LOOPBACK))
    endpoint = client_endpoint(deployment)
    specs = process_specs(deployment, "robot", folder, folder / "state")
    async with running(specs), client(endpoint) as sender, client(endpoint) as receiver:
        for topic in HOPS:  # what nobody listens to is not even sent
            receiver.subscribe(topic, lambda _key, _message: None)
        await _take_turns(heard, sender, timed)
    await _time_bridge(timed)
    return [_hop(heard, total, timed, topic) for topic in HOPS]


async def _take_turns(heard: Heard, bus: Bus, timed: Timed) -> None:
    """In each turn all nodes do once what one scan makes them do."""
    first, thinker = heard.get(STATE).tick, Thinker(DecisionConfig())
    payloads = {topic.key: codec.encode(heard.get(topic)) for topic in HOPS}
    decoders = {topic.key: Codec(topic.type, topic.max_bytes).decode for topic in HOPS}
    for tick in range(first, first + TURNS):
        steps = steps_at(tick, heard, thinker)
        await asyncio.sleep(PAUSE_S)
        for topic in HOPS:
            timed(f"put {topic.key}", partial(bus.publish, topic, heard.get(topic), basis=tick))
            timed(f"decode {topic.key}", partial(decoders[topic.key], payloads[topic.key]))
            if topic.key in steps:
                timed(f"step {topic.key}", steps[topic.key])


def steps_at(tick: int, heard: Heard, thinker: Thinker) -> dict[str, Callable[[], object]]:
    """What each message makes its receiver do in a tick, as long as all goes well."""
    body, scan = heard.get(BODY).description, heard.get(SCAN)
    state = replace(heard.get(STATE), tick=tick)
    world = replace(heard.get(WORLD), tick=tick, basis=tick)
    intent = replace(heard.get(INTENT), tick=tick, basis=tick)
    inputs = control.Inputs(state=state, intent=intent)
    return {
        SCAN.key: partial(perception.step, PerceptionConfig(), body, scan),
        WORLD.key: partial(thinker.think, state, world),
        INTENT.key: partial(control.step, body, control.Memory(boot=state.boot), inputs),
    }


async def _time_bridge(timed: Timed) -> None:
    """From a thread like Zenoh's to the event loop."""
    bridge = Bridge()

    def arrived(posted_ns: int) -> None:
        timed.add("bridge", time.perf_counter_ns() - posted_ns)

    def post() -> None:
        for _ in range(TURNS):
            time.sleep(PAUSE_S)
            bridge.post(arrived, time.perf_counter_ns())

    await asyncio.to_thread(post)
    await asyncio.sleep(PAUSE_S)
    bridge.close()


def _hop(heard: Heard, total: Figures, timed: Timed, topic: Topic[Any]) -> Hop:
    """The hop that begins with `topic`. The last one ends where the driver stops its clock."""
    after = HOPS[HOPS.index(topic) + 1] if topic is not HOPS[-1] else None
    took = heard.between(topic, after) if after else total.p50_ms - heard.between(HOPS[0], topic)
    return Hop(
        name=f"{short(topic)} → {short(after) if after else 'driver'}",
        took=took,
        put=timed.median(f"put {topic.key}"),
        bridge=timed.median("bridge"),
        decode=timed.median(f"decode {topic.key}"),
        step=timed.median(f"step {topic.key}"),
    )


def short(topic: Topic[Any]) -> str:
    """The topic's own part of its key."""
    return topic.key.rpartition("/")[2]
