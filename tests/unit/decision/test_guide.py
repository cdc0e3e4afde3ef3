"""Routes for commands while the map and people change."""

import functools
import math
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_schemas.base import Pose
from gigabrain_schemas.brain import Obstacle
from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.decision.behaviours import DriveCommand
from gigabrain_zenoh.decision.give_way import Walkers, standing, things
from gigabrain_zenoh.decision.route import (
    PathCheck,
    Route,
    RouteFeedback,
    RoutePlanner,
    RouteRequest,
)
from gigabrain_zenoh.navigation.global_planner import Unreachable
from tests.unit.navigation.drives import WAFFLE
from tests.unit.navigation.grids import empty, grid_of

OPEN = empty(6.0, 2.0)
SHUT = OPEN.copy()
SHUT[:, 30] = 100  # a wall across at x = 3 m
ROOM = empty(8.0, 6.0)
TAKEN = ROOM.copy()
TAKEN[28:32, 48:52] = 100  # a person, around (5, 3)
AHEAD = Goal(x=5.0, y=1.0)
NOBODY, NOTHING = np.empty((0, 3)), np.empty((0, 2))


def think(
    guide: RoutePlanner,
    cells: np.ndarray,
    *,
    tick: int,
    x: float = 1.0,
    y: float = 1.0,
    goal: Goal = AHEAD,
    held_ticks: int = 0,
    slowed_by: str = "",
    feedback: RouteFeedback | None = None,
    walkers: np.ndarray = NOBODY,
    seen: np.ndarray = NOTHING,
) -> Route:
    return guide.plan(
        RouteRequest(
            tick=tick,
            command=DriveCommand(1, "goto", goal),
            here=Pose(x=x, y=y, yaw=0.0),
            grid=grid_of(cells),
            body=WAFFLE,
            feedback=feedback,
            seen=seen,
            held_ticks=held_ticks,
            slowed_by=slowed_by,
            walkers=walkers,
        )
    )


def test_a_path_that_the_map_closes_is_followed_for_30_s() -> None:
    guide = RoutePlanner()
    first = think(guide, OPEN, tick=1)
    assert first.points is not None
    for tick in (50, 1501):
        kept = think(guide, SHUT, tick=tick, x=2.5)
        assert kept.state == "running"
        assert kept.points is not None
        assert np.array_equal(kept.points, first.points)
    lost = think(guide, SHUT, tick=1502, x=2.5)
    assert (lost.state, lost.points) == ("failed", None)
    assert lost.reason.startswith("no path leads to the goal; nearest reachable point is ")


def test_a_path_blocked_by_a_person_at_first_has_30_s_to_open() -> None:
    guide = RoutePlanner()
    barred = think(guide, SHUT, tick=1)
    assert barred.state == "running"
    assert barred.activity == "checking whether the goal is free"
    assert barred.goal
    assert barred.goal.x < 3.0
    opened = think(guide, OPEN, tick=900, x=2.5)
    assert opened.goal == AHEAD
    guide = RoutePlanner()
    ends = [think(guide, SHUT, tick=tick, x=2.5).state for tick in (1, 1400, 1502)]
    assert ends == ["running", "running", "failed"]


def test_a_path_that_opens_again_is_replanned() -> None:
    guide = RoutePlanner()
    think(guide, OPEN, tick=1)
    think(guide, SHUT, tick=50, x=2.0)
    again = think(guide, OPEN, tick=1400, x=2.0)
    assert again.points is not None
    assert again.points[0].tolist() == [2.0, 1.0]
    kept = think(guide, SHUT, tick=2900, x=2.0)
    assert kept.state == "running"


def test_a_detour_restarts_the_timer_but_driving_back_and_forth_ends() -> None:
    guide = RoutePlanner()
    barred = ROOM.copy()
    barred[10:, 40] = 100  # a wall at x = 4 m; the way around it is over 5 m longer
    ask = functools.partial(think, guide, goal=Goal(x=7.0, y=4.5), y=4.5)
    assert ask(ROOM, tick=1, x=3.0).state == "running"
    ends = [ask(barred, tick=1001, x=3.5)]
    ends += [ask(barred, tick=1001 + 100 * k, x=3.5, y=4.5 - 0.1 * k) for k in range(1, 30)]
    assert {one.state for one in ends} == {"running"}
    tries = [ask(barred if k % 2 else ROOM, tick=4901 + 1000 * k, x=3.5).state for k in range(12)]
    assert tries == ["running"] * 8 + ["failed"] * 4


