"""How long a robot that has just been started takes until it may be sent somewhere."""

import asyncio
import tempfile
from collections.abc import Callable
from pathlib import Path

from msgspec import Struct

from gigabrain_schemas.brain import Intent
from gigabrain_schemas.tasks import GoalRequest
from gigabrain_schemas.topics import GOAL, INTENT
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.settings import DecisionConfig, PerceptionConfig
from gigabrain_zenoh.decision.navigating import DRIVE_KERNELS
from gigabrain_zenoh.kernels.compiling import compiled
from gigabrain_zenoh.launch.specs import process_specs
from gigabrain_zenoh.perception.node import MAP_KERNELS
from gigabrain_zenoh.qa.bench.group import Group, client, starting
from gigabrain_zenoh.qa.bench.runs import LOOPBACK
from gigabrain_zenoh.runtime.deployment import Deployment, client_endpoint, with_free_port

AHEAD = GoalRequest(x=0.5, y=0.0, source="bench")
ASK_S, AGAIN_S = 1.0, 0.02
START_S = 300.0  # far more than it takes on a busy machine
ACCEPTED_S = 2.0  # target


class FirstGoal(Struct, frozen=True, kw_only=True):
    """From the start of the first process. CPU is of all processes together."""

    accepted_s: float
    accepted_cpu_s: float
    told: str  # with what it was accepted
    drives_s: float  # until it followed its first way
    drives_cpu_s: float


async def measure_first_goal(body: str, world: str, say: Callable[[str], None]) -> FirstGoal:
    """Start a robot that makes a map, and ask it to drive until it agrees, and then does.

    What is to be compiled is compiled before. Raises ConfigError where that is not installed, and
    GigabrainError when a process dies on the way.
    """
    for warm_up in (MAP_KERNELS, DRIVE_KERNELS):
        await compiled(warm_up)
    deployment = with_free_port(
        Deployment(
            body=body, world=world, resume="auto", router=LOOPBACK,
            perception=PerceptionConfig(mapping="slam"),
            decision=DecisionConfig(behaviour="navigate"),
        )
    )  # fmt: skip
    say(f"starting {body} in {world} for a first goal")
    with tempfile.TemporaryDirectory(prefix="gigabrain-bench-") as name:
        folder = Path(name)
        specs = process_specs(deployment, "robot", folder, folder / "state")
        async with starting(specs) as group, client(client_endpoint(deployment)) as bus:
            return await _first_goal(group, bus)


async def _first_goal(group: Group, bus: Bus) -> FirstGoal:
    drives = asyncio.Event()

    def hear(_key: str, intent: Intent) -> None:
        if intent.follow:
            drives.set()

    bus.subscribe(INTENT, hear)
    asking = asyncio.ensure_future(_accepted(group, bus))
    try:
        await group.until(lambda: asking.done() and drives.is_set(), START_S)
    finally:
        asking.cancel()
    accepted_s, accepted_cpu_s, told = asking.result()
    return FirstGoal(
        accepted_s=accepted_s,
        accepted_cpu_s=accepted_cpu_s,
        told=told,
        drives_s=group.seconds,
        drives_cpu_s=group.cpu_s,
    )


async def _accepted(group: Group, bus: Bus) -> tuple[float, float, str]:
    """When, after how much CPU time [s], and in which words."""
    while True:
        replies = await bus.ask(GOAL, AHEAD, timeout_s=ASK_S)
        if replies and replies[0].ok:
            return group.seconds, group.cpu_s, replies[0].text
        await asyncio.sleep(AGAIN_S)
