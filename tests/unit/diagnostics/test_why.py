"""`gigabrain why`: every link of a robot in memory is broken on purpose, and must be named."""

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_schemas.arrays import ranges_bytes
from gigabrain_schemas.base import Cause, Velocity
from gigabrain_schemas.body import Battery, GateStatus, Joint, LinkHealth, RobotState
from gigabrain_schemas.brain import CmdVel, Twist
from gigabrain_schemas.requests import EnableRequest, EstopRequest, ReleaseRequest
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.tasks import Task, TaskStatus
from gigabrain_schemas.topics import CMD_VEL, ENABLE, ESTOP, RELEASE, STATE, TELEOP
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.diagnostics.why import LINKS, ChainFacts, ChainWatcher, Verdict, judge
from gigabrain_zenoh.gate.causes import estop
from gigabrain_zenoh.runtime.services import NameClaim, publish_health
from gigabrain_zenoh.testing.in_memory import RobotInMemory

Break = Callable[[RobotInMemory], Awaitable[None]]


async def asked(robot: RobotInMemory, command: CmdVel | None = None) -> Verdict:
    """Return the verdict on the next 1.5 s, in which an operator may send `command`."""
    bus = Bus(robot.network.transport(), robot.clock, "why")
    look = asyncio.ensure_future(ChainWatcher(bus).collect())
    if command:
        robot.operator.publish(CMD_VEL, command)
    await robot.go(80)
    verdict = judge(await look)
    await bus.close()
    return verdict


async def broken(folder: Path, do: Break, *, wait: int = 60) -> tuple[str, int, str, str]:
    """Return the link that is broken after `do`: name, exit code, text and remedy."""
    async with RobotInMemory(folder) as robot:
        await robot.go(100)
        await do(robot)
        await robot.go(wait)
        verdict = await asked(robot)
    found = verdict.broken
    assert found, verdict
    return found.link, verdict.exit_code, found.text, found.remedy


async def test_of_a_moving_robot_each_link_is_ok_with_its_figures(
    tmp_path: Path,
) -> None:
    async with RobotInMemory(tmp_path) as robot:
        await robot.go(100)
        verdict = await asked(robot)
    assert (verdict.broken, verdict.exit_code, verdict.notes) == (None, 0, ())
    assert tuple(found.link for found in verdict.findings) == LINKS
    said = {found.link: found.text for found in verdict.findings}
    assert said["driver"].startswith("mock, state 50")
    assert "Hz" in said["scan"]
    assert "0.0 ms after the scan" in said["world"]
    assert said["control"] == "+0.26 m/s +0.00 rad/s, 0.0 ms after the intent"
    assert said["gate"] == "open for control"
    assert said["body"] == "it moves: +0.26 m/s +0.00 rad/s"


def test_without_a_router_nothing_else_is_judged() -> None:
    verdict = judge(ChainFacts(router="no router answers at tcp/127.0.0.1:1"))
    assert [found.link for found in verdict.findings] == ["router"]
    assert verdict.exit_code == 10
    assert verdict.broken
    assert verdict.broken.text == "no router answers at tcp/127.0.0.1:1"


@pytest.mark.long
@pytest.mark.parametrize("how", ["kill", "freeze"])
@pytest.mark.parametrize(
    ("process", "link", "code", "what"),
    [
        ("perception", "world", 14, "world"),
        ("decision", "intent", 15, "intent"),
        ("control", "control", 16, "command"),
        ("safety", "safety", 17, "verdict"),
    ],
)
async def test_a_process_that_is_dead_or_hangs_is_named(
    how: str, process: str, link: str, code: int, what: str, tmp_path: Path
) -> None:
    async def do(robot: RobotInMemory) -> None:
        if how == "kill":
            await robot.kill(process)
        else:
            robot.freeze(process)

    found = await broken(tmp_path, do)
    assert found[:3] == (link, code, f"{process} does not answer, and sends no {what}")
    assert f"gigabrain log --process {process}" in found[3]


async def test_a_silent_process_differs_from_one_that_is_gone(
    tmp_path: Path,
) -> None:
    async def do(robot: RobotInMemory) -> None:
        await robot.kill("perception")
        answering = asyncio.ensure_future(
            NameClaim(Bus(robot.network.transport(), robot.clock, "perception")).acquire()
        )
        await robot.go(1)
        await answering

    found = await broken(tmp_path, do)
    assert found[:3] == ("world", 14, "perception runs, but sends no world")