def test_a_robot_that_gave_way_at_the_goal_has_time_to_return() -> None:
    guide = RoutePlanner()
    ask = functools.partial(think, guide, OPEN, goal=AHEAD)
    assert ask(tick=1).state == "running"
    assert ask(tick=1000, x=5.0).state == "running"
    assert ask(tick=1100, x=4.4).state == "running"  # it gave way
    tries = [ask(tick=2400 + 700 * k, x=5.0).state for k in range(3)]
    assert tries == ["running", "running", "running"]
    assert ask(tick=3901, x=5.0).state == "failed"  # 30 s at the goal without an arrival


def test_a_robot_stuck_near_the_goal_accepts_its_place_with_a_reason() -> None:
    guide = RoutePlanner()
    goal = Goal(x=5.0, y=1.0, yaw=1.5)
    ask = functools.partial(think, guide, OPEN, goal=goal)
    for tick in (1, 1501):  # safety stops it for an obstacle that is not in the map
        assert ask(tick=tick, x=4.85).goal == goal
    settled = ask(tick=1502, x=4.85)
    assert settled.goal == Goal(x=4.85, y=1.0, yaw=1.5)
    assert settled.reason == "0.15 m from the requested goal: no progress for 30 s"
    assert not settled.activity
    again = ask(tick=3002, x=4.86)  # while it turns
    assert (again.goal, again.reason) == (settled.goal, settled.reason)
    assert again.version == settled.version
    assert ask(tick=3003, x=4.86).state == "failed"


def test_driving_back_and_forth_at_the_goal_ends() -> None:
    guide = RoutePlanner()
    ends = [think(guide, OPEN, tick=1 + 1000 * k, x=5.0 if k % 2 else 4.8) for k in range(8)]
    assert [one.state for one in ends] == ["running"] * 7 + ["failed"]
    assert ends[-1].reason.startswith("gave up: no progress for 30 s, 0.00 m from the goal")


def test_the_time_in_which_the_robot_is_held_does_not_count() -> None:
    guide = RoutePlanner()
    ask = functools.partial(think, guide, OPEN, x=2.0)
    ask(tick=1)
    assert ask(tick=1001).state == "running"
    assert ask(tick=9001, held_ticks=7700).state == "running"  # it was free to drive for 300 ticks
    assert ask(tick=9201).state == "running"
    assert ask(tick=9202).state == "failed"


def test_a_robot_that_an_operator_drove_away_makes_progress_from_there() -> None:
    guide = RoutePlanner()
    think(guide, OPEN, tick=1, x=4.0)
    for step in range(20):  # an operator drives it back, 10 cm per plan
        held = think(guide, OPEN, tick=26 + 25 * step, x=4.0 - 0.1 * step, held_ticks=25)
        assert held.state == "running"
    back = [think(guide, OPEN, tick=501 + 500 * k, x=2.1 + 0.5 * k) for k in range(1, 5)]
    assert [one.state for one in back] == ["running"] * 4


def test_it_gives_up_with_the_known_reason() -> None:
    def ended(**known: Any) -> str:
        guide = RoutePlanner()
        think(guide, OPEN, tick=1, x=2.0)
        route = think(guide, OPEN, tick=1502, x=2.0, **known)
        assert route.state == "failed"
        return route.reason

    doing = RouteFeedback(version=1, reason="waiting: blocked ahead, 0.02 m of room")
    gave_up = "gave up: no progress for 30 s, 3.00 m from the goal"
    assert ended() == gave_up
    assert ended(feedback=doing) == f"{gave_up} (waiting: blocked ahead, 0.02 m of room)"
    near = "obstacle 0.14 m ahead of the body"
    assert ended(feedback=doing, slowed_by=near) == f"{gave_up} ({near})"


