"""Navigating: decision's own node drives a body in a flat world, in fake time."""

import asyncio
import math
import time
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from gigabrain_schemas.base import Cause, Velocity
from gigabrain_schemas.brain import WorldModel
from gigabrain_schemas.safety import SafetyState, SpeedCaps
from gigabrain_schemas.tasks import GoalRequest, MissionRequest, TaskRequest
from gigabrain_schemas.topics import GOAL, MISSION, SAFETY, TASK_CHANGE
from gigabrain_zenoh import steering
from gigabrain_zenoh.behaviours.bearings import Route
from gigabrain_zenoh.behaviours.guide import Asked, Guide
from gigabrain_zenoh.navigating import Navigating
from gigabrain_zenoh.settings import DecisionConfig
from tests.brain_rig import BOOT, state
from tests.bus_rig import Net
from tests.plane_rig import ROOM, Plane, drawn

CELLS = drawn(ROOM)
STANDS = Velocity()


async def test_it_drives_round_a_wall_to_its_goal_and_says_how_far_it_is() -> None:
    async with Plane(CELLS) as plane:
        await plane.go(0.2)
        assert plane.intent.reason == "waiting: for a goal"
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
        assert (plane.intent.twist, plane.intent.reason) == (STANDS, "waiting: for a goal")


@pytest.mark.parametrize(
    ("x", "y", "why"),
    [
        (2.6, 0.5, "the goal is inside something; nearest reachable point is "),
        (50.0, 1.0, "the goal is outside the map; nearest reachable point is "),
        (4.7, 1.0, "the goal is too close to something: the body needs "),
    ],
)
async def test_a_goal_where_it_cannot_be_is_refused(x: float, y: float, why: str) -> None:
    async with Plane(CELLS) as plane:
        await plane.go(0.2)
        reply = await plane.ask(GOAL, GoalRequest(x=x, y=y))
        assert not reply.ok
        assert reply.text.startswith(why)
        await plane.go(1.0)
        assert plane.travelled == 0.0


async def test_a_room_without_a_door_is_refused_with_the_nearest_place() -> None:
    closed = CELLS.copy()
    closed[:, 50:55] = 100
    async with Plane(closed) as plane:
        await plane.go(0.2)
        reply = await plane.ask(GOAL, GoalRequest(x=4.0, y=0.8))
        assert not reply.ok
        assert reply.text.startswith("no way leads to the goal; nearest reachable point is ")


@pytest.mark.parametrize(
    ("unknown", "told"),
    [
        ("allow", "goal-1: on the way, "),
        ("avoid", "goal-1: on the way, "),
        ("forbid", "no way leads to the goal; nearest reachable point is "),
    ],
)
async def test_whether_a_way_may_lead_through_the_unknown_is_a_setting(
    unknown: Literal["allow", "avoid", "forbid"], told: str
) -> None:
    plane = Plane(CELLS, config=DecisionConfig(behaviour="navigate", unknown=unknown))
    plane.known[:, 50:55] = -1
    async with plane:
        await plane.go(0.2)
        reply = await plane.ask(GOAL, GoalRequest(x=4.0, y=0.8))
        assert reply.text.startswith(told)


async def test_without_a_map_it_says_what_to_change() -> None:
    async with Plane(CELLS) as plane:
        plane.maps = False
        await plane.go(0.2)
        for service, request in (
            (GOAL, GoalRequest(x=4.0, y=0.8)),
            (MISSION, MissionRequest(mission="do: [{goto: [1, 2]}]")),
        ):
            reply = await plane.ask(service, request)  # type: ignore[arg-type]
            assert not reply.ok
            assert reply.text == (
                "nobody says yet where in a map the robot is; perception: {mapping: slam} would"
            )
        assert (await plane.ask(MISSION, MissionRequest(mission="do: [{wait: 1}]"))).ok


async def test_it_stands_while_it_is_not_sure_where_it_is_and_goes_on_afterwards() -> None:
    async with Plane(CELLS) as plane:
        await plane.go(0.2)
        await plane.ask(GOAL, GoalRequest(x=4.0, y=0.8))
        await plane.go(2.0)
        plane.localized = False
        await plane.go(1.5)
        assert plane.intent.twist == STANDS
        assert plane.intent.reason == "waiting: it is not sure where in the map it is"
        travelled = plane.travelled
        await plane.go(2.0)
        assert plane.travelled == travelled
        assert not (await plane.ask(GOAL, GoalRequest(x=1.0, y=1.0))).ok
        plane.localized = True
        await plane.until("succeeded", seconds=60)


async def test_it_rests_while_the_battery_is_nearly_empty() -> None:
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
        assert plane.intent.twist == STANDS