async def test_a_driver_that_is_gone_is_named_and_nothing_behind_it_is_judged(
    tmp_path: Path,
) -> None:
    async with RobotInMemory(tmp_path) as robot:
        await robot.go(100)
        await robot.kill("driver")
        await robot.go(60)
        verdict = await asked(robot)
    assert [found.link for found in verdict.findings] == ["router", "driver"]
    assert verdict.exit_code == 11


def telling(robot: RobotInMemory, change: Callable[[RobotState], RobotState]) -> None:
    """From now on the body says something else of itself."""
    read = robot.body.read_state

    async def changed() -> RobotState:
        return change(await read())

    robot.body.read_state = changed  # type: ignore[method-assign]


async def test_an_unplugged_body_is_named_before_all_that_follows_from_it(tmp_path: Path) -> None:
    gone = LinkHealth(connected=False, age_ms=2400)

    async def do(robot: RobotInMemory) -> None:
        robot.body._scan = lambda: None  # type: ignore[method-assign]
        telling(robot, lambda state: replace(state, link=gone))

    found = await broken(tmp_path, do)
    assert found[:3] == ("link", 12, "no answer from the body for 2.4 s")
    assert "power" in found[3]


def seeing(robot: RobotInMemory, ranges: float) -> None:
    """From now on the lidar sees nothing but this distance [m], about."""
    look = robot.body._scan

    def other() -> LaserScan | None:
        scan = look()
        noise = np.linspace(0.0, 0.005, robot.body.robot.lidar.beams)  # type: ignore[union-attr]
        return scan and replace(scan, ranges=ranges_bytes(ranges + noise))

    robot.body._scan = other  # type: ignore[method-assign]


async def test_a_blind_lidar_is_named(tmp_path: Path) -> None:
    async def do(robot: RobotInMemory) -> None:
        seeing(robot, float("nan"))

    found = await broken(tmp_path, do)
    assert found[:3] == ("scan", 13, "not plausible: the lidar sees nothing at all")


async def test_a_lidar_that_sends_nothing_is_named(tmp_path: Path) -> None:
    async def do(robot: RobotInMemory) -> None:
        robot.body._scan = lambda: None  # type: ignore[method-assign]

    found = await broken(tmp_path, do)
    assert found[:3] == ("scan", 13, "no scan has arrived")


async def test_a_scan_that_is_too_old_is_named(tmp_path: Path) -> None:
    verdict = judge(replace(await facts_of(tmp_path), scan_age_ms=900.0))
    assert verdict.broken
    assert (verdict.broken.link, verdict.broken.text) == ("scan", "the newest scan is 0.9 s old")


async def test_walls_all_round_are_named(tmp_path: Path) -> None:
    async def do(robot: RobotInMemory) -> None:
        seeing(robot, 0.16)

    found = await broken(tmp_path, do)
    assert found[:2] == ("safety", 17)
    assert "obstacle" in found[2]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda s: replace(s, joints=(Joint(name="left", position=0.0, temperature=90.0),)),
            "a motor has 70",
        ),
        (lambda s: replace(s, battery=Battery(voltage=9.0, percentage=1.0)), "battery"),
    ],
)
async def test_a_hot_motor_and_an_empty_battery_are_named(
    change: Callable[[RobotState], RobotState], words: str, tmp_path: Path
) -> None:
    async def do(robot: RobotInMemory) -> None:
        telling(robot, change)

    link, code, text, remedy = await broken(tmp_path, do, wait=150)
    assert code in (15, 17)  # with an empty battery decision comes to rest before safety stops it
    assert link in ("intent", "safety")
    assert words in text
    assert remedy


async def test_a_latched_gate_is_named_with_the_way_out(tmp_path: Path) -> None:
    async def do(robot: RobotInMemory) -> None:
        await robot.operator.ask(ESTOP, EstopRequest(source="ann"))

    found = await broken(tmp_path, do)
    assert found[:3] == ("gate", 18, "latched: e-stop pressed by ann")
    assert found[3] == "find out why it was pressed: `gigabrain release`, then `gigabrain enable`"


async def test_a_gate_that_is_not_enabled_is_named(tmp_path: Path) -> None:
    async def do(robot: RobotInMemory) -> None:
        await robot.operator.ask(ESTOP, EstopRequest(source="ann"))
        await robot.go(40)
        await robot.operator.ask(RELEASE, ReleaseRequest(estop_generation=1, source="ann"))

    found = await broken(tmp_path, do)
    assert found == (
        "gate", 18, "idle: not enabled yet", "enable it with `gigabrain enable`",
    )  # fmt: skip


