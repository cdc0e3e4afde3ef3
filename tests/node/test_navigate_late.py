"""Navigation with late scans and slow plans."""

import time

import numpy as np
import pytest

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.brain import WorldModel
from gigabrain_schemas.safety import SafetyState, SpeedCaps
from gigabrain_schemas.tasks import GoalRequest
from gigabrain_schemas.topics import GOAL, MAP
from gigabrain_zenoh.decision import route_schedule
from gigabrain_zenoh.decision.context import ContextSource
from gigabrain_zenoh.decision.navigator import NO_ROUTE
from gigabrain_zenoh.decision.route import Route, RoutePlanner, RouteRequest
from gigabrain_zenoh.decision.zones import ZoneSource
from gigabrain_zenoh.testing.in_memory import Net
from gigabrain_zenoh.testing.samples import BOOT, state
from tests.node.plane import ROOM, Plane, as_map, drawn

CELLS = drawn(ROOM)
ZERO_VELOCITY = Velocity()


async def test_it_stands_while_its_scans_are_too_late() -> None:
    async with Plane(CELLS) as plane:
        await plane.go(0.2)
        await plane.ask_at_once(GOAL, GoalRequest(x=4.0, y=0.8))
        await plane.go(1.5)
        assert plane.travelled > 0.05
        plane.late_ticks = 11
        await plane.go(0.5)
        reasons = set[str]()
        for _ in range(50):
            await plane.go(0.02)
            assert plane.intent.twist == ZERO_VELOCITY
            reasons.add(plane.intent.reason)
        # a scan becomes stale before the next one arrives
        assert reasons == {
            "waiting: this host is too busy: its newest scan is 0.22 s old",
            "waiting: perception is silent",
        }
        plane.late_ticks = 0
        await plane.go(2.0)
        assert plane.intent.reason.startswith("going to (4.00, 0.80): ")


async def test_it_drives_more_slowly_with_a_reason_while_its_scans_are_late() -> None:
    async with Plane(CELLS, at=(0.6, 1.5, 0.0)) as plane:
        await plane.go(0.2)
        await plane.ask_at_once(GOAL, GoalRequest(x=4.5, y=1.5))
        await plane.go(1.5)
        assert "busy" not in plane.intent.reason
        in_time = await max_speed(plane, 1.5)
        plane.late_ticks = 7
        await plane.go(1.0)
        assert plane.intent.reason.endswith("; slower: this host is late by 0.10 s")
        late = await max_speed(plane, 1.5)
        plane.late_ticks = 0
        await plane.go(3.0)
        assert "busy" not in plane.intent.reason
        assert in_time > 0.24
        assert 0.1 < late < 0.23
        await plane.until("succeeded", seconds=60)


async def max_speed(plane: Plane, seconds: float) -> float:
    speeds = []
    for _ in range(round(seconds * 50)):
        await plane.go(0.02)
        speeds.append(plane.velocity.linear_x)
    return max(speeds)


LARGE_MAP = np.pad(CELLS, ((0, 300), (0, 300)), constant_values=100)


async def ticks_of_routes(monkeypatch: pytest.MonkeyPatch, planning_s: float) -> list[int]:
    """Return the ticks of the first route and of the route to another goal."""
    plan = RoutePlanner.plan

    def slowly(planner: RoutePlanner, request: RouteRequest) -> Route:
        time.sleep(planning_s)
        return plan(planner, request)

    monkeypatch.setattr(RoutePlanner, "plan", slowly)
    monkeypatch.setattr(route_schedule, "PATIENCE_S", 30.0)
    ticks = []
    async with Plane(LARGE_MAP) as plane:
        await plane.go(0.2)
        for x in (4.0, 1.5):
            await plane.ask_at_once(GOAL, GoalRequest(x=x, y=0.8))
            while not plane.intent.reason.startswith(f"going to ({x:.2f}, 0.80): "):
                await plane.go(0.02)
            ticks.append(plane.tick)
    monkeypatch.setattr(RoutePlanner, "plan", plan)
    return ticks


async def test_a_route_in_a_large_map_applies_at_the_same_tick_for_any_planning_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    quick = await ticks_of_routes(monkeypatch, 0.0)
    assert await ticks_of_routes(monkeypatch, 0.1) == quick
    assert quick[0] - 10 == 15


async def test_planning_in_a_huge_map_does_not_delay_the_first_plan_in_the_next_map() -> None:
    huge = np.zeros((2800, 2800), np.int8)
    async with Plane(CELLS) as plane:
        await plane.go(0.2)
        plane.bench.send(MAP, as_map(huge, plane.tick, plane.boot))
        await plane.go(0.1)
        await plane.ask_at_once(GOAL, GoalRequest(x=4.0, y=0.8))
        await plane.go(0.2)
        assert plane.intent.reason == NO_ROUTE.reason
        began = plane.tick
        plane.bench.send(MAP, as_map(CELLS, plane.tick, plane.boot))
        while plane.intent.reason == NO_ROUTE.reason:
            await plane.go(0.02)
        assert plane.tick - began <= 25


async def test_it_plans_with_the_pose_and_speed_of_a_late_scan() -> None:
    net = Net()
    source = ContextSource(net.one, ZoneSource(net.one))
    states = [state(tick, v=0.01 * tick, pose=(0.1 * tick, 0.0, 0.0)) for tick in range(1, 8)]
    for one in states:
        source.observe(one)
    seen = WorldModel(scan_ok=True, obstacle_ahead=False, boot=BOOT, tick=5, basis=5)
    now = source.at_scan(states[-1], seen, None)
    assert (now.pose.x, now.velocity.linear_x) == (0.5, 0.05)
    assert now.late_ticks == 2
    assert now.may_reverse
    caps = SpeedCaps(backward=0.0)
    held = source.at_scan(states[-1], seen, SafetyState(verdict="slow", caps=caps))
    assert not held.may_reverse
    await net.one.close()
    await net.two.close()
