"""Parameters: what can be set changes what the process does, and nothing else can be set."""

import dataclasses
import functools
import logging
from collections.abc import Awaitable, Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import structs
from msgspec.structs import replace

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.brain import WorldModel
from gigabrain_schemas.tasks import Goal, GoalRequest
from gigabrain_schemas.topics import GOAL, INTENT, STATE, WORLD
from gigabrain_zenoh.config.settings import DecisionConfig
from gigabrain_zenoh.decision import behaviours
from gigabrain_zenoh.decision import node as decision
from gigabrain_zenoh.errors import ConfigError, Refused
from gigabrain_zenoh.geometry.body_settings import restricted
from gigabrain_zenoh.launch.deployment import load_deployment
from gigabrain_zenoh.navigation.local_planner import LocalPlanner
from gigabrain_zenoh.runtime.services import LOG_LEVEL, serve_params
from gigabrain_zenoh.testing.in_memory import NodeBench
from gigabrain_zenoh.testing.samples import state
from tests.node.plane import Cells, Plane, drawn
from tests.unit.navigation.drives import QUICK, WAFFLE, Drive, wall

HALL = drawn("####################\n" + "#..................#\n" * 12 + "####################")
PILLAR = HALL.copy()
PILLAR[22:24, 46:50] = 100
MORE_ROOM_LEFT = (0.8, 3.0, 3.0, 1.0, 1.0, 1.0)


@pytest.fixture
def root_level() -> Iterator[None]:
    before = logging.getLogger().level
    yield
    logging.getLogger().setLevel(before)


async def wants(name: str, value: str, *, ahead: bool) -> list[Velocity | None]:
    """Return the velocities that `avoid` wants, before and after a parameter is set."""
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


async def max_linear_speed() -> None:
    assert await wants("max_linear_speed", "0.05", ahead=False) == [
        Velocity(linear_x=0.2),
        Velocity(linear_x=0.05),
    ]


async def max_angular_speed() -> None:
    assert await wants("max_angular_speed", "0.3", ahead=True) == [
        Velocity(angular_z=-0.5),
        Velocity(angular_z=-0.3),
    ]


async def turn() -> None:
    assert await wants("turn", "clearer", ahead=True) == [
        Velocity(angular_z=-0.5),
        Velocity(angular_z=0.5),
    ]


async def route_speed() -> None:
    async with Plane(HALL, at=(0.6, 1.6, 0.0)) as plane:
        await plane.go(0.2)
        params = plane.bench.bus.params
        await plane.ask(GOAL, GoalRequest(x=4.2, y=1.6))
        await plane.go(3.0)
        assert plane.velocity.linear_x > 0.2
        assert params.change("max_linear_speed", "0.05") == ("null", "0.05")
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
        assert params.change("max_linear_speed", "null") == ("0.05", "null")
        await plane.go(1.5)
        assert plane.velocity.linear_x > 0.2


async def inflation() -> None:
    """Past a pillar beside its straight way it keeps more room."""
    near, far = [
        await passing({"inflation": value}, at=(1.2, 1.6, 0.0), goal=(3.8, 1.6), cells=PILLAR)
        for value in ("0.1", "1.5")
    ]
    assert far.closest > near.closest + 0.05


async def aggressiveness() -> None:
    """Gently it gains less speed from scan to scan."""
    gains = []
    for value in ("0", "0.5"):
        plane = await passing({"aggressiveness": value}, at=(1.2, 1.6, 0.0), goal=(2.6, 1.6))
        wanted = [one.twist.linear_x for one in plane.intents if one.twist]
        gains.append(max(after - before for before, after in pairwise(wanted)))
    assert 0.0 < gains[0] < 0.6 * gains[1]


async def passing(
    changes: dict[str, str],
    at: tuple[float, float, float],
    goal: tuple[float, float],
    cells: Cells = HALL,
) -> Plane:
    """The robot after it has driven to a goal, with parameters set before."""
    async with Plane(cells, at=at) as plane:
        await plane.go(0.2)
        for name, value in changes.items():
            plane.bench.bus.params.change(name, value)
        await plane.ask(GOAL, GoalRequest(x=goal[0], y=goal[1]))
        await plane.until("succeeded", seconds=60.0)
    return plane


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
    ("avoid", "max_linear_speed"): max_linear_speed,
    ("avoid", "max_angular_speed"): max_angular_speed,
    ("avoid", "turn"): turn,
    ("navigate", "max_linear_speed"): route_speed,
    ("navigate", "inflation"): inflation,
    ("navigate", "aggressiveness"): aggressiveness,
}


