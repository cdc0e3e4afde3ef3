"""Decision forgets blocking hits at a restart, and keeps zones until newer ones apply."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from gigabrain_schemas.base import Pose
from gigabrain_schemas.tasks import Goal
from gigabrain_schemas.zones import Zone, Zones
from gigabrain_zenoh.decision.behaviours import DriveCommand
from gigabrain_zenoh.decision.route import Route, RouteFeedback, RoutePlanner, RouteRequest
from gigabrain_zenoh.decision.zones import KEPT, ZoneSource
from tests.unit.navigation.drives import WAFFLE
from tests.unit.navigation.grids import empty, grid_of

CORRIDOR = empty(6.0, 2.0)
PEOPLE = np.array([[3.0, y] for y in np.arange(0.05, 2.0, 0.05)])  # across the corridor
CORNERS = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0))


def test_blocking_hits_are_forgotten_when_the_driver_restarts() -> None:
    planner = RoutePlanner()

    def ask(tick: int, seen: Any = None, blocked: Route | None = None) -> Route:
        return planner.plan(
            RouteRequest(
                tick=tick,
                command=DriveCommand(1, "goto", Goal(x=5.0, y=1.0)),
                here=Pose(x=1.0, y=1.0, yaw=0.0),
                grid=grid_of(CORRIDOR),
                body=WAFFLE,
                feedback=blocked and RouteFeedback(version=blocked.version, blocked=True),
                seen=np.empty((0, 2)) if seen is None else seen,
                held_ticks=0,
                slowed_by="",
                walkers=np.empty((0, 3)),
            )
        )

    def cost() -> float:
        assert planner._bare is not None
        return float(planner._bare.cost[10, 30])

    first = ask(180_000)
    free = cost()
    ask(180_001, PEOPLE, first)
    assert cost() > free
    ask(10)
    assert cost() == free


def source() -> tuple[ZoneSource, Callable[[Zones], None]]:
    """Return a zone source, and the function that passes messages to it."""
    receives: list[Callable[[Zones], None]] = []
    bus = SimpleNamespace(latest=lambda _topic, on_new: receives.append(on_new))
    return ZoneSource(cast("Any", bus)), receives[0]


def zones(tick: int, count: int) -> Zones:
    named = (Zone(name=f"z{k}", kind="keepout", points=CORNERS) for k in range(count))
    return Zones(boot=7, tick=tick, zones=tuple(named))


def test_changed_zones_apply_from_the_next_scan_on() -> None:
    known, receive = source()
    receive(zones(900, 1))
    for count in range(2, KEPT):
        receive(zones(1000 + count, count))
        assert len(known.at(7, 1000).zones) == 1
        assert known.maps_loaded(7, 1000) == 0
    assert len(known.at(7, 1002).zones) == 1
    assert len(known.at(7, 1003).zones) == 2


def test_a_scan_has_zones_after_more_changes_than_are_stored() -> None:
    known, receive = source()
    for count in range(2 * KEPT):
        receive(zones(1000 + count, count))
    assert len(known.at(7, 1000).zones) == KEPT


def test_before_the_first_zones_there_are_none() -> None:
    known, receive = source()
    receive(zones(1001, 1))
    assert (known.at(7, 1000).zones, known.maps_loaded(7, 1000)) == ((), None)
