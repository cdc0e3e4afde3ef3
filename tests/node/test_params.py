"""Parameters: what can be set changes what the process does, and nothing else can be set."""

import dataclasses
import functools
import logging
from collections.abc import Awaitable, Callable, Iterator

import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.brain import WorldModel
from gigabrain_schemas.tasks import GoalRequest
from gigabrain_schemas.topics import GOAL, INTENT, STATE, WORLD
from gigabrain_zenoh.config.settings import DecisionConfig
from gigabrain_zenoh.decision import behaviours
from gigabrain_zenoh.decision import node as decision
from gigabrain_zenoh.decision.behaviours import BEHAVIOURS
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.navigation.local import Goal, LocalPlanner
from gigabrain_zenoh.runtime.services import LOG_LEVEL, serve_params
from gigabrain_zenoh.testing.bus import NodeBench
from gigabrain_zenoh.testing.samples import state
from tests.node.plane import Plane, drawn
from tests.unit.navigation.drives import QUICK, WAFFLE, Drive, wall

HALL = drawn("####################\n" + "#..................#\n" * 12 + "####################")
MORE_ROOM_LEFT = (0.8, 3.0, 3.0, 1.0, 1.0, 1.0)


@pytest.fixture
def root_level() -> Iterator[None]:
    before = logging.getLogger().level
    yield
    logging.getLogger().setLevel(before)


async def wants(name: str, value: str, *, ahead: bool) -> list[Velocity | None]:
    """What the behaviour `avoid` wants before a parameter is set, and after."""
    wanted, world = [], WorldModel(scan_ok=True, obstacle_ahead=False, sectors=MORE_ROOM_LEFT)
    async with NodeBench(functools.partial(decision.run, DecisionConfig())) as bench:
        for tick in (10, 20):
            for now, seen in ((tick, False), (tick + 5, ahead)):  # each turn is a new one
                bench.send(STATE, state(now))
                here = replace(world, boot=7, tick=now, basis=now, obstacle_ahead=seen)
                bench.send(WORLD, here)
            wanted.append(bench.sent(INTENT)[-1].twist)
            bench.bus.params.change(name, value)
    return wanted


async def linear_speed() -> None:
    assert await wants("linear_speed", "0.05", ahead=False) == [
        Velocity(linear_x=0.2),
        Velocity(linear_x=0.05),
    ]


async def angular_speed() -> None:
    assert await wants("angular_speed", "0.3", ahead=True) == [
        Velocity(angular_z=-0.5),
        Velocity(angular_z=-0.3),
    ]


async def turn() -> None:
    assert await wants("turn", "clearer", ahead=True) == [
        Velocity(angular_z=-0.5),
        Velocity(angular_z=0.5),
    ]


async def speed_limit() -> None:
    async with Plane(HALL, at=(0.6, 1.6, 0.0)) as plane:
        await plane.go(0.2)
        params = plane.bench.bus.params
        await plane.ask(GOAL, GoalRequest(x=4.2, y=1.6))
        await plane.go(3.0)
        assert plane.velocity.linear_x > 0.2
        assert params.change("speed_limit", "0.05") == ("null", "0.05")
        await plane.go(1.0)
        slow = []
        for _ in range(10):
            await plane.go(0.2)
            slow.append(plane.velocity.linear_x)
        assert 0.03 < max(slow) < 0.055
        eta, left = plane.status.eta, plane.status.distance_remaining
        assert eta is not None
        assert left is not None
        assert eta == pytest.approx(left / 0.05)
        assert params.change("speed_limit", "null") == ("0.05", "null")
        await plane.go(1.5)
        assert plane.velocity.linear_x > 0.2


async def log_level() -> None:
    async with NodeBench(functools.partial(decision.run, DecisionConfig())) as bench:
        serve_params(bench.bus)
        for level in ("error", "info"):
            bench.bus.params.change(LOG_LEVEL, level)
            assert logging.getLogger("gigabrain_zenoh").isEnabledFor(logging.INFO) is (
                level == "info"
            )


# every parameter of every behaviour, with what shows that it is obeyed
OBEYED: dict[tuple[str, str], Callable[[], Awaitable[None]]] = {
    ("avoid", "linear_speed"): linear_speed,
    ("avoid", "angular_speed"): angular_speed,
    ("avoid", "turn"): turn,
    ("navigate", "speed_limit"): speed_limit,
}


@pytest.mark.parametrize("which", OBEYED, ids=" ".join)
async def test_every_parameter_of_a_behaviour_changes_what_the_robot_does(
    which: tuple[str, str],
) -> None:
    await OBEYED[which]()


def test_no_behaviour_has_a_parameter_without_such_a_test() -> None:
    there = {(name, param) for name in BEHAVIOURS for param in behaviours.load(name).PARAMS}
    assert there == set(OBEYED)


async def test_the_log_level_of_a_process_is_obeyed(root_level: None) -> None:
    await log_level()


@pytest.mark.parametrize(
    ("behaviour", "foreign", "known"),
    [
        ("navigate", "linear_speed", "speed_limit"),
        ("navigate", "angular_speed", "speed_limit"),
        ("navigate", "turn", "speed_limit"),
        ("avoid", "speed_limit", "linear_speed, angular_speed, turn"),
    ],
)
async def test_what_the_present_behaviour_does_not_read_is_refused_with_what_can_be_set(
    behaviour: str, foreign: str, known: str
) -> None:
    async with NodeBench(
        functools.partial(decision.run, DecisionConfig(behaviour=behaviour))
    ) as bench:
        await bench.ready()
        with pytest.raises(Refused) as refused:
            bench.bus.params.change(foreign, "0.1")
    assert str(refused.value).startswith(f"no parameter {foreign!r}")
    assert str(refused.value).endswith(f"known: {known}")


def test_a_speed_limit_is_set_without_forgetting_what_was_seen() -> None:
    """The way round a wall is longer, also once no beam hits the wall any more."""
    drive = Drive(WAFFLE, Goal(x=3.0, y=0.0), wall((1.0, -1.0), (1.0, 1.0)))
    seen = drive.moment()
    unseen = dataclasses.replace(seen, hits=np.empty((0, 2)))
    drive.planner.plan(seen)
    drive.planner.limit_speed(0.2)
    assert drive.planner.plan(unseen).remaining > 3.5
    assert LocalPlanner(WAFFLE, QUICK).plan(unseen).remaining == pytest.approx(3.0, abs=0.1)


@pytest.mark.parametrize(
    ("config", "said"),
    [
        (DecisionConfig(behaviour="navigate", linear_speed=0.1), ["linear_speed"]),
        (DecisionConfig(speed_limit=0.1, samples=400, turn="left"), ["speed_limit", "samples"]),
        (DecisionConfig(behaviour="navigate", speed_limit=0.1, begin="roam", state_dir="/x"), []),
    ],
)
def test_settings_that_the_behaviour_does_not_read_are_named(
    config: DecisionConfig, said: list[str]
) -> None:
    assert list(behaviours.unread(config)) == said


async def test_they_are_named_in_the_log_at_the_start(caplog: pytest.LogCaptureFixture) -> None:
    async with NodeBench(functools.partial(decision.run, DecisionConfig(samples=400))) as bench:
        await bench.ready()
    assert "samples has no effect: behaviour avoid does not read it" in caplog.messages