async def test_a_second_commander_that_has_the_body_is_named(tmp_path: Path) -> None:
    async with RobotInMemory(tmp_path) as robot:
        await robot.go(100)
        await robot.operator.ask(ENABLE, EnableRequest(source="bob", take=True, by="bob"))
        sending = Bus(robot.network.transport(), robot.clock, "bob")
        sending.latest(
            STATE, lambda _: sending.publish(CMD_VEL, CmdVel(linear_x=0.0, source="bob"))
        )
        await robot.go(60)
        verdict = await asked(robot)
    assert verdict.broken
    assert (verdict.broken.link, verdict.exit_code) == ("gate", 18)
    assert verdict.broken.text.startswith("bob ")
    assert "`gigabrain enable --take`" in verdict.broken.remedy


async def test_a_second_commander_in_vain_is_noted(tmp_path: Path) -> None:
    async with RobotInMemory(tmp_path) as robot:
        await robot.go(100)
        verdict = await asked(robot, CmdVel(linear_x=0.1, source="eve"))
    assert verdict.broken is None
    (note,) = verdict.notes
    assert note.endswith(": eve")


async def test_an_operator_s_seat_that_holds_still_is_named(tmp_path: Path) -> None:
    async def do(robot: RobotInMemory) -> None:
        for _ in range(40):  # half a second of it is not believed
            robot.operator.publish(TELEOP, Twist(linear_x=0.0))
            await robot.go(2)

    found = await broken(tmp_path, do)
    assert found[:2] == ("control", 16)
    assert "`gigabrain enable`" in found[3]


async def test_a_body_that_does_not_follow_is_named(tmp_path: Path) -> None:
    facts = await facts_of(tmp_path)
    assert facts.state
    assert judge(facts).broken is None
    still = replace(facts.state, velocity=replace(facts.state.velocity, linear_x=0.0))
    stuck = judge(replace(facts, state=still))
    assert stuck.broken
    assert (stuck.broken.link, stuck.exit_code) == ("body", 19)
    assert "+0.26 m/s +0.00 rad/s" in stuck.broken.text


STANDS = Velocity()
GOAL = Task(id="goal-3", kind="goal", label="(3.00, 1.50)", source="ann", state="active")
WAITS = TaskStatus(current=GOAL, doing="waiting 5 s")
DRIVES = TaskStatus(current=GOAL, doing="going to (3.00, 1.50)", drives=True)
PAUSED = TaskStatus(current=replace(GOAL, state="paused", reason="paused by ann"))
PRESSED = GateStatus(mode="latched", causes=(estop("ann"),))
RELEASED = GateStatus(mode="idle")
OPEN = GateStatus(mode="enabled", commander="control")


@pytest.fixture(scope="module")
def moving(tmp_path_factory: pytest.TempPathFactory) -> ChainFacts:
    return asyncio.run(facts_of(tmp_path_factory.mktemp("robot")))


def standing(
    moving: ChainFacts,
    tasks: TaskStatus | None,
    *,
    gate: GateStatus = OPEN,
    reason: str = "",
    wants: Velocity = STANDS,
    operator: bool = False,
) -> ChainFacts:
    """Return the facts of a robot that drove and stands now."""
    assert moving.state
    assert moving.intent
    assert moving.command
    command = replace(moving.command, linear_x=0.0, angular_z=0.0, operator=operator)
    return replace(
        moving,
        state=replace(moving.state, velocity=STANDS, gate=gate),
        intent=replace(moving.intent, twist=wants, reason=reason),
        command=command,
        fastest=STANDS,
        tasks=tasks,
    )


@pytest.mark.parametrize(
    ("tasks", "operator", "waits", "act"),
    [
        (TaskStatus(), False, "waiting for a goal", "gigabrain goto"),
        (WAITS, False, "goal-3: waiting 5 s", "by itself"),
        (PAUSED, False, "goal-3 is paused: paused by ann", "gigabrain task resume goal-3"),
        (TaskStatus(), True, "waiting for a goal", "gigabrain goto"),
    ],
)
def test_a_robot_that_has_nowhere_to_go_is_not_broken(
    moving: ChainFacts, tasks: TaskStatus, operator: bool, waits: str, act: str
) -> None:
    verdict = judge(standing(moving, tasks, operator=operator))
    assert (verdict.broken, verdict.exit_code, verdict.moves) == (None, 0, False)
    assert all(found.ok for found in verdict.findings)
    assert verdict.waits
    assert (verdict.waits.link, verdict.waits.text) == ("intent", waits)
    assert act in verdict.waits.remedy
    control = next(found for found in verdict.findings if found.link == "control")
    assert control.waits is operator  # it says so, and does not contradict the intent