def test_it_drives_to_a_goal_within_the_arrival_tolerance_of_a_reachable_place() -> None:
    too_near = Goal(x=2.88, y=1.05)  # the nearest cell with room is at 2.75 m
    refused = RoutePlanner().check(grid_of(SHUT), WAFFLE, Pose(x=1.0, y=1.0, yaw=0.0), too_near)
    assert isinstance(refused, Unreachable)
    assert refused.distance == pytest.approx(0.13, abs=0.005)
    assert think(RoutePlanner(), SHUT, tick=1, goal=too_near).state == "failed"
    near = replace(too_near, x=2.83)
    checked = RoutePlanner().check(grid_of(SHUT), WAFFLE, Pose(x=1.0, y=1.0, yaw=0.0), near)
    assert isinstance(checked, PathCheck)
    assert checked.length_m == pytest.approx(1.8, abs=0.05)
    assert checked.offset.startswith("0.08 m from the requested goal: the goal is too c")
    route = think(RoutePlanner(), SHUT, tick=1, goal=near)
    assert route.goal
    assert math.dist((route.goal.x, route.goal.y), (near.x, near.y)) == pytest.approx(0.08)
    assert route.reason.startswith("0.08 m from the requested goal: the goal is too close to ")


def test_a_goal_that_is_occupied_from_the_start_fails_at_once() -> None:
    assert think(RoutePlanner(), SHUT, tick=1, goal=Goal(x=3.0, y=1.0)).state == "failed"


def test_it_gives_way_to_a_person_who_stays_at_the_goal() -> None:
    guide = RoutePlanner()
    goal = Goal(x=5.0, y=3.0)
    ask = functools.partial(think, guide, goal=goal, x=4.0, y=3.0)
    ask(ROOM, tick=1)
    waits = ask(TAKEN, tick=50)
    assert (waits.goal, waits.activity) == (goal, "")
    assert not ask(TAKEN, tick=501).activity
    leaves = ask(TAKEN, tick=502)
    assert (leaves.activity, leaves.reason) == ("giving way", "the goal is occupied")
    assert leaves.version != waits.version
    assert leaves.goal
    assert abs(leaves.goal.y - 3.0) >= 1.0  # beside the line on which the person walks
    assert math.hypot(leaves.goal.x - 4.0, leaves.goal.y - 3.0) < 1.5
    stays = ask(TAKEN, tick=1251, x=leaves.goal.x, y=leaves.goal.y)
    assert (stays.activity, stays.goal, stays.version) == (
        leaves.activity,
        leaves.goal,
        leaves.version,
    )
    goes = ask(ROOM, tick=1252, x=leaves.goal.x, y=leaves.goal.y)
    assert (goes.goal, goes.activity, goes.state) == (goal, "", "running")
    assert goes.version != leaves.version


def test_it_gives_way_twice_to_an_obstacle_that_stays_at_the_goal_and_then_fails() -> None:
    guide = RoutePlanner()
    ask = functools.partial(think, guide, goal=Goal(x=5.0, y=3.0), x=4.0, y=3.0)
    ask(ROOM, tick=1)
    ticks = (502, 1251, 1252, 1752, 1753, 2502, 2503, 4003)
    routes = [ask(TAKEN, tick=tick) for tick in ticks]
    told = [one.activity for one in routes]
    away, look = "giving way", "checking whether the goal is free"
    assert told == [away, away, look, look, away, away, look, look]
    assert routes[4].goal
    assert math.hypot(routes[4].goal.x - 5.0, routes[4].goal.y - 3.0) > 4.0  # now far away
    told = ask(TAKEN, tick=4004)
    assert told.state == "failed"
    assert told.reason.startswith("the goal is inside an obstacle; nearest reachable point is ")


def test_it_returns_after_giving_way_to_check_if_the_goal_is_free() -> None:
    """The map keeps a person who left, as the robot cannot see that from its place aside."""
    guide = RoutePlanner()
    goal = Goal(x=5.0, y=3.0)
    ask = functools.partial(think, guide, goal=goal)
    ask(ROOM, tick=1, x=4.0, y=3.0)
    ask(TAKEN, tick=502, x=4.0, y=3.0)
    looks = ask(TAKEN, tick=1252, x=1.0, y=1.0)
    assert looks.activity == "checking whether the goal is free"
    assert looks.reason == "the goal is inside an obstacle"
    assert looks.goal
    assert looks.points is not None
    assert looks.activity  # the command is not done there
    assert 0.2 < math.hypot(looks.goal.x - 5.0, looks.goal.y - 3.0) < 0.8
    back = ask(ROOM, tick=1400, x=looks.goal.x, y=looks.goal.y)
    assert (back.goal, back.activity, back.reason) == (goal, "", "")


