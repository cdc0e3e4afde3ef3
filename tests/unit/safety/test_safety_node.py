"""Safety on the bus: rate of verdicts, the systems it needs, and timeouts."""

import logging

import pytest
from msgspec.structs import replace

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import GateStatus
from gigabrain_schemas.brain import CmdVel, Intent, WorldModel
from gigabrain_schemas.examples import example
from gigabrain_schemas.sensors import Imu
from gigabrain_schemas.topics import BODY, CMD_VEL, IMU, INTENT, SAFETY, SCAN, STATE, WORLD
from gigabrain_zenoh.safety import node as safety
from gigabrain_zenoh.safety.step import LATCHING_TICKS
from gigabrain_zenoh.testing.in_memory import NodeBench
from gigabrain_zenoh.testing.samples import BOOT, DRIVING, TICK_NS, body, open_space, scan, state

ALL = ("perception", "decision", "control")
SCRIPT = GateStatus(mode="enabled", commander="script", enables=1)
NOBODY = GateStatus(mode="idle")
WORLD_NOW = WorldModel(scan_ok=True, obstacle_ahead=False)
INTENT_NOW = Intent(twist=Velocity(), behaviour="avoid", reason="because")


class Chain(NodeBench):
    """Safety with all of its inputs."""

    def __init__(self) -> None:
        super().__init__(safety.run)
        self.tick = self.seen = 0

    async def go(
        self,
        ticks: int,
        *,
        alive: tuple[str, ...] = ALL,
        scans: bool = True,
        gate: GateStatus = DRIVING,
        source: str = "control",
        battery: float = 100.0,
        hung: str = "",
    ) -> list[tuple[int, tuple[str, ...]]]:
        """Run some ticks with these systems alive; return tick and causes of each verdict.

        The `hung` system goes on sending messages with the newest tick, but an old basis.
        """
        old = self.seen
        for _ in range(ticks):
            self.tick += 1
            self.send(STATE, state(self.tick, gate=gate, battery=battery))
            if self.tick % 5 == 0 and scans:
                self.send(SCAN, scan(open_space(), self.tick))
                self.seen = self.tick
            basis = {name: old if name == hung else self.seen for name in ALL}
            if self.tick % 5 == 0 and "perception" in alive:
                world = replace(WORLD_NOW, basis=basis["perception"])
                self.send(WORLD, replace(world, boot=BOOT, tick=self.tick))
            if "decision" in alive:
                intent = replace(INTENT_NOW, basis=basis["decision"])
                self.send(INTENT, replace(intent, boot=BOOT, tick=self.tick))
            if "control" in alive:
                command = CmdVel(linear_x=0.0, source=source, boot=BOOT, tick=self.tick)
                self.send(CMD_VEL, replace(command, basis=basis["control"]))
            await self.clock.advance(TICK_NS)
        return [(v.tick, tuple(c.code for c in v.causes)) for v in self.sent(SAFETY)]


async def started(chain: Chain) -> None:
    chain.send(BODY, body())
    await chain.go(20)


async def test_a_verdict_is_published_every_second_tick_and_with_every_scan() -> None:
    async with Chain() as chain:
        await started(chain)
        ticks = [tick for tick, causes in await chain.go(20) if causes == ()]
    assert ticks == [22, 24, 25, 27, 29, 30, 32, 34, 35, 37, 39, 40]


async def test_a_verdict_is_based_on_the_newest_scan_and_has_the_newest_tick() -> None:
    async with Chain() as chain:
        chain.send(BODY, body())
        chain.send(STATE, state(5))
        chain.send(SCAN, scan(open_space(), 5))
        verdicts = chain.sent(SAFETY)
    assert [(v.boot, v.tick, v.basis) for v in verdicts] == [(BOOT, 5, 0), (BOOT, 5, 5)]


async def test_a_scan_that_overtakes_the_state_of_its_tick_waits_for_it() -> None:
    async with Chain() as chain:
        chain.send(BODY, body())
        chain.send(STATE, state(4))
        chain.sent(SAFETY)
        chain.send(SCAN, scan(open_space(), 5))
        assert chain.sent(SAFETY) == []
        chain.send(STATE, state(5))
        assert [(v.tick, v.basis) for v in chain.sent(SAFETY)] == [(5, 5)]


async def test_a_change_is_published_at_once() -> None:
    async with Chain() as chain:
        await started(chain)
        await chain.go(1)
        await chain.go(111, battery=1.0)  # 13 until the median follows, and two seconds
        found = await chain.go(1, battery=1.0)
    assert found == [(133, ("battery_empty",))]


