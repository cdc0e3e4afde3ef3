"""Decision as a process: when it publishes intents, and their basis."""

import functools
import logging

import pytest
from msgspec.structs import replace

from gigabrain_schemas.base import Cause
from gigabrain_schemas.body import Body
from gigabrain_schemas.brain import Intent, WorldModel
from gigabrain_schemas.safety import SafetyState
from gigabrain_schemas.topics import BODY, INTENT, SAFETY, STATE, WORLD
from gigabrain_zenoh.config.settings import DecisionConfig
from gigabrain_zenoh.decision import node as decision
from gigabrain_zenoh.errors import UnknownName
from gigabrain_zenoh.testing.in_memory import NodeBench
from gigabrain_zenoh.testing.samples import LIDAR, WAFFLE, body, state
from tests.unit.control.arm import arm_body

CONFIG = DecisionConfig()


def world(tick: int, *, ahead: bool = False, boot: int = 7) -> WorldModel:
    return WorldModel(
        scan_ok=True,
        obstacle_ahead=ahead,
        distance_ahead=0.83 if ahead else None,
        boot=boot,
        tick=tick,
        basis=tick,
    )


def bench(config: DecisionConfig = CONFIG) -> NodeBench:
    return NodeBench(functools.partial(decision.run, config))


def heads(intents: list[Intent]) -> list[tuple[int, int, str]]:
    return [(i.tick, i.basis, i.reason.partition(" ")[0]) for i in intents]


async def test_a_world_model_leads_to_an_intent_at_once() -> None:
    async with bench() as node:
        node.send(STATE, state(10))
        assert heads(node.sent(INTENT)) == [(10, 0, "waiting:")]
        node.send(WORLD, world(10))
        assert heads(node.sent(INTENT)) == [(10, 10, "forward")]


async def test_an_intent_is_repeated_with_the_newest_tick_and_its_own_basis() -> None:
    async with bench() as node:
        node.send(STATE, state(10))
        node.send(WORLD, world(10))
        node.sent(INTENT)
        for tick in (11, 12, 13):
            node.send(STATE, state(tick))
        assert heads(node.sent(INTENT)) == [
            (11, 10, "forward"),
            (12, 10, "forward"),
            (13, 10, "forward"),
        ]
        node.send(STATE, state(15))
        node.send(WORLD, world(15, ahead=True))
        assert heads(node.sent(INTENT)) == [(15, 10, "forward"), (15, 15, "turning")]


async def test_a_world_model_that_arrives_before_the_state_of_its_tick_waits_for_it() -> None:
    async with bench() as node:
        node.send(STATE, state(9))
        node.sent(INTENT)
        node.send(WORLD, world(10))
        assert node.sent(INTENT) == []
        node.send(STATE, state(10))
        assert heads(node.sent(INTENT)) == [(10, 10, "forward")]


async def test_a_state_does_not_use_a_later_world_model() -> None:
    async with bench() as node:
        node.send(STATE, state(8))
        node.send(WORLD, world(10))
        node.sent(INTENT)
        node.send(STATE, state(9))
        assert heads(node.sent(INTENT)) == [(9, 0, "waiting:")]


async def test_it_steps_once_per_world_model_and_repeats_the_intent() -> None:
    async with bench() as node:
        node.send(STATE, state(10))
        node.send(WORLD, world(10))
        node.send(STATE, state(11, pose=(1.0, 0.0, 0.0)))
        node.send(WORLD, world(10))  # the same again
        intents = node.sent(INTENT)
    assert [intent.progress for intent in intents] == [0.0, 0.0, 0.0, 0.0]


@pytest.mark.parametrize(("rate_hz", "last"), [(10.0, 22), (5.0, 25)])
async def test_it_waits_once_the_world_model_is_older_than_250_ms_or_1_5_scans(
    rate_hz: float, last: int
) -> None:
    async with bench() as node:
        node.send(BODY, body(replace(WAFFLE, lidar=replace(LIDAR, rate_hz=rate_hz))))
        node.send(STATE, state(10))
        node.send(WORLD, world(10))
        for tick in range(11, 30):
            node.send(STATE, state(tick))
        intents = node.sent(INTENT)
    forward = [intent.tick for intent in intents if intent.reason.startswith("forward")]
    assert forward[-1] == last
    assert intents[-1].reason == "waiting: perception is silent"
    assert intents[-1].basis == 10


async def test_a_restart_of_the_driver_resets_the_behaviour() -> None:
    async with bench() as node:
        node.send(STATE, state(5000))
        node.send(WORLD, world(5000))
        for tick in (1, 2, 3):
            node.send(STATE, state(tick, boot=8))
        node.send(STATE, state(5, boot=8, pose=(9.0, 9.0, 0.0)))
        node.send(WORLD, world(5, boot=8))
        intents = node.sent(INTENT)
    assert heads(intents)[2:] == [(3, 0, "waiting:"), (5, 0, "waiting:"), (5, 5, "forward")]
    assert intents[-1].boot == 8
    assert intents[-1].progress == 0.0


async def test_a_change_of_activity_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "gigabrain_zenoh.decision.node")
    async with bench() as node:
        for tick in range(10, 30, 5):
            node.send(STATE, state(tick))
            node.send(WORLD, world(tick, ahead=tick >= 20))
    assert [record.getMessage() for record in caplog.records] == [
        "waiting: perception is silent",
        "forward 0.20 m/s",
        "turning right: obstacle 0.83 m ahead",
    ]


async def test_it_idles_with_a_reason_for_a_fixed_arm_without_a_world_model() -> None:
    async with bench() as node:
        node.send(BODY, Body(description=arm_body(), link="sim", boot=7, tick=9))
        node.send(STATE, state(10))
        node.send(STATE, state(11))
        found = node.sent(INTENT)
    assert [(intent.tick, intent.basis) for intent in found] == [(10, 10), (11, 11)]
    assert {intent.reason for intent in found} == {"idle: the body has no base to drive"}
    assert {(intent.twist, intent.joints) for intent in found} == {(None, ())}


async def test_it_publishes_nothing_without_a_state() -> None:
    async with bench() as node:
        node.send(WORLD, world(10))
        assert node.sent(INTENT) == []
        node.send(STATE, state(10))
        node.sent(INTENT)
        await node.clock.advance(260_000_000)  # the driver stopped
        node.send(WORLD, world(10))
        assert node.sent(INTENT) == []


async def test_an_unknown_behaviour_raises_before_the_process_starts() -> None:
    with pytest.raises(UnknownName, match="no behaviour 'fly'"):
        await decision.run(DecisionConfig(behaviour="fly"), None, lambda: None)  # type: ignore[arg-type]


async def test_it_rests_when_safety_warns_of_an_empty_battery() -> None:
    low = Cause(code="battery_return", text="battery at 6 %")
    async with NodeBench(functools.partial(decision.run, CONFIG)) as bench:
        bench.send(BODY, body())
        found = []
        for tick in range(1, 5):
            bench.send(STATE, state(tick))
            bench.send(WORLD, world(tick))
            warnings = (low,) if tick > 1 else ()
            verdict = SafetyState(verdict="ok", warnings=warnings, boot=7, tick=tick)
            bench.send(SAFETY, verdict)
            found.append(bench.sent(INTENT)[-1].reason.partition(":")[0])
    # a verdict applies from the next tick on
    assert found == ["forward 0.20 m/s", "forward 0.20 m/s", "resting", "resting"]
