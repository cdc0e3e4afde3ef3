"""Zones and places: decision respects them in a flat world, in fake time."""

import functools
import math

import numpy as np
import pytest

from gigabrain_schemas.tasks import GoalRequest, MissionRequest
from gigabrain_schemas.topics import GOAL, INTENT, MISSION, TASK, ZONES
from gigabrain_schemas.zones import Place, Zone, Zones
from gigabrain_zenoh.config.settings import DecisionConfig
from gigabrain_zenoh.decision import node as decision
from gigabrain_zenoh.geometry import polygon
from gigabrain_zenoh.geometry.se2 import transform
from gigabrain_zenoh.recording.process_replay import with_requests
from gigabrain_zenoh.runtime.replay import record, replay
from gigabrain_zenoh.testing.samples import WAFFLE
from tests.node.plane import ROOM, Plane, drawn
from tests.node.test_record_replay import unstamped

CELLS = drawn(ROOM)  # 5.0 x 2.0 m
HALL = np.zeros((120, 160), np.int8)  # 8 x 6 m
HALL[[0, -1]] = HALL[:, [0, -1]] = 100


def box(name: str, x: float, y: float, to_x: float, to_y: float, **more: float) -> Zone:
    kind = "speed" if "max_speed" in more else "keepout"
    return Zone(name=name, kind=kind, points=((x, y), (to_x, y), (to_x, to_y), (x, to_y)), **more)


def send_zones(plane: Plane, *zones: Zone, places: tuple[Place, ...] = (), loaded: int = 0) -> None:
    message = Zones(
        zones=zones, places=places, boot=plane.boot, tick=plane.tick, maps_loaded=loaded
    )
    plane.bench.send(ZONES, message)


def corners(plane: Plane) -> np.ndarray:
    return transform(np.array((plane.x, plane.y, plane.yaw)), np.array(WAFFLE.footprint))


async def measure_drive(plane: Plane, zone: Zone, seconds: float) -> tuple[float, float]:
    """Return the body's minimum distance to a zone [m], and its maximum speed in it [m/s]."""
    shape, min_distance, max_speed = np.array(zone.points), math.inf, 0.0
    for _ in range(round(seconds * 10)):
        await plane.go(0.1)
        distance = float(polygon.distance(shape, corners(plane)).min())
        min_distance = min(min_distance, distance)
        max_speed = max(max_speed, plane.velocity.linear_x) if distance == 0.0 else max_speed
        if not plane.status.current and plane.status.done:
            break
    return min_distance, max_speed


@pytest.mark.parametrize("order", [1, -1])
async def test_it_drives_round_a_keep_out_zone(order: int) -> None:
    lab = box("lab", 3.0, 1.5, 5.0, 6.0)
    lab = Zone(name="lab", kind="keepout", points=lab.points[::order])
    async with Plane(HALL, at=(1.0, 3.5, 0.0)) as plane:
        await plane.go(0.2)
        send_zones(plane, lab)
        await plane.go(0.2)
        reply = await plane.ask(GOAL, GoalRequest(x=7.0, y=3.5))
        assert reply.ok, reply.text
        least, _ = await measure_drive(plane, lab, 90)
        assert plane.status.done[0].state == "succeeded"
        assert least > 0.0


async def test_a_goal_in_a_keep_out_zone_is_refused_with_its_name() -> None:
    async with Plane(HALL, at=(1.0, 3.0, 0.0)) as plane:
        send_zones(plane, box("lab", 4.0, 2.0, 6.0, 4.0))
        await plane.go(0.4)
        reply = await plane.ask(GOAL, GoalRequest(x=5.0, y=3.0))
        assert not reply.ok
        assert reply.text.startswith("the goal lies in keep-out zone 'lab'; nearest reachable")
        reply = await plane.ask(GOAL, GoalRequest(x=3.95, y=3.0))
        assert reply.ok is False
        assert reply.text.startswith("the goal is 0.05 m from keep-out zone 'lab'; the body needs")


async def test_a_goal_behind_zones_is_refused_with_the_zone_in_the_way() -> None:
    async with Plane(HALL, at=(1.0, 3.0, 0.0)) as plane:
        send_zones(plane, box("wall", 4.0, -1.0, 4.5, 9.0))
        await plane.go(0.4)
        reply = await plane.ask(GOAL, GoalRequest(x=7.0, y=3.0))
        assert not reply.ok
        assert reply.text.startswith(
            "no path leads to the goal without entering keep-out zone 'wall'; nearest reachable"
        )