@pytest.mark.parametrize("tick", [23, 24])  # the state of tick 25 comes with a scan
async def test_a_knock_is_reported_for_a_while_as_a_busy_gate_may_miss_a_verdict(tick: int) -> None:
    knock = replace(example(Imu), linear_acceleration=(60.0, 0.0, 9.8), boot=BOOT, tick=tick)
    async with Chain() as chain:
        await started(chain)
        await chain.go(tick - 20)
        chain.send(IMU, knock)
        found = await chain.go(20)
    reported = [since for since, causes in found if causes == ("collision",)]
    verdicts = [since for since, _ in found if tick < since <= tick + LATCHING_TICKS]
    assert reported == verdicts
    assert len(reported) > 5


@pytest.mark.parametrize(
    ("name", "missed_ms"),
    [("decision", 160), ("control", 160), ("perception", 260)],
)
async def test_a_silent_system_is_reported_in_time(name: str, missed_ms: int) -> None:
    async with Chain() as chain:
        await started(chain)
        alive = tuple(other for other in ALL if other != name)
        found = await chain.go(30, alive=alive)
    first = next(tick for tick, causes in found if causes)
    assert (first - 20) * 20 == missed_ms  # the last messages have tick 20
    assert found[-1] == (50, (f"{name}_silent",))


@pytest.mark.parametrize("name", ALL)
async def test_a_system_that_hangs_while_its_process_runs_is_reported_within_300_ms(
    name: str,
) -> None:
    async with Chain() as chain:
        await started(chain)
        found = await chain.go(30, hung=name)
        again = await chain.go(10)
    first = next(tick for tick, causes in found if causes)
    assert (first - 20) * 20 == 260  # the next scan comes 100 ms after the last answered one
    assert {causes for tick, causes in found if tick >= first} == {(f"{name}_silent",)}
    assert again[-1][1] == ()


async def test_a_lost_scan_is_reported_in_time() -> None:
    async with Chain() as chain:
        await started(chain)
        found = await chain.go(30, scans=False)
    first = next(tick for tick, causes in found if causes)
    assert (first - 20) * 20 == 260
    assert found[-1][1] == ("scan_lost",)


async def test_commands_of_a_script_do_not_count_as_control() -> None:
    async with Chain() as chain:
        await started(chain)
        found = await chain.go(30, source="script")
    assert found[-1] == (50, ("control_silent",))


async def test_without_a_brain_a_script_may_drive() -> None:
    async with Chain() as chain:
        chain.send(BODY, body())
        idle = await chain.go(30, alive=(), gate=NOBODY)
        driven = await chain.go(30, alive=("control",), source="script", gate=SCRIPT)
    assert idle[-1] == (30, ())
    assert {causes for _, causes in driven} == {()}


async def test_silence_is_judged_by_the_robots_clock_only() -> None:
    async with Chain() as chain:
        await started(chain)
        await chain.clock.advance(200_000_000)  # the driver hung; its ticks stood still
        found = await chain.go(3, scans=False)
    assert {causes for _, causes in found} <= {()}  # 260 ms by arrival, 60 ms by the tick


async def test_a_restart_of_the_driver_resets_safety() -> None:
    async with Chain() as chain:
        await started(chain)
        for tick in (1, 2, 3):
            chain.send(STATE, state(tick, boot=8))
        assert chain.sent(SAFETY) == []  # the body is not known yet
        chain.send(BODY, body(boot=8))
        chain.send(STATE, state(4, boot=8))
        (verdict,) = chain.sent(SAFETY)
    assert (verdict.boot, verdict.tick, verdict.basis) == (8, 4, 0)
    assert [cause.code for cause in verdict.causes][:2] == ["scan_lost", "starting"]


async def test_a_cause_is_logged_once_when_it_begins_and_once_when_it_ends(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "gigabrain_zenoh.safety")
    async with Chain() as chain:
        chain.send(BODY, body())
        await chain.go(20, alive=("decision",), gate=NOBODY)  # nothing is logged during the start
        await chain.go(20, gate=NOBODY)
        assert caplog.messages == []
        await chain.go(20)
        await chain.go(50, alive=("perception", "control"))
        await chain.go(20)
    assert caplog.messages == [
        "stop: decision is silent (start decision, or read its log)",
        "over: decision is silent",
    ]


@pytest.mark.parametrize("key", ["robot/imu", "robot/map", "robot/pose", "robot/log"])
async def test_invalid_messages_on_keys_without_another_reader_are_counted(key: str) -> None:
    async with Chain() as chain:
        await started(chain)
        chain.network.deliver(key, b"\xc1garbage")
        assert chain.bus.rejected == {key: 1}
