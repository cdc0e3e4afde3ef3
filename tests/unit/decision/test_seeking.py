"""Places in front of objects and tags, and the viewpoints of a search."""

import math

import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import Camera
from gigabrain_zenoh.decision.behaviours import DriveCommand, Target
from gigabrain_zenoh.decision.route import Route, RouteFeedback, RoutePlanner, RouteRequest
from gigabrain_zenoh.decision.seeking import LookAround, place_before
from gigabrain_zenoh.navigation.costmap import Costmap, costmap, inflation
from gigabrain_zenoh.navigation.grid_search import GridSearch
from gigabrain_zenoh.testing.samples import ARMED, WAFFLE, WRIST
from tests.unit.navigation.grids import empty, grid_of

SEEING = replace(
    WAFFLE, cameras=(Camera(name="front", width=320, height=240, field_of_view=1.047, depth=True),)
)
ROOM = empty(6.0, 4.0)
HERE = Pose(x=1.0, y=1.0, yaw=0.0)
FRONT_M = 0.075


def costs_of(cells: np.ndarray) -> Costmap:
    return costmap(grid_of(cells), inflation(WAFFLE))


def can(x: float, y: float) -> Target:
    return Target(name="can 1", x=x, y=y, radius=0.035)


def off(place: object, target: Target) -> tuple[float, float]:
    """Return the distance of a target [m], and the absolute angle from the heading to it [rad]."""
    x, y, yaw = place.x, place.y, place.yaw  # type: ignore[attr-defined]
    turn = math.atan2(target.y - y, target.x - x) - yaw
    return math.hypot(target.x - x, target.y - y), abs(math.remainder(turn, math.tau))


def test_it_stands_on_the_near_side_of_an_object_and_faces_it() -> None:
    target = can(4.0, 1.0)
    place = place_before(costs_of(ROOM), WAFFLE, HERE, target, GridSearch())
    assert place
    distance, turn = off(place, target)
    assert distance == pytest.approx(FRONT_M + 0.035 + 0.25, abs=0.01)
    assert turn < 0.01
    assert place.x < 4.0


def test_it_finds_a_free_place_near_an_object_in_a_corner() -> None:
    target = can(5.8, 3.8)
    costs = costs_of(ROOM)
    place = place_before(costs, WAFFLE, HERE, target, GridSearch())
    assert place
    assert costs.cost[costs.cell(place.x, place.y)] < 100  # type: ignore[index]
    assert off(place, target)[0] < 1.2


def test_it_does_not_stand_behind_a_wall() -> None:
    cells = ROOM.copy()
    cells[:30, 30] = 100  # a wall at x = 3 m, open above y = 3 m
    target = can(3.5, 1.0)
    place = place_before(costs_of(cells), WAFFLE, HERE, target, GridSearch())
    assert place
    assert place.x > 3.2


def test_it_stands_on_the_front_side_of_a_tag() -> None:
    target = Target(name="tag 7", x=5.9, y=2.0, radius=0.02, yaw=math.pi)
    place = place_before(costs_of(ROOM), WAFFLE, HERE, target, GridSearch())
    assert place
    assert (place.x, place.y) == pytest.approx((5.9 - 0.345, 2.0), abs=0.15)
    turned_away = replace(target, yaw=0.0)  # its face is towards the wall
    assert place_before(costs_of(ROOM), WAFFLE, HERE, turned_away, GridSearch()) is None


def test_there_is_no_goal_without_a_free_place() -> None:
    cells = ROOM.copy()
    cells[:, 30] = 100  # a wall across
    assert place_before(costs_of(cells), WAFFLE, HERE, can(4.5, 1.0), GridSearch()) is None
    assert place_before(costs_of(ROOM), WAFFLE, HERE, can(1e5, -1e5), GridSearch()) is None


def test_an_object_in_the_map_does_not_hide_itself() -> None:
    cells = ROOM.copy()
    cells[9:11, 39:41] = 100  # a box around (4, 1)
    target = Target(name="box 1", x=4.0, y=1.0, radius=0.15)
    place = place_before(costs_of(cells), WAFFLE, HERE, target, GridSearch())
    assert place
    assert off(place, target)[0] >= FRONT_M + 0.15 + 0.25 - 0.01


