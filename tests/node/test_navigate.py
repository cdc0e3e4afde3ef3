"""Navigation: the decision node drives a body in a flat world, in fake time."""

import math
from typing import Literal

import msgspec
import numpy as np
import pytest

from gigabrain_schemas.base import Cause, Velocity
from gigabrain_schemas.brain import Obstacle, WorldModel
from gigabrain_schemas.safety import SafetyState
from gigabrain_schemas.tasks import GoalRequest, MissionRequest
from gigabrain_schemas.topics import GOAL, MISSION, SAFETY
from gigabrain_zenoh.config.settings import DecisionConfig
from gigabrain_zenoh.decision.behaviours import WaitReason
from gigabrain_zenoh.decision.tasks.task_queue import NO_GOAL
from gigabrain_zenoh.testing.samples import BOOT
from tests.node.plane import ROOM, Plane, drawn

CELLS = drawn(ROOM)
ZERO_VELOCITY = Velocity()


async def test_it_drives_round_a_wall_to_its_goal_and_reports_its_progress() -> None:
    async with Plane(CELLS) as plane:
        await plane.go(0.2)
        assert plane.intent.reason == NO_GOAL.reason
        reply = await plane.ask(GOAL, GoalRequest(x=4.0, y=0.8, source="ann"))
        assert (reply.ok, reply.goal) == (True, "goal-1")
        assert reply.text.startswith("goal-1: on the way, 3.")
        await plane.go(4.0)
        assert plane.intent.follow
        assert plane.intent.reason.startswith("going to (4.00, 0.80): ")
        half = plane.status
        assert half.distance_remaining is not None
        assert 1.0 < half.distance_remaining < 3.3
        assert 0.1 < half.progress < 0.9
        assert half.path[-1] == (4.0, 0.8)
        await plane.until("succeeded", seconds=60)
        assert math.hypot(plane.x - 4.0, plane.y - 0.8) < 0.15
        assert plane.status.done[0].reason == "at (4.00, 0.80)"
        await plane.go(0.5)
        assert (plane.intent.twist, plane.intent.reason) == (ZERO_VELOCITY, NO_GOAL.reason)


@pytest.mark.parametrize(
    ("x", "y", "why"),
    [
        (2.6, 0.5, "the goal is inside an obstacle; nearest reachable point is "),
        (50.0, 1.0, "the goal is outside the map; nearest reachable point is "),
        (4.7, 1.0, "the goal is too close to an obstacle: the body needs "),
    ],
)
async def test_an_unreachable_goal_is_refused_with_the_reason(x: float, y: float, why: str) -> None:
    async with Plane(CELLS) as plane:
        await plane.go(0.2)
        reply = await plane.ask(GOAL, GoalRequest(x=x, y=y))
        assert not reply.ok
        assert reply.text.startswith(why)
        await plane.go(1.0)
        assert plane.travelled == 0.0


async def test_a_goal_behind_a_closed_wall_is_refused_with_the_nearest_point() -> None:
    closed = CELLS.copy()
    closed[:, 50:55] = 100
    async with Plane(closed) as plane:
        await plane.go(0.2)
        reply = await plane.ask(GOAL, GoalRequest(x=4.0, y=0.8))
        assert not reply.ok
        assert reply.text.startswith("no path leads to the goal; nearest reachable point is ")


@pytest.mark.parametrize(
    ("unknown", "reply_text"),
    [
        ("allow", "goal-1: on the way, "),
        ("avoid", "goal-1: on the way, "),
        ("forbid", "no path leads to the goal; nearest reachable point is "),
    ],
)
async def test_a_setting_allows_or_forbids_routes_through_unknown_space(
    unknown: Literal["allow", "avoid", "forbid"], reply_text: str
) -> None:
    plane = Plane(
        CELLS, config=DecisionConfig(behaviour="navigate", settings={"unknown_space": unknown})
    )
    plane.known[:, 50:55] = -1
    async with plane:
        await plane.go(0.2)
        reply = await plane.ask(GOAL, GoalRequest(x=4.0, y=0.8))
        assert reply.text.startswith(reply_text)


async def test_a_goal_without_a_map_is_refused_with_the_setting_to_change() -> None:
    async with Plane(CELLS) as plane:
        plane.maps = False
        await plane.go(0.2)
        for service, request in (
            (GOAL, GoalRequest(x=4.0, y=0.8)),
            (MISSION, MissionRequest(mission="do: [{goto: [1, 2]}]")),
        ):
            reply = await plane.ask(service, request)  # type: ignore[arg-type]
            assert not reply.ok
            assert reply.text == WaitReason.NO_LOCALIZATION
        assert (await plane.ask(MISSION, MissionRequest(mission="do: [{wait: 1}]"))).ok


async def test_it_stands_while_it_is_not_localized_and_drives_on_afterwards() -> None:
    async with Plane(CELLS) as plane:
        await plane.go(0.2)
        await plane.ask(GOAL, GoalRequest(x=4.0, y=0.8))
        await plane.go(2.0)
        plane.localized = False
        await plane.go(1.5)
        assert plane.intent.twist == ZERO_VELOCITY
        assert plane.intent.reason == f"waiting: {WaitReason.NOT_LOCALIZED}"
        travelled = plane.travelled
        await plane.go(2.0)
        assert plane.travelled == travelled
        assert not (await plane.ask(GOAL, GoalRequest(x=1.0, y=1.0))).ok
        plane.localized = True
        await plane.until("succeeded", seconds=60)