async def test_it_stands_while_its_scans_come_too_late_to_drive_by() -> None:
    async with Plane(CELLS) as plane:
        await plane.go(0.2)
        await plane.ask_at_once(GOAL, GoalRequest(x=4.0, y=0.8))
        await plane.go(1.5)
        assert plane.travelled > 0.05
        plane.late_ticks = 11
        await plane.go(0.5)
        said = set[str]()
        for _ in range(50):
            await plane.go(0.02)
            assert plane.intent.twist == STANDS
            said.add(plane.intent.reason)
        # between two of these scans the older one no longer counts at all
        assert said == {
            "waiting: this host is too busy, its newest scan is 0.22 s old",
            "waiting: perception is silent",
        }
        plane.late_ticks = 0
        await plane.go(2.0)
        assert plane.intent.reason.startswith("going to (4.00, 0.80): ")


async def test_it_drives_more_slowly_while_its_scans_come_late_and_says_why() -> None:
    async with Plane(CELLS, at=(0.6, 1.5, 0.0)) as plane:
        await plane.go(0.2)
        await plane.ask_at_once(GOAL, GoalRequest(x=4.5, y=1.5))
        await plane.go(1.5)
        assert "busy" not in plane.intent.reason
        in_time = await fastest(plane, 1.5)
        plane.late_ticks = 7
        await plane.go(1.0)
        assert plane.intent.reason.endswith("; slower, this host is busy: 0.10 s late")
        late = await fastest(plane, 1.5)
        plane.late_ticks = 0
        await plane.go(3.0)
        assert "busy" not in plane.intent.reason
        assert in_time > 0.24
        assert 0.1 < late < 0.23
        await plane.until("succeeded", seconds=60)


async def fastest(plane: Plane, seconds: float) -> float:
    speeds = []
    for _ in range(round(seconds * 50)):
        await plane.go(0.02)
        speeds.append(plane.velocity.linear_x)
    return max(speeds)


LARGE = np.pad(CELLS, ((0, 300), (0, 300)), constant_values=100)


async def ticks_to_a_way(monkeypatch: pytest.MonkeyPatch, thinks_s: float) -> list[int]:
    """The ticks in which a way came and in which another place was driven to."""
    think = Guide.think

    def slowly(guide: Guide, asked: Asked) -> Route:
        time.sleep(thinks_s)
        return think(guide, asked)

    monkeypatch.setattr(Guide, "think", slowly)
    monkeypatch.setattr(steering, "PATIENCE_S", 30.0)
    ticks = []
    async with Plane(LARGE) as plane:
        await plane.go(0.2)
        for x in (4.0, 1.5):
            await plane.ask_at_once(GOAL, GoalRequest(x=x, y=0.8))
            while not plane.intent.reason.startswith(f"going to ({x:.2f}, 0.80): "):
                await plane.go(0.02)
            ticks.append(plane.tick)
    monkeypatch.setattr(Guide, "think", think)
    return ticks


async def test_in_a_large_map_a_way_counts_from_the_same_scan_however_long_it_takes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    quick = await ticks_to_a_way(monkeypatch, 0.0)
    assert await ticks_to_a_way(monkeypatch, 0.1) == quick
    assert quick[0] - 10 == 15


async def test_a_driver_that_starts_anew_does_not_end_what_there_is_to_do() -> None:
    async with Plane(CELLS) as plane:
        await plane.go(0.2)
        await plane.ask_at_once(GOAL, GoalRequest(x=4.0, y=0.8))
        await plane.go(2.0)
        plane.driver_starts_anew()
        await plane.go(3.0)
        assert plane.intent.reason.startswith("going to (4.00, 0.80): ")


async def test_a_pause_stands_and_a_goal_before_it_goes_first() -> None:
    async with Plane(CELLS) as plane:
        await plane.go(0.2)
        await plane.ask(GOAL, GoalRequest(x=4.0, y=0.8))
        await plane.go(1.0)
        await plane.ask(TASK_CHANGE, TaskRequest(do="pause", source="bob"))
        await plane.go(0.3)
        assert plane.intent.twist == STANDS
        await plane.ask(GOAL, GoalRequest(x=1.6, y=1.4, how="preempt"))
        await plane.go(0.5)
        assert plane.status.current
        assert plane.status.current.id == "goal-2"
        assert [task.id for task in plane.status.queue] == ["goal-1"]


async def test_exploring_ends_once_all_is_seen_that_can_be_reached() -> None:
    plane = Plane(CELLS, at=(2.0, 1.0, 0.3))
    plane.known[:] = -1
    async with plane:
        await plane.go(0.2)
        reply = await plane.ask(MISSION, MissionRequest(mission="do: [{explore: {}}]"))
        assert reply.ok
        await plane.until("succeeded", seconds=120)
        assert plane.status.done[0].reason == "all is mapped that can be reached"
        inside = CELLS[5:-5, 5:-5] == 0
        assert (plane.known[5:-5, 5:-5][inside] == 0).mean() > 0.98
        assert plane.travelled > 0.5