def search(cells: np.ndarray, *then: np.ndarray, most: int = 400) -> tuple[list[Pose], str]:
    """Poses that a search of everything goes through, as if it drove at once, and its end.

    The map is the next one of `then` each time there was nowhere to go for 4 s.
    """
    maps = iter(then)
    planner, here, poses = RoutePlanner(), HERE, []
    tick, feedback, idle = 0, None, 0
    for _ in range(most):
        tick += 25
        if idle == 8:
            cells = next(maps, cells)
        route = planner.plan(
            RouteRequest(
                tick=tick,
                command=DriveCommand(5, "look", seek=5),
                here=here,
                grid=grid_of(cells),
                body=SEEING,
                feedback=feedback,
                seen=np.empty((0, 2)),
            )
        )
        if route.state != "running":
            return poses, route.reason
        feedback, idle = None, 0 if route.goal else idle + 1
        if route.goal:
            yaw = here.yaw if route.goal.yaw is None else route.goal.yaw
            here = Pose(x=route.goal.x, y=route.goal.y, yaw=yaw)
            poses.append(here)
            feedback = RouteFeedback(version=route.version, arrived=True)
    raise AssertionError("it looks for ever")


def seen_by(poses: list[Pose], cells: np.ndarray, *, close: bool = False) -> float:
    """Return the share of free cells that a camera saw from one of these poses."""
    looks, costs = LookAround(), costs_of(cells)
    assert not close or looks.look_closer()
    for pose in poses:
        looks.look(costs, SEEING, pose, 1)
    rows, columns = np.nonzero(cells == 0)
    points = np.floor(costs.points(rows, columns) / 0.2).astype(int)
    return float(np.mean([tuple(one) in looks._seen for one in points.tolist()]))


def test_it_looks_at_a_whole_room_and_then_fails() -> None:
    poses, reason = search(ROOM)
    assert reason == "everything reachable was seen"
    assert seen_by(poses, ROOM) > 0.9
    assert len(poses) < 110  # viewpoints, including those at the edges of the map


def test_a_second_round_looks_from_nearer_by() -> None:
    poses, _ = search(ROOM)
    assert seen_by(poses, ROOM, close=True) > 0.9
    looks = LookAround()
    assert looks.look_closer()
    assert not looks.look_closer()


def test_a_camera_on_an_arm_is_not_used_to_look_around() -> None:
    before, armed = LookAround(), replace(ARMED, cameras=(replace(WRIST, yaw=2.0),))
    before.look(costs_of(ROOM), armed, HERE, 1)
    assert not before._seen
    both = replace(ARMED, cameras=(*armed.cameras, *SEEING.cameras))
    goals = [
        LookAround().next_goal(costs_of(ROOM), one, HERE, GridSearch()) for one in (SEEING, both)
    ]
    assert goals[0]
    assert goals[0] == goals[1]


@pytest.mark.long
def test_it_looks_into_each_room_of_a_flat() -> None:
    cells = empty(8.0, 6.0)
    cells[:25, 40] = 100
    cells[35:, 40] = 100  # a wall with a door
    poses, reason = search(cells)
    assert reason == "everything reachable was seen"
    assert seen_by(poses, cells) > 0.9


def test_a_search_ends_although_a_room_is_unreachable() -> None:
    cells = empty(8.0, 4.0)
    cells[:, 40] = 100
    poses, reason = search(cells)
    assert reason == "everything reachable was seen"
    assert max(pose.x for pose in poses) < 4.0


@pytest.mark.long
def test_a_room_whose_door_was_blocked_by_a_person_is_searched_too() -> None:
    cells = empty(8.0, 4.0)
    cells[:, 40] = 100
    opened = cells.copy()
    opened[10:25, 40] = 0
    poses, reason = search(cells, opened)
    assert reason == "everything reachable was seen"
    assert max(pose.x for pose in poses) > 4.5


@pytest.mark.long
def test_it_also_waits_for_a_second_door_blocked_by_a_person() -> None:
    cells = empty(8.0, 4.0)
    cells[:, 40] = cells[:, 60] = 100
    first, second = cells.copy(), cells.copy()
    first[10:25, 40] = second[10:25, 40] = second[10:25, 60] = 0
    poses, reason = search(cells, first, second)
    assert reason == "everything reachable was seen"
    assert max(pose.x for pose in poses) > 6.5


@pytest.mark.long
def test_it_retries_to_reach_unexplored_space_and_then_ends() -> None:
    cells = np.full_like(empty(6.0, 4.0), 100)
    cells[1:-1, 1:-1] = 0
    cells[:, 40:] = -1
    planner, command = RoutePlanner(), DriveCommand(5, "look", seek=5)
    ask(planner, command, cells, 1)
    planner._looks._seen = {(i, j) for i in range(30) for j in range(20)}
    assert planner._looks.look_closer()
    planner._looks._seen = {(i, j) for i in range(30) for j in range(20)}
    told = []
    for tick in range(26, 6000, 25):
        route = ask(planner, command, cells, tick)
        told.append("way" if route.goal else route.reason)
        if route.goal:  # a person blocks each way
            planner._missed.append((route.goal.x, route.goal.y))
            planner._drop_frontier(tick)
        if route.state != "running":
            break
    assert told.count(again := "trying again to reach unexplored space") == 2
    assert all(told[k + 1] == "way" for k, one in enumerate(told) if one == again)
    assert route.reason == "everything reachable was seen"