async def test_it_stands_with_a_reason_while_the_battery_is_nearly_empty() -> None:
    low = Cause(code="battery_return", text="battery at 6 %")
    async with Plane(CELLS) as plane:
        await plane.go(0.2)
        await plane.ask(GOAL, GoalRequest(x=4.0, y=0.8))
        await plane.go(1.0)
        for _ in range(10):
            verdict = SafetyState(verdict="ok", warnings=(low,), boot=BOOT, tick=plane.tick)
            plane.bench.send(SAFETY, verdict)
            await plane.go(0.1)
        assert plane.intent.reason == "resting: the battery is nearly empty; charge it"
        assert plane.intent.twist == ZERO_VELOCITY


async def test_it_stops_pushing_ahead_where_safety_keeps_stopping_it() -> None:
    ahead = Cause(code="zone_ahead", text="obstacle 0.10 m ahead of the body, seen by a camera")
    async with Plane(CELLS) as plane:
        await plane.go(0.2)
        await plane.ask(GOAL, GoalRequest(x=4.0, y=0.8))
        while not plane.intent.trajectory:
            await plane.go(0.1)
        await plane.go(1.0)
        wanted = []
        for _ in range(25):
            verdict = SafetyState(verdict="slow", causes=(ahead,), boot=BOOT, tick=plane.tick)
            plane.bench.send(SAFETY, verdict)
            await plane.go(0.1)
            assert plane.intent.twist, plane.intent.reason
            wanted.append(plane.intent.twist.linear_x)
        assert min(wanted[:12]) > 0.05
        assert max(wanted[18:]) < 0.02
        await plane.until("succeeded", seconds=60)


async def test_it_drives_round_a_new_obstacle() -> None:
    wide = drawn("####################\n" + "#..................#\n" * 12 + "####################")
    async with Plane(wide, at=(1.0, 1.6, 0.0)) as plane:
        await plane.go(0.2)
        await plane.ask(GOAL, GoalRequest(x=4.0, y=1.6))
        plane.cells = wide.copy()
        plane.cells[26:40, 50:56] = 100  # a new box on the path; it enters the map when seen
        await plane.until("succeeded", seconds=90)
        assert plane.closest > 0.14
        assert not np.array_equal(plane.known, wide)


async def test_a_goal_found_too_close_to_an_obstacle_is_reached_beside_it() -> None:
    wide = drawn("####################\n" + "#..................#\n" * 12 + "####################")
    async with Plane(wide, at=(1.0, 1.6, 0.0)) as plane:
        await plane.go(0.2)
        assert (await plane.ask(GOAL, GoalRequest(x=4.0, y=1.6))).ok
        plane.cells = wide.copy()
        plane.cells[:, 83:86] = 100  # a new wall at x = 4.15 m, too close to the goal
        await plane.until("succeeded", seconds=90)
        reason = plane.status.done[0].reason
        assert " m from the requested goal: the goal is too close to an obstacle" in reason
        assert 0.1 < math.hypot(plane.x - 4.0, plane.y - 1.6) < 0.4
        assert plane.closest > 0.1


async def test_the_same_world_gives_the_same_drive() -> None:
    places = []
    for _ in range(2):
        async with Plane(CELLS) as plane:
            await plane.go(0.2)
            plane.bench.clock.now_ns()
            await plane.ask_at_once(GOAL, GoalRequest(x=4.0, y=0.8))
            await plane.go(5.0)
            places.append((plane.x, plane.y, plane.yaw))
    assert places[0] == places[1]


class PersonPlane(Plane):
    """A plane with a person who walks to the gap beside the wall and stops there."""

    person = 3.8  # x of the person [m]

    def _world(self) -> WorldModel:
        is_walking = self.person > 2.7
        self.person -= 0.05 * is_walking
        self.cells = CELLS.copy()
        middle = round(self.person / 0.05)
        self.cells[27:33, middle - 3 : middle + 3] = 100
        person = Obstacle(
            id=3, x=self.person - self.start[0], y=1.5 - self.start[1], radius=0.15,
            velocity_x=-0.5 * is_walking,
        )  # fmt: skip
        world = super()._world()
        self.known = CELLS.copy()  # perception does not map walking people
        return msgspec.structs.replace(world, obstacles=(person,))


async def test_it_gives_way_to_a_person_who_arrived_before_the_goal() -> None:
    async with PersonPlane(CELLS, (1.9, 1.5, 0.0)) as plane:
        await plane.go(0.2)
        assert (await plane.ask(MISSION, MissionRequest(mission="do: [{wait: 1}]"))).ok
        await plane.go(4.0)  # the person stands now
        assert (await plane.ask(GOAL, GoalRequest(x=4.0, y=0.8))).ok
        await plane.go(14.0)
        reasons = "\n".join(one.reason for one in plane.intents)
        assert "a person or a moving obstacle is in the way" in reasons
