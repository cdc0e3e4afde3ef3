"""Each system again, on its own, from what was recorded of a drive: byte for byte the same."""

import asyncio
import functools
import math
from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.brain import CmdVel, Intent, Twist, WorldModel
from gigabrain_schemas.safety import SafetyState
from gigabrain_schemas.topics import BODY, CMD_VEL, SCAN, STATE, TELEOP
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.clock import FakeClock
from gigabrain_zenoh.config.settings import DecisionConfig, PerceptionConfig
from gigabrain_zenoh.control import node as control
from gigabrain_zenoh.decision import node as decision
from gigabrain_zenoh.geometry.limits import ZERO
from gigabrain_zenoh.perception import node as perception
from gigabrain_zenoh.runtime.replay import Event, Node, record, replay
from gigabrain_zenoh.safety import node as safety
from gigabrain_zenoh.safety.health import Host
from gigabrain_zenoh.testing.samples import BOOT, DRIVING, TICK_NS, body, round_room, scan, state

SYSTEMS: dict[str, tuple[Node, str]] = {
    "perception": (functools.partial(perception.run, PerceptionConfig()), "robot/world"),
    "decision": (functools.partial(decision.run, DecisionConfig()), "robot/intent"),
    "control": (control.run, "robot/cmd_vel"),
    "safety": (functools.partial(safety.run, probe=lambda _: Host()), "robot/safety"),
}


class Plant:
    """A body with a lidar in a round room, that does what it is told a tick later."""

    def __init__(self, bus: Bus) -> None:
        self._bus, self._told = bus, ZERO
        self._noise = np.random.default_rng(0)
        self.x = self.y = self.yaw = 0.0
        bus.time.boot = BOOT
        bus.subscribe(CMD_VEL, self._obey)
        bus.publish(BODY, body())

    def tick(self, tick: int, *, blind: bool) -> None:
        self._bus.time.tick = tick
        v, w = 0.95 * self._told.linear_x, self._told.angular_z
        self.x += v * 0.02 * math.cos(self.yaw)
        self.y += v * 0.02 * math.sin(self.yaw)
        self.yaw = math.remainder(self.yaw + w * 0.02, 2 * math.pi)
        now = state(tick, v=v, w=w, pose=(self.x, self.y, self.yaw), gate=DRIVING)
        self._bus.publish(STATE, now, basis=tick)
        if tick % 5 == 0:
            ranges = round_room(2.0, self.x, self.y, self.yaw)
            ranges += self._noise.normal(0.0, 0.005, 360)
            ranges = np.full(360, math.nan) if blind else ranges
            self._bus.publish(SCAN, scan(ranges, tick), basis=tick)

    def _obey(self, _key: str, command: CmdVel) -> None:
        self._told = Velocity(linear_x=command.linear_x, angular_z=command.angular_z)


@functools.cache
def drive() -> tuple[Event, ...]:
    """12 s: the brain drives and turns, the lidar fails for a while, an operator takes over."""
    return tuple(asyncio.run(_drive()))


async def _drive() -> list[Event]:
    clock, network = FakeClock(), LocalNetwork()
    events = record(network, clock)
    buses = [Bus(network.transport(), clock) for _ in range(6)]
    running = [
        asyncio.ensure_future(node(bus, lambda: None))
        for bus, (node, _) in zip(buses, SYSTEMS.values(), strict=False)
    ]
    await clock.advance(0)
    plant, operator = Plant(buses[4]), buses[5]
    for tick in range(1, 601):
        plant.tick(tick, blind=350 < tick <= 380)
        if tick > 450 and tick % 2 == 0:
            operator.publish(TELEOP, Twist(linear_x=-0.1, angular_z=0.2))
        await clock.advance(TICK_NS)
    for task in running:
        task.cancel()
    await asyncio.gather(*running, return_exceptions=True)
    for bus in buses:
        await bus.close()
    return events


@pytest.mark.long
def test_the_recorded_drive_has_something_of_everything() -> None:
    def told(key: str, kind: type[msgspec.Struct]) -> list[msgspec.Struct]:
        return [msgspec.msgpack.decode(data, type=kind) for _, k, data in drive() if k == key]

    worlds = [w for w in told("robot/world", WorldModel) if isinstance(w, WorldModel)]
    intents = [i for i in told("robot/intent", Intent) if isinstance(i, Intent)]
    verdicts = [v for v in told("robot/safety", SafetyState) if isinstance(v, SafetyState)]
    commands = [c for c in told("robot/cmd_vel", CmdVel) if isinstance(c, CmdVel)]
    assert len(worlds) == 120
    assert {intent.reason.split(":")[0] for intent in intents} == {
        "forward 0.20 m/s",
        "turning right",
        "waiting",
    }
    assert {cause.code for verdict in verdicts for cause in verdict.causes} >= {"scan_blind"}
    assert max(command.linear_x for command in commands) == pytest.approx(0.2 / 0.95, rel=0.02)
    assert commands[-1].linear_x == pytest.approx(-0.1 / 0.95, rel=0.1)


@pytest.mark.long
@pytest.mark.parametrize("name", SYSTEMS)
async def test_a_system_replayed_on_its_own_sends_the_same_bytes(name: str) -> None:
    node, key = SYSTEMS[name]
    events = await asyncio.to_thread(drive)
    received = [event for event in events if event[1] != key]
    sent = [(k, payload) for _, k, payload in events if k == key]
    assert len(sent) >= 120
    assert await replay(node, received) == sent


async def test_a_system_that_was_changed_sends_something_else() -> None:
    events = await asyncio.to_thread(drive)
    received = [event for event in events if event[1] != "robot/intent"]
    slower = functools.partial(decision.run, DecisionConfig(settings={"max_linear_speed": 0.15}))
    same = [(key, payload) for _, key, payload in events if key == "robot/intent"]
    assert await replay(slower, received) != same


async def test_what_ends_a_node_ends_its_replay() -> None:
    async def fragile(bus: Bus, ready: Callable[[], None]) -> None:
        def break_down(_key: str, command: CmdVel) -> None:
            raise ArithmeticError("no such thing")

        bus.subscribe(CMD_VEL, break_down)
        ready()
        await bus.failed

    command = msgspec.msgpack.encode(CmdVel(linear_x=0.0))
    with pytest.raises(ArithmeticError, match="no such thing"):
        await replay(fragile, [(0, "robot/cmd_vel", command)])


async def test_a_recording_whose_time_goes_back_is_refused() -> None:
    events = [(20, "robot/state", b""), (10, "robot/state", b"")]
    with pytest.raises(ValueError, match="an event at 10 ns follows one at 20 ns"):
        await replay(control.run, events)
