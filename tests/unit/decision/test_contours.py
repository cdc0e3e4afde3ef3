"""Contours of cameras in decision: the behaviour avoid, routes, and impossible ones."""

import functools
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_schemas.base import Pose
from gigabrain_schemas.brain import Contour, WorldModel
from gigabrain_schemas.tasks import Goal
from gigabrain_schemas.topics import BODY, INTENT, STATE, WORLD
from gigabrain_zenoh.config.settings import DecisionConfig
from gigabrain_zenoh.decision import node as decision
from gigabrain_zenoh.decision.behaviours import DriveCommand
from gigabrain_zenoh.decision.contours import REFUSED, with_contours
from gigabrain_zenoh.decision.route import RoutePlanner, RouteRequest
from gigabrain_zenoh.testing.in_memory import NodeBench
from gigabrain_zenoh.testing.samples import WAFFLE, body, state
from tests.unit.navigation.grids import empty, grid_of

SEEING = replace(WAFFLE, body_height=0.2)
FREE = WorldModel(scan_ok=True, obstacle_ahead=False, sectors=(None,) * 12)


def square(x: float, y: float, half: float = 0.1, **more: Any) -> Contour:
    low, high = (x - half, y - half), (x + half, y + half)
    corners = (low, (high[0], low[1]), high, (low[0], high[1]))
    return Contour(polygon=corners, bottom=more.pop("bottom", 0.0), top=more.pop("top", 0.5))


@pytest.mark.parametrize(
    ("contour", "ahead"),
    [
        (square(0.6, 0.0), True),  # in the cone
        (square(0.4, 0.2), True),  # in the strip that the body needs to turn
        (square(1.4, 0.0), False),
        (square(0.0, 1.0), False),
        (square(-0.6, 0.0), False),
        (square(0.6, 0.0, bottom=-0.2, top=-0.1), True),  # a hole
    ],
)
def test_a_contour_ahead_is_an_obstacle_ahead(contour: Contour, ahead: bool) -> None:
    assert with_contours(replace(FREE, contours=(contour,)), SEEING).obstacle_ahead is ahead


def test_the_nearer_of_scan_and_contours_counts() -> None:
    world = replace(FREE, contours=(square(0.6, 0.0),), distance_ahead=0.4, obstacle_ahead=True)
    assert with_contours(world, SEEING).distance_ahead == 0.4
    world = replace(world, distance_ahead=0.8)
    assert with_contours(world, SEEING).distance_ahead == pytest.approx(0.5, abs=0.01)


def test_sectors_include_contours() -> None:
    found = with_contours(replace(FREE, contours=(square(0.0, 1.0),)), SEEING).sectors
    assert found[3] == pytest.approx(0.9, abs=0.01)
    assert found[9] is None


def test_a_world_without_contours_stays_the_same_object() -> None:
    assert with_contours(FREE, SEEING) is FREE


def bench() -> NodeBench:
    return NodeBench(functools.partial(decision.run, DecisionConfig()))


def world(tick: int, *contours: Contour) -> WorldModel:
    return replace(FREE, contours=contours, boot=7, tick=tick, basis=tick)


async def decided(*contours: Contour) -> tuple[str, int]:
    """Return the action of `avoid` for these contours, and the number of refused contours."""
    async with bench() as node:
        node.send(BODY, body(SEEING))
        node.send(STATE, state(10))
        node.sent(INTENT)
        node.send(WORLD, world(10, *contours))
        (intent,) = node.sent(INTENT)
        return intent.reason.partition(" ")[0], node.bus.counters[REFUSED]


async def test_avoid_turns_away_from_an_obstacle_that_only_a_camera_sees() -> None:
    assert await decided() == ("forward", 0)
    assert await decided(square(0.6, 0.0)) == ("turning", 0)


async def test_a_contour_above_the_body_does_not_block_the_way() -> None:
    assert await decided(square(0.6, 0.0, bottom=0.15)) == ("turning", 0)
    assert await decided(square(0.6, 0.0, bottom=0.25)) == ("forward", 0)


async def test_impossible_contours_are_refused_and_counted() -> None:
    far = square(9e4, 0.0, 9e3)
    assert await decided(*(far,) * 128) == ("forward", 128)
    assert await decided(far, square(0.6, 0.0)) == ("turning", 1)


ROOM = empty(6.0, 4.0)
BARRIER = np.array(((2.9, 0.0), (3.1, 0.0), (3.1, 3.0), (2.9, 3.0)))  # a gap at its end


def route(planner: RoutePlanner, tick: int, *contours: np.ndarray) -> list[list[float]]:
    found = planner.plan(
        RouteRequest(
            tick=tick,
            command=DriveCommand(1, "goto", Goal(x=5.0, y=1.0)),
            here=Pose(x=1.0, y=1.0, yaw=0.0),
            grid=grid_of(ROOM),
            body=SEEING,
            feedback=None,
            seen=np.empty((0, 2)),
            contours=contours,
        )
    )
    assert found.points is not None
    return found.points.tolist()


def test_a_route_leads_around_contours_until_they_are_gone() -> None:
    planner = RoutePlanner()
    assert max(y for _, y in route(planner, 1)) < 1.1
    assert max(y for _, y in route(planner, 26, BARRIER)) > 3.1
    assert max(y for _, y in route(planner, 60 * 50 + 27)) < 1.1


def test_routes_without_contours_are_reproducible() -> None:
    one, other = RoutePlanner(), RoutePlanner()
    assert [route(one, tick) for tick in (1, 26)] == [route(other, tick) for tick in (1, 26)]