async def test_a_new_zone_over_the_goal_fails_the_task_with_the_reason() -> None:
    async with Plane(HALL, at=(1.0, 3.0, 0.0)) as plane:
        await plane.go(0.2)
        assert (await plane.ask(GOAL, GoalRequest(x=7.0, y=3.0))).ok
        await plane.go(3.0)
        send_zones(plane, box("lab", 6.0, 2.0, 7.9, 4.0))
        await plane.until("failed", seconds=2)
        assert plane.status.done[0].reason.startswith("the goal lies in keep-out zone 'lab'")
        assert plane.x < 6.0


async def test_a_new_zone_on_the_path_is_avoided() -> None:
    async with Plane(HALL, at=(1.0, 3.0, 0.0)) as plane:
        await plane.go(0.2)
        await plane.ask(GOAL, GoalRequest(x=7.0, y=3.0))
        await plane.go(5.0)
        ahead = box("spill", plane.x + 0.5, 2.5, plane.x + 1.5, 3.5)
        send_zones(plane, ahead)
        least, _ = await measure_drive(plane, ahead, 60)
        assert plane.status.done[0].state == "succeeded"
        assert least > 0.0


@pytest.mark.slow
async def test_a_robot_inside_a_zone_leaves_it_by_the_shortest_way() -> None:
    lab = box("lab", 1.0, 1.0, 6.0, 5.0)
    async with Plane(HALL, at=(2.0, 3.0, 0.0)) as plane:
        send_zones(plane, lab)
        await plane.go(0.4)
        assert plane.travelled == 0.0  # it stands without a goal
        reply = await plane.ask(GOAL, GoalRequest(x=7.0, y=3.0))
        assert reply.ok, reply.text
        most_x, inside = 0.0, True
        while inside:
            await plane.go(0.1)
            inside = bool(polygon.distance(np.array(lab.points), corners(plane)).min() == 0.0)
            most_x = max(most_x, plane.x)
        assert plane.x < 1.0  # not through the zone
        assert most_x < 2.3
        least, _ = await measure_drive(plane, lab, 90)
        assert plane.status.done[0].state == "succeeded"
        assert least > 0.0


@pytest.mark.slow
async def test_a_robot_leaving_a_zone_sees_the_obstacles_in_it() -> None:
    cells = HALL.copy()
    cells[40:80, 30:32] = 100  # a wall between the robot and the nearest edge
    async with Plane(cells, at=(2.0, 3.0, 0.0)) as plane:
        send_zones(plane, box("lab", 1.0, 0.1, 6.0, 5.9))
        await plane.go(0.4)
        assert (await plane.ask(GOAL, GoalRequest(x=7.0, y=3.0))).ok
        await plane.until("succeeded", seconds=120)
        assert plane.closest > 0.1


async def test_zones_over_the_whole_map_leave_no_goal() -> None:
    async with Plane(HALL, at=(2.0, 3.0, 0.0)) as plane:
        send_zones(plane, box("all", -100.0, -1e5, 1e5, 1e5))
        await plane.go(0.4)
        reply = await plane.ask(GOAL, GoalRequest(x=7.0, y=3.0))
        assert reply.text.startswith("the goal lies in keep-out zone 'all'")
        send_zones(plane)
        await plane.go(0.4)
        assert (await plane.ask(GOAL, GoalRequest(x=7.0, y=3.0))).ok


@pytest.mark.slow
async def test_the_body_obeys_the_limit_of_a_speed_zone() -> None:
    ramp = box("ramp", 3.0, 0.0, 5.0, 6.0, max_speed=0.1)
    async with Plane(HALL, at=(1.0, 3.0, 0.0)) as plane:
        send_zones(plane, ramp)
        await plane.go(0.4)
        await plane.ask(GOAL, GoalRequest(x=7.0, y=3.0))
        _, fastest = await measure_drive(plane, ramp, 120)
        assert plane.status.done[0].state == "succeeded"
        assert 0.08 < fastest < 0.106
        reasons = {one.reason for one in plane.intents}
        assert any("at most 0.10 m/s: speed zone 'ramp'" in reason for reason in reasons)