def test_it_gives_way_to_a_person_at_the_place_beside_its_goal() -> None:
    taken = ROOM.copy()
    taken[28:32, 50:54] = 100  # too close to the goal, but not to a place 0.1 m beside it
    guide = RoutePlanner()
    ask = functools.partial(think, guide, goal=Goal(x=4.85, y=3.0), x=4.0, y=3.0)
    ask(ROOM, tick=1)
    beside = ask(taken, tick=50)
    assert beside.reason.startswith("0.11 m from the requested goal: the goal is too close to ")
    assert not beside.activity
    assert ask(taken, tick=502).activity


def test_a_robot_between_walls_drives_far_from_a_person_at_its_goal() -> None:
    aisle = empty(8.0, 1.0)
    taken = aisle.copy()
    taken[3:7, 48:52] = 100
    guide = RoutePlanner()
    ask = functools.partial(think, guide, goal=Goal(x=5.0, y=0.5), x=4.0, y=0.5)
    ask(aisle, tick=1)
    ask(taken, tick=50)
    leaves = ask(taken, tick=502)
    assert leaves.activity
    assert leaves.goal
    assert leaves.goal.x < 1.0


OPENED = ROOM.copy()
OPENED[:, 40:42] = 100  # a wall at x = 4 m, with a door
OPENED[24:36, 40:42] = 0
BARRED = OPENED.copy()
BARRED[28:32, 38:43] = 100  # a person stands in it
THERE = np.array([[4.05, 3.0, math.pi]])  # a person who came through it towards -x


HITS = np.array([[3.8, 3.1], [3.8, 2.9]])  # of their front


def goes_aside(cells: np.ndarray, walkers: np.ndarray, seen: np.ndarray) -> list[Route]:
    """Return the routes of a robot in front of the door."""
    guide = RoutePlanner()
    ask = functools.partial(think, guide, goal=Goal(x=6.0, y=3.0), x=3.2, y=3.2)
    ask(OPENED, tick=1)
    ticks = (50, 251, 252, 900)
    return [ask(cells, tick=tick, walkers=walkers, seen=seen) for tick in ticks]


@pytest.mark.parametrize("cells", [BARRED, OPENED])  # with and without the person in the map
def test_it_moves_aside_for_a_person_in_the_only_door(cells: np.ndarray) -> None:
    *waits, leaves, stays = goes_aside(cells, THERE, HITS)
    assert [one.activity for one in waits] == ["", ""]
    assert leaves.activity == "giving way"
    assert leaves.reason == "a person or a moving obstacle is in the way"
    assert leaves.goal
    assert abs(leaves.goal.y - 3.0) >= 1.0  # beside the line of the person, not of the robot
    assert math.dist((leaves.goal.x, leaves.goal.y), (3.2, 3.2)) < 1.2
    assert (stays.goal, stays.activity) == (leaves.goal, leaves.activity)


def test_it_continues_as_soon_as_the_person_walks_on() -> None:
    guide = RoutePlanner()
    ask = functools.partial(think, guide, goal=Goal(x=6.0, y=3.0), x=3.2, y=3.2)
    ask(OPENED, tick=1)
    aside = ask(BARRED, tick=252, walkers=THERE, seen=HITS)
    assert aside.activity
    near = ask(OPENED, tick=300, walkers=THERE - np.array((0.9, 0.0, 0.0)))
    assert near.activity == "giving way"  # the person has not passed yet
    passed = ask(OPENED, tick=350, walkers=THERE - np.array((1.2, 0.0, 0.0)))
    assert (passed.goal, passed.activity) == (Goal(x=6.0, y=3.0), "")


@pytest.mark.parametrize(("meetings", "told"), [(10, ["giving way"] * 10), (11, [""])])
def test_it_moves_aside_whenever_the_person_returns(meetings: int, told: list[str]) -> None:
    guide = RoutePlanner()
    ask = functools.partial(think, guide, goal=Goal(x=6.0, y=3.0), x=3.2, y=3.2)
    ask(OPENED, tick=1)
    routes = []
    for number in range(meetings):
        routes.append(ask(BARRED, tick=252 + 600 * number, walkers=THERE, seen=HITS))
        gone = ask(OPENED, tick=300 + 600 * number)
        assert (gone.activity, gone.state) == ("", "running")
    assert [one.activity for one in routes][-len(told) :] == told