@pytest.mark.parametrize("which", OBEYED, ids=" ".join)
async def test_every_parameter_of_a_behaviour_changes_what_the_robot_does(
    which: tuple[str, str],
) -> None:
    await OBEYED[which]()


def test_no_behaviour_has_a_parameter_without_such_a_test() -> None:
    there = {(name, param) for name in behaviours.SHIPPED for param in behaviours.load(name).PARAMS}
    assert there == set(OBEYED)


async def test_the_log_level_of_a_process_is_obeyed(root_level: None) -> None:
    await log_level()


@pytest.mark.parametrize(
    ("behaviour", "foreign", "known"),
    [
        ("navigate", "max_angular_speed", "max_linear_speed, inflation, aggressiveness"),
        ("navigate", "turn", "max_linear_speed, inflation, aggressiveness"),
        ("avoid", "samples", "max_linear_speed, max_angular_speed, turn"),
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
    seen = drive.request()
    unseen = dataclasses.replace(seen, hits=np.empty((0, 2)))
    drive.planner.plan(seen)
    drive.planner.configure(WAFFLE, structs.replace(QUICK, linear_speed=0.2))
    assert drive.planner.plan(unseen).remaining > 3.5
    assert LocalPlanner(WAFFLE, QUICK).plan(unseen).remaining == pytest.approx(3.0, abs=0.1)


async def test_a_planner_obeys_a_body_that_has_become_slower_on_its_way() -> None:
    async with Plane(HALL, at=(0.6, 1.6, 0.0)) as plane:
        await plane.go(0.2)
        await plane.ask(GOAL, GoalRequest(x=4.2, y=1.6))
        await plane.go(3.0)
        assert plane.velocity.linear_x > 0.2
        plane.description = restricted(plane.description, {"max_linear_speed": 0.05})
        await plane.go(2.0)
        assert 0.03 < plane.velocity.linear_x < 0.055
        assert plane.status.current
        assert plane.status.current.state == "active"


@pytest.mark.parametrize(
    ("behaviour", "settings", "problem"),
    [
        ("navigate", {"turn": "left"}, "unknown field 'turn'; known: "),
        ("avoid", {"samples": 400}, "unknown field 'samples'; known: "),
        ("avoid", {"turn": "up"}, "turn: expected "),
    ],
)
def test_settings_that_the_behaviour_does_not_have_are_refused(
    behaviour: str, settings: dict[str, Any], problem: str
) -> None:
    config = DecisionConfig(behaviour=behaviour, settings=settings)
    with pytest.raises(ConfigError, match=f"^decision.settings of {behaviour}: {problem}"):
        behaviours.check(config)


OLD = """
decision:
  behaviour: {behaviour}
  linear_speed: 0.1
  speed_limit: 0.3
  turn: left
  begin: roam
  unknown: allow
"""


@pytest.mark.parametrize(
    ("behaviour", "settings"),
    [
        ("avoid", {"max_linear_speed": 0.1, "turn": "left"}),
        (
            "navigate",
            {"max_linear_speed": 0.3, "start": "explore", "unknown_space": "allow"},
        ),
    ],
)
def test_yaml_with_the_old_words_means_the_same(
    tmp_path: Path, behaviour: str, settings: dict[str, Any]
) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text(OLD.format(behaviour=behaviour))
    config = load_deployment(path).decision
    assert config == DecisionConfig(behaviour=behaviour, settings=settings)
    behaviours.check(config, path)


def test_a_wrong_setting_of_a_behaviour_is_refused_with_file_and_line(tmp_path: Path) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text("decision:\n  behaviour: navigate\n  settings:\n    start: roam\n")
    with pytest.raises(ConfigError, match=r"robot\.yaml:4: start: expected "):
        behaviours.check(load_deployment(path).decision, path)


async def test_parameters_with_the_old_names_mean_the_same() -> None:
    async with NodeBench(functools.partial(decision.run, DecisionConfig())) as bench:
        await bench.ready()
        assert bench.bus.params.change("linear_speed", "0.1") == ("0.2", "0.1")
        assert "linear_speed" not in {param.name for param in bench.bus.params.all()}
