"""Parameters: each one changes what the process does, and unknown ones are refused."""

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


async def avoid_twists(name: str, value: str, *, ahead: bool) -> list[Velocity | None]:
    """Return the velocities that `avoid` wants, before and after a parameter is set."""
    wanted, world = [], WorldModel(scan_ok=True, obstacle_ahead=False, sectors=MORE_ROOM_LEFT)
    async with NodeBench(functools.partial(decision.run, DecisionConfig())) as bench:
        for tick in (10, 20):
            for now, seen in ((tick, False), (tick + 5, ahead)):  # a new turn each time
                bench.send(STATE, state(now))
                here = replace(world, boot=7, tick=now, basis=now, obstacle_ahead=seen)
                bench.send(WORLD, here)
            wanted.append(bench.sent(INTENT)[-1].twist)
            bench.bus.params.change(name, value)
    return wanted


async def max_linear_speed() -> None:
    assert await avoid_twists("max_linear_speed", "0.05", ahead=False) == [
        Velocity(linear_x=0.2),
        Velocity(linear_x=0.05),
    ]


async def max_angular_speed() -> None:
    assert await avoid_twists("max_angular_speed", "0.3", ahead=True) == [
        Velocity(angular_z=-0.5),
        Velocity(angular_z=-0.3),
    ]


async def turn() -> None:
    assert await avoid_twists("turn", "clearer", ahead=True) == [
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
    """With more inflation it passes a pillar beside its straight path at a larger distance."""
    near, far = [
        await drive_with({"inflation": value}, at=(1.2, 1.6, 0.0), goal=(3.8, 1.6), cells=PILLAR)
        for value in ("0.1", "1.5")
    ]
    assert far.closest > near.closest + 0.05


async def aggressiveness() -> None:
    """With less aggressiveness it gains less speed from scan to scan."""
    gains = []
    for value in ("0", "0.5"):
        plane = await drive_with({"aggressiveness": value}, at=(1.2, 1.6, 0.0), goal=(2.6, 1.6))
        wanted = [one.twist.linear_x for one in plane.intents if one.twist]
        gains.append(max(after - before for before, after in pairwise(wanted)))
    assert 0.0 < gains[0] < 0.6 * gains[1]


async def drive_with(
    changes: dict[str, str],
    at: tuple[float, float, float],
    goal: tuple[float, float],
    cells: Cells = HALL,
) -> Plane:
    """Set parameters, drive to a goal, and return the robot."""
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


# (behaviour, parameter) -> a check that it has an effect
CHECKS: dict[tuple[str, str], Callable[[], Awaitable[None]]] = {
    ("avoid", "max_linear_speed"): max_linear_speed,
    ("avoid", "max_angular_speed"): max_angular_speed,
    ("avoid", "turn"): turn,
    ("navigate", "max_linear_speed"): route_speed,
    ("navigate", "inflation"): inflation,
    ("navigate", "aggressiveness"): aggressiveness,
}


@pytest.mark.parametrize("which", CHECKS, ids=" ".join)
async def test_every_parameter_of_a_behaviour_has_an_effect(
    which: tuple[str, str],
) -> None:
    await CHECKS[which]()


def test_every_parameter_of_a_behaviour_is_tested() -> None:
    parameters = {
        (name, param) for name in behaviours.SHIPPED for param in behaviours.load(name).PARAMS
    }
    assert parameters == set(CHECKS)


async def test_the_log_level_can_be_set(root_level: None) -> None:
    await log_level()


@pytest.mark.parametrize(
    ("behaviour", "foreign", "known"),
    [
        ("navigate", "max_angular_speed", "max_linear_speed, inflation, aggressiveness"),
        ("navigate", "turn", "max_linear_speed, inflation, aggressiveness"),
        ("avoid", "samples", "max_linear_speed, max_angular_speed, turn"),
    ],
)
async def test_a_parameter_of_another_behaviour_is_refused_with_the_known_ones(
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


def test_a_new_speed_limit_keeps_the_obstacles_seen_before() -> None:
    """The path still leads round a wall that no beam hits any more, so it is longer."""
    drive = Drive(WAFFLE, Goal(x=3.0, y=0.0), wall((1.0, -1.0), (1.0, 1.0)))
    seen = drive.request()
    unseen = dataclasses.replace(seen, hits=np.empty((0, 2)))
    drive.planner.plan(seen)
    drive.planner.configure(WAFFLE, structs.replace(QUICK, linear_speed=0.2))
    assert drive.planner.plan(unseen).remaining > 3.5
    assert LocalPlanner(WAFFLE, QUICK).plan(unseen).remaining == pytest.approx(3.0, abs=0.1)


async def test_a_planner_obeys_a_speed_limit_of_the_body_set_during_the_drive() -> None:
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
def test_unknown_or_invalid_settings_of_a_behaviour_are_refused(
    behaviour: str, settings: dict[str, Any], problem: str
) -> None:
    config = DecisionConfig(behaviour=behaviour, settings=settings)
    with pytest.raises(ConfigError, match=f"^decision.settings of {behaviour}: {problem}"):
        behaviours.check(config)


OLD_YAML = """
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
def test_yaml_with_old_names_means_the_same(
    tmp_path: Path, behaviour: str, settings: dict[str, Any]
) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text(OLD_YAML.format(behaviour=behaviour))
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