@pytest.mark.parametrize(
    ("walkers", "seen"),
    [
        (NOBODY, HITS),  # an object
        (THERE + np.array((0.0, 2.5, 0.0)), HITS),  # a person elsewhere
        (THERE, NOTHING),  # the person left
    ],
)
def test_it_does_not_move_aside_for_objects_or_absent_people(
    walkers: np.ndarray, seen: np.ndarray
) -> None:
    assert not any(one.activity for one in goes_aside(BARRED, walkers, seen))


def walking(x: float, y: float, speed: float, number: int = 1) -> Obstacle:
    return Obstacle(id=number, x=x, y=y, velocity_x=speed, radius=0.2)


def test_a_person_who_walked_is_remembered_where_they_stand() -> None:
    walkers = Walkers()
    moved = Pose(x=1.0, y=2.0, yaw=math.pi / 2)
    walkers.update(10, (walking(0.7, 0.0, 0.5),), moved)
    walkers.update(12, (walking(1.1, 0.0, 0.5),), moved)
    assert len(walkers.ways) == 0  # a post may seem to move so far while the robot turns
    walkers.update(15, (walking(1.3, 0.0, 0.5),), moved)
    walkers.update(20, (walking(1.3, 0.0, 0.0),), moved)
    assert walkers.ways == pytest.approx(np.array([[1.0, 3.3, math.pi / 2]]))
    walkers.update(3015, (), moved)
    assert len(walkers.ways) == 1
    walkers.update(3016, (), moved)
    assert len(walkers.ways) == 0


def test_a_person_who_returns_is_remembered_where_they_stand() -> None:
    walkers, here = Walkers(), Pose(x=0.0, y=0.0, yaw=0.0)
    for tick, x in enumerate((0.0, 0.3, 0.6, 0.3)):
        walkers.update(5 * tick, (walking(x, 0.0, 0.5 if x < 0.6 else -0.5),), here)
    walkers.update(20, (walking(0.1, 0.0, -0.5),), here)
    walkers.update(25, (walking(0.1, 0.0, 0.0),), here)
    assert len(standing(walkers.ways, np.array([[-0.1, 0.0]]))) == 1


def test_a_person_who_moves_slowly_is_remembered_where_they_stand() -> None:
    walkers, here = Walkers(), Pose(x=1.0, y=0.0, yaw=0.0)
    for tick, x in enumerate((0.0, 0.3, 0.6)):
        walkers.update(5 * tick, (walking(x, 0.0, 0.5),), here)
    for tick in range(3, 20):  # a centimetre from scan to scan, as if standing
        walkers.update(5 * tick, (walking(0.6 + 0.01 * (tick - 2), 0.0, 0.0),), here)
    assert walkers.ways == pytest.approx(np.array([[1.77, 0.0, 0.0]]))
    walkers.update(3011, (walking(0.77, 0.0, 0.0),), here)
    assert len(walkers.ways) == 0  # 60 s after the last motion


def test_the_number_of_remembered_people_is_limited() -> None:
    walkers = Walkers()
    for k in range(16):
        x, y = -0.6 * (1 - k % 2), 20.0 * (k // 2)
        crowd = tuple(walking(x + 2.0 * i, y, 0.5, 20 * (k // 2) + i) for i in range(20))
        walkers.update(5 * k, crowd, Pose(x=0.0, y=0.0, yaw=0.0))
    assert len(walkers.ways) == 64
    assert walkers.ways[-1].tolist() == [38.0, 140.0, 0.0]


def test_contours_of_people_are_not_remembered_for_routes() -> None:
    person = np.array([[3.9, 2.8], [4.2, 2.8], [4.2, 3.2]])
    box = person + np.array((0.0, 1.0))
    ways = standing(THERE, HITS)
    assert [one is box for one in things((person, box), ways)] == [True]
    gone = things((person, box), standing(THERE, HITS + 1.0))
    assert len(gone) == 2