@pytest.mark.slow
async def test_a_one_way_lane_is_used_forwards_and_bypassed_backwards() -> None:
    lane = Zone(name="lane", kind="one_way", points=((2.0, 3.0), (6.0, 3.0)), lane_width=2.0)

    async def offset_from_lane(start: float, goal: float) -> float:
        """Drive and return the distance to the middle of the lane at half its length [m]."""
        async with Plane(HALL, at=(start, 3.0, 0.0)) as plane:
            send_zones(plane, lane)
            await plane.go(0.4)
            assert (await plane.ask(GOAL, GoalRequest(x=goal, y=3.0))).ok
            before, off = plane.x, math.nan
            while plane.status.current or not plane.status.done:
                await plane.go(0.1)
                if (before - 4.0) * (plane.x - 4.0) <= 0.0 and math.isnan(off):
                    off = abs(plane.y - 3.0)
            assert plane.status.done[0].state == "succeeded"
            return off

    assert await offset_from_lane(1.0, 7.0) < 0.3
    assert await offset_from_lane(7.0, 1.0) > 0.85  # it may cut a corner


async def test_a_goal_against_the_only_lane_is_refused_with_its_name() -> None:
    lane = Zone(name="door", kind="one_way", points=((3.0, 3.0), (5.0, 3.0)), lane_width=6.0)
    async with Plane(HALL, at=(7.0, 3.0, 0.0)) as plane:
        send_zones(plane, lane)
        await plane.go(0.4)
        reply = await plane.ask(GOAL, GoalRequest(x=1.0, y=3.0))
        assert not reply.ok
        assert "against one-way lane 'door'" in reply.text


async def test_named_places_are_goals_and_parts_of_missions() -> None:
    kitchen = Place(name="kitchen", x=3.0, y=2.0, yaw=1.5)
    mission = "places: {here: [1.0, 3.0]}\ndo: [{goto: kitchen}, {goto: here}]"
    async with Plane(HALL, at=(1.0, 3.0, 0.0)) as plane:
        await plane.go(0.2)
        reply = await plane.ask(GOAL, GoalRequest(place="kitchen"))
        assert (reply.ok, reply.text) == (False, "no place 'kitchen'; known: none")
        send_zones(plane, places=(kitchen, Place(name="dock", x=1.0, y=1.0)))
        await plane.go(0.2)
        reply = await plane.ask(GOAL, GoalRequest(place="kichen"))
        assert reply.text == "no place 'kichen'; did you mean 'kitchen'? known: dock, kitchen"
        assert (await plane.ask(GOAL, GoalRequest(place="kitchen"))).ok
        await plane.until("succeeded", seconds=60)
        assert math.hypot(plane.x - 3.0, plane.y - 2.0) < 0.15
        assert abs(plane.yaw - 1.5) < 0.15
        assert plane.status.done[0].label == "kitchen (3.00, 2.00, 1.50 rad)"
        assert (await plane.ask(MISSION, MissionRequest(mission=mission))).ok
        send_zones(plane)  # the mission keeps its copy of the place
        await plane.until("succeeded", seconds=90)
        assert math.hypot(plane.x - 1.0, plane.y - 3.0) < 0.15
        reply = await plane.ask(MISSION, MissionRequest(mission=mission, label="round"))
        assert reply.text == "round:2: do[0].goto: no place 'kitchen'; known: here"


async def test_another_map_cancels_all_tasks() -> None:
    async with Plane(HALL, at=(1.0, 3.0, 0.0)) as plane:
        send_zones(plane, loaded=1)
        await plane.go(0.2)
        await plane.ask(GOAL, GoalRequest(x=7.0, y=3.0))
        await plane.go(1.0)
        send_zones(plane, loaded=2)
        await plane.until("cancelled", seconds=2)


async def test_a_replay_with_changed_zones_gives_the_same_intents() -> None:
    async with Plane(HALL, at=(1.0, 3.0, 0.0)) as plane:
        events = record(plane.bench.network, plane.bench.clock)
        await plane.go(0.4)
        send_zones(plane, places=(Place(name="far", x=7.0, y=3.0),))
        await plane.go(0.2)
        assert (await plane.ask(GOAL, GoalRequest(place="far", source="ann"))).ok
        await plane.go(3.0)
        before = plane.status.path
        slow = box("slow", 1.5, 0.0, 2.5, 6.0, max_speed=0.1)
        send_zones(plane, box("spill", 3.0, 2.0, 4.0, 4.0), slow)
        await plane.go(4.0)
        assert plane.status.path != before
        assert "speed zone 'slow'" in plane.intent.reason
    then = [unstamped(key, data) for _, key, data in events if key == INTENT.key]
    inputs = with_requests([event for event in events if event[1] not in (INTENT.key, TASK.key)])
    assert ZONES.key in {key for _, key, _ in inputs}
    node = functools.partial(decision.run, DecisionConfig(behaviour="navigate"))
    now = [unstamped(key, data) for key, data in await replay(node, inputs) if key == INTENT.key]
    assert now == then