@pytest.mark.long
def test_it_turns_on_the_spot_before_it_drives() -> None:
    poses, _ = search(ROOM)
    assert (poses[0].x, poses[0].y) == (1.0, 1.0)


STANDS = np.array([[1.6, 2.2, -math.pi / 2]])  # a person who walked towards the robot,
FRONT = np.array([[1.6, 2.0]])  # and a hit on the person


def ask(planner: RoutePlanner, command: DriveCommand, cells: np.ndarray, tick: int) -> Route:
    return planner.plan(
        RouteRequest(
            tick=tick,
            command=command,
            here=HERE,
            grid=grid_of(cells),
            body=SEEING,
            feedback=None,
            seen=FRONT,
            walkers=STANDS,
        )
    )


@pytest.mark.long
def test_a_search_blocked_by_a_person_moves_aside() -> None:
    cells = np.full_like(empty(4.0, 3.0), 100)
    cells[1:-1, 1:-1] = 0
    planner, command = RoutePlanner(), DriveCommand(5, "look", seek=5)
    planner._looks = LookAround(5)
    assert planner._looks.look_closer()
    planner._looks._seen = {(i, j) for i in range(20) for j in range(15)}
    routes = [ask(planner, command, cells, tick) for tick in range(1, 3000, 25)]
    told = [one.activity for one in routes if one.state == "running"]
    assert "giving way" not in told[:8]
    away = next(one for one in routes if one.activity == "giving way")
    assert away.goal
    assert abs(away.goal.x - 1.6) >= 1.0
    assert told.count("giving way") >= 30  # twice for 15 s
    assert routes[-1].reason == "everything reachable was seen"


def test_it_waits_aside_for_a_person_in_front_of_an_object() -> None:
    cells = ROOM.copy()
    cells[30:51, 20:41] = 100  # around the object
    command = DriveCommand(1, "approach", target=Target(name="can 1", x=1.6, y=2.3, radius=0.03))
    planner = RoutePlanner()
    told = [ask(planner, command, cells, tick) for tick in (1, 200, 300, 1000, 1060)]
    assert [one.activity == "giving way" for one in told] == [False, False, True, True, False]
    assert ask(planner, command, ROOM, 1100).state == "running"


def test_a_person_in_front_of_an_object_has_10_s_to_leave() -> None:
    cells = ROOM.copy()
    target = Target(name="can 1", x=3.0, y=2.0, radius=0.03)
    cells[10:31, 20:41] = 100  # around it
    planner = RoutePlanner()

    def state(cells: np.ndarray, tick: int) -> str:
        return planner.plan(
            RouteRequest(
                tick=tick,
                command=DriveCommand(1, "approach", target=target),
                here=HERE,
                grid=grid_of(cells),
                body=SEEING,
                feedback=None,
                seen=np.empty((0, 2)),
            )
        ).state

    assert [state(cells, 1), state(cells, 499), state(cells, 502)] == ["running"] * 2 + ["failed"]
    planner = RoutePlanner()
    assert [state(cells, 1), state(ROOM, 499), state(ROOM, 600)] == ["running"] * 3


@pytest.mark.parametrize("kind", ["explore", "look"])
def test_an_arrival_by_the_last_route_does_not_end_the_next_one(kind: str) -> None:
    cells = np.full_like(empty(8.0, 6.0), -1)
    cells[20:41, 10:60] = 0  # a hall, open to all sides
    planner, command = RoutePlanner(), DriveCommand(1, kind, seek=1)

    def ask(tick: int, arrived: Route | None = None) -> Route:
        return planner.plan(
            RouteRequest(
                tick=tick,
                command=command,
                here=Pose(x=3.0, y=3.0, yaw=0.0),
                grid=grid_of(cells),
                body=SEEING,
                feedback=arrived and RouteFeedback(version=arrived.version, arrived=True),
                seen=np.empty((0, 2)),
            )
        )

    first = ask(1)
    second = ask(6, arrived=first)
    assert second.goal != first.goal
    again = ask(11, arrived=first)  # while the second one is planned
    assert (again.version, again.goal) == (second.version, second.goal)
    assert ask(16, arrived=second).goal != second.goal