async def test_what_it_was_to_do_goes_on_after_a_restart_of_decision(tmp_path: Path) -> None:
    config = DecisionConfig(behaviour="navigate", state_dir=str(tmp_path))
    async with Plane(CELLS, config=config) as plane:
        await plane.go(0.2)
        await plane.ask(GOAL, GoalRequest(x=4.0, y=0.8))
        await plane.go(2.0)
        while not (tmp_path / "tasks.json").exists():  # noqa: ASYNC110 - a thread writes it
            await asyncio.sleep(0.01)
        await plane.restart()
        await plane.until("succeeded", seconds=60)
        assert plane.status.done[0].id == "goal-1"
        assert math.hypot(plane.x - 4.0, plane.y - 0.8) < 0.15


async def test_something_new_in_the_way_is_gone_round() -> None:
    wide = drawn("####################\n" + "#..................#\n" * 12 + "####################")
    async with Plane(wide, at=(1.0, 1.6, 0.0)) as plane:
        await plane.go(0.2)
        await plane.ask(GOAL, GoalRequest(x=4.0, y=1.6))
        plane.cells = wide.copy()
        plane.cells[26:40, 50:56] = 100  # a box across the way; the map learns of it as it is seen
        await plane.until("succeeded", seconds=90)
        assert plane.closest > 0.14
        assert not np.array_equal(plane.known, wide)


async def test_a_goal_that_turns_out_to_be_too_close_to_something_is_reached_beside_it() -> None:
    wide = drawn("####################\n" + "#..................#\n" * 12 + "####################")
    async with Plane(wide, at=(1.0, 1.6, 0.0)) as plane:
        await plane.go(0.2)
        assert (await plane.ask(GOAL, GoalRequest(x=4.0, y=1.6))).ok
        plane.cells = wide.copy()
        plane.cells[:, 83:86] = 100  # from x = 4.15 m on: the body does not fit at the goal
        await plane.until("succeeded", seconds=90)
        told = plane.status.done[0].reason
        assert " m beside what was asked for: the goal is too close to something" in told
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


async def test_who_roams_explores_and_then_visits_places_until_it_is_sent_elsewhere() -> None:
    plane = Plane(
        CELLS, at=(2.0, 1.0, 0.3), config=DecisionConfig(behaviour="navigate", begin="roam")
    )
    plane.known[:] = -1
    async with plane:
        said = []
        for _ in range(40):
            await plane.go(0.5)
            said.append(plane.intent.reason.partition(" ")[0])
            if said[-1] == "going":
                break
        assert "exploring:" in said
        assert said[-1] == "going"
        current = plane.status.current
        assert current
        assert (current.label, current.source) == ("roaming", "itself")
        await plane.ask_at_once(GOAL, GoalRequest(x=1.5, y=1.2))
        await plane.go(0.5)
        assert plane.status.done[0].reason == "replaced by goal-2"


async def test_who_was_told_to_do_nothing_does_not_roam_after_a_restart_of_decision(
    tmp_path: Path,
) -> None:
    config = DecisionConfig(behaviour="navigate", begin="roam", state_dir=str(tmp_path))
    async with Plane(CELLS, config=config) as plane:
        await plane.go(0.5)
        await plane.ask(TASK_CHANGE, TaskRequest(do="cancel", task="all", source="ann"))
        await plane.go(0.5)
        assert plane.intent.reason == "waiting: for a goal"
        while b'"jobs":[]' not in (tmp_path / "tasks.json").read_bytes():  # noqa: ASYNC110
            await asyncio.sleep(0.01)
        await plane.restart()
        await plane.go(1.0)
        assert plane.intent.reason == "waiting: for a goal"
        plane.driver_starts_anew()
        await plane.restart()
        await plane.go(1.0)
        assert plane.status.current
        assert plane.status.current.label == "roaming"


async def test_it_plans_with_the_place_and_the_speed_of_the_scan_however_late_that_is() -> None:
    net = Net()
    senses = Navigating(DecisionConfig(behaviour="navigate"), net.one)
    await senses.warm_up()
    states = [state(tick, v=0.01 * tick, pose=(0.1 * tick, 0.0, 0.0)) for tick in range(1, 8)]
    for one in states:
        senses.see(one)
    seen = WorldModel(scan_ok=True, obstacle_ahead=False, boot=BOOT, tick=5, basis=5)
    now = senses.situation(states[-1], seen, None)
    assert now.bearings
    assert (now.pose.x, now.bearings.velocity.linear_x) == (0.5, 0.05)
    assert now.bearings.late_ticks == 2
    assert now.bearings.may_back
    caps = SpeedCaps(backward=0.0)
    held = senses.situation(states[-1], seen, SafetyState(verdict="slow", caps=caps))
    assert held.bearings
    assert not held.bearings.may_back
    await senses.close()
    await net.one.close()
    await net.two.close()