@pytest.mark.parametrize("tasks", [TaskStatus(), WAITS, PAUSED, DRIVES, None])
@pytest.mark.parametrize(
    ("gate", "text", "steps"),
    [
        (
            PRESSED,
            "latched: e-stop pressed by ann",
            ("gigabrain release", "gigabrain enable"),
        ),
        (RELEASED, "idle: not enabled yet", ("gigabrain enable",)),
    ],
)
def test_a_gate_that_is_shut_comes_before_a_brain_that_waits(
    moving: ChainFacts,
    gate: GateStatus,
    text: str,
    steps: tuple[str, ...],
    tasks: TaskStatus | None,
) -> None:
    verdict = judge(standing(moving, tasks, gate=gate, reason="waiting: for whatever"))
    assert verdict.broken
    assert (verdict.broken.link, verdict.exit_code, verdict.broken.text) == ("gate", 18, text)
    assert all(step in verdict.broken.remedy for step in steps)
    assert "by itself" not in verdict.broken.remedy


def test_a_brain_that_stands_with_a_goal_gives_its_reason(moving: ChainFacts) -> None:
    reason = "waiting: it is not sure where in the map it is"
    verdict = judge(standing(moving, DRIVES, reason=reason))
    assert verdict.broken
    assert (verdict.broken.link, verdict.exit_code) == ("intent", 15)
    assert verdict.broken.text == f"decision does not drive: {reason}"


def test_an_operator_that_keeps_the_body_from_a_goal_is_named(moving: ChainFacts) -> None:
    wants = Velocity(linear_x=0.2)
    verdict = judge(standing(moving, DRIVES, wants=wants, operator=True))
    assert verdict.broken
    assert (verdict.broken.link, verdict.exit_code) == ("control", 16)
    assert "operator" in verdict.broken.text
    silent = judge(standing(moving, DRIVES, wants=wants))
    assert silent.broken
    assert "control sends zero" in silent.broken.text


def test_a_car_that_is_to_turn_on_the_spot_is_no_fault_of_control(moving: ChainFacts) -> None:
    assert moving.body
    car = replace(moving.body.description, drive_type="ackermann", min_turning_radius=0.4)
    facts = replace(moving, body=replace(moving.body, description=car))
    verdict = judge(standing(facts, DRIVES, wants=Velocity(angular_z=-0.5)))
    assert verdict.broken
    assert (verdict.broken.link, verdict.exit_code) == ("intent", 15)
    assert "cannot turn on the spot" in verdict.broken.text
    assert "behaviour" in verdict.broken.remedy
    silent = judge(standing(facts, DRIVES, wants=Velocity(linear_x=0.2)))
    assert silent.broken
    assert "control sends zero" in silent.broken.text


def test_a_starting_decision_differs_from_a_silent_one(moving: ChainFacts) -> None:
    starting = replace(standing(moving, TaskStatus()), intent=None)
    assert judge(starting).waits
    assert judge(replace(starting, tasks=None)).exit_code == 15


async def facts_of(folder: Path) -> ChainFacts:
    """Return the facts of a robot that drives."""
    async with RobotInMemory(folder) as robot:
        await robot.go(100)
        bus = Bus(robot.network.transport(), robot.clock, "why")
        look = asyncio.ensure_future(ChainWatcher(bus).collect())
        await robot.go(80)
        facts = await look
        await bus.close()
    return facts


async def test_problems_of_processes_are_notes_beside_the_links(tmp_path: Path) -> None:
    full = Cause(code="map_full", text="the map is full", remedy="map in parts")
    async with RobotInMemory(tmp_path) as robot:
        robot.operator.problems = (full,)
        telling = asyncio.ensure_future(publish_health(robot.operator))
        await robot.go(100)
        verdict = await asked(robot)
        telling.cancel()
    assert "warning: the map is full (map in parts)" in verdict.notes
