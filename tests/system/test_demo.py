"""`gigabrain demo`: what a run reports, and when it counts as failed."""

import asyncio
import json
import os
import re
import signal
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from gigabrain_schemas.brain import OccupancyGrid
from gigabrain_schemas.examples import EXAMPLES
from gigabrain_schemas.safety import Health
from gigabrain_schemas.tasks import Task, TaskStatus
from gigabrain_schemas.topics import MAP, STATE
from gigabrain_zenoh.launch import demo as demo_module
from gigabrain_zenoh.launch.demo import Demo, DemoOptions, newest_fault
from gigabrain_zenoh.launch.deployment import ROBOT, Deployment
from gigabrain_zenoh.qa.probe import probing
from gigabrain_zenoh.testing.in_memory import Net
from gigabrain_zenoh.testing.processes import AVOID, CommandProcess, Home, robot_of
from gigabrain_zenoh.testing.waiting import until
from gigabrain_zenoh.ui.live_view import doing
from gigabrain_zenoh.ui.run_report import (
    Observed,
    RunMonitor,
    make_report,
    summary,
    truth_in_health,
)
from tests.places import ROOT

IN_QA = pytest.mark.qa
BODIES = ROOT / "drivers" / "gigabrain_drivers" / "bodies"
DRIVER_HEALTH = Health(
    process="driver", pid=7, host="robot", uptime_s=60.0, cpu=0.5, rss_bytes=1,
    received_hz={}, sent_hz={}, rejected={}, latency_ms={}, counters={},
)  # fmt: skip
FIELDS = {
    "body", "world", "seed", "sim_seconds", "distance_m", "contacts", "min_clearance_m", "turns",
    "restarts", "rejected_messages", "stale_commands_executed", "scan_to_cmd_ms",
}  # fmt: skip


async def run(home: Home, *options: str) -> tuple[CommandProcess, dict[str, Any]]:
    """Run a demo with `options` to its end; return it and its report."""
    path = home.folder / f"report-{len(list(home.folder.iterdir()))}.json"
    demo = await home.run(*AVOID, "--headless", "--report", str(path), *options)
    assert path.exists(), demo.err
    return demo, json.loads(path.read_bytes())


@pytest.mark.parametrize(
    ("texts", "newest"),
    [
        ((), ""),
        (("driver: no port", "driver: no lidar", "safety: late"), "driver: no lidar"),
        (("safety: late", "decision: late"), "decision: late"),
    ],
)
def test_the_reported_fault_is_the_newest_of_the_driver_or_else_of_any_process(
    texts: tuple[str, ...], newest: str
) -> None:
    assert newest_fault(texts) == newest


@pytest.mark.parametrize(
    ("world", "body"),
    [
        pytest.param("arena", "turtlebot3_waffle", marks=IN_QA),
        ("house", "turtlebot3_burger"),
        pytest.param("random:3", "turtlebot3_waffle", marks=IN_QA),
    ],
)
async def test_a_robot_roams_without_touching_anything(home: Home, world: str, body: str) -> None:
    options = ("--world", world, "--body", body, "--seconds", "20", "--speed", "10")
    demo, report = await run(home, *options)
    assert await demo.ended() == 0
    assert report.keys() >= FIELDS
    assert (report["body"], report["world"], report["seed"]) == (body, world, 0)
    assert report["sim_seconds"] == 20.0
    assert report["distance_m"] > 0.5
    assert report["contacts"] == 0
    assert 0.0 < report["min_clearance_m"] < 3.0
    assert (report["restarts"], report["rejected_messages"]) == (0, 0)
    assert report["stale_commands_executed"] == 0
    assert 0.0 < report["scan_to_cmd_ms"]["p50"] <= report["scan_to_cmd_ms"]["p99"]
    assert re.match(r"ok: \d+\.\d\d m in 20 s, \d+ turns?, 0 contacts, closest ", demo.out)
    assert home.processes() == []


@pytest.mark.slow
async def test_the_same_seed_gives_the_same_decisions_at_any_speed(home: Home) -> None:
    options = ("--world", "warehouse", "--seconds", "12", "--seed", "4", "--lockstep-timeout", "30")
    _, slow = await run(home, *options, "--speed", "4")
    _, fast = await run(home, *options, "--speed", "10")
    assert (slow["lockstep_timeouts"], fast["lockstep_timeouts"]) == (0, 0)
    assert len(slow["decisions"]) >= 3
    assert slow["decisions"] == fast["decisions"]
    assert slow["distance_m"] == fast["distance_m"]
    assert (slow["contacts"], fast["contacts"]) == (0, 0)


@pytest.mark.slow
async def test_a_contact_fails_the_run(home: Home) -> None:
    """The robot file turns the lidar backwards, so the robot sees no wall ahead."""
    waffle = BODIES / "turtlebot3_waffle"
    text = (waffle / "robot.yaml").read_text()
    text = text.replace("x: -0.064}", "x: -0.064, yaw: 3.14159}")
    text = text.replace("driver: mujoco,", f"driver: mujoco, model: {waffle / 'model.xml'},")
    blind = home.folder / "blind.yaml"
    blind.write_text(text)
    options = ("--world", "house", "--seconds", "12", "--speed", "10")
    demo, report = await run(home, "--body", str(blind), *options)
    assert await demo.ended() == 1
    assert report["contacts"] > 0
    assert report["min_clearance_m"] == 0.0
    assert re.match(r"\d+ contacts?: ", demo.out)


async def test_a_robot_that_does_not_move_fails_the_run(home: Home) -> None:
    demo, report = await run(home, "--resume", "manual", "--seconds", "3", "--speed", "10")
    assert await demo.ended() == 1
    assert demo.out.startswith("no motion: 0.00 m in 3 s, 0 turns, 0 contacts")
    assert report["verdict"] == "no motion"


async def test_a_dying_process_fails_the_run_but_does_not_end_it(home: Home) -> None:
    report = home.folder / "report.json"
    options = ("--seconds", "16", "--speed", "4", "--headless", "--report", str(report))
    demo = home.start(*AVOID, *options)
    async with probing(await robot_of(home, demo)) as robot:
        await until(lambda: robot.state.gate.mode == "enabled", "driving")
        os.kill(await robot.pid("perception"), signal.SIGKILL)
    assert await demo.ended() == 1
    results = json.loads(report.read_bytes())
    assert (results["verdict"], results["restarts"]) == ("1 process died", 1)
    assert (results["sim_seconds"], results["contacts"]) == (16.0, 0)


async def test_a_body_without_simulation_is_judged_by_its_odometry(home: Home) -> None:
    demo, report = await run(home, "--body", "mock", "--seconds", "4", "--speed", "4")
    assert await demo.ended() == 0
    assert (report["contacts"], report["min_clearance_m"]) == (None, None)
    assert report["distance_m"] > 0.2
    assert "contact" not in demo.out


@pytest.mark.parametrize(
    "frozen",
    ["none", "driver", pytest.param("router", marks=IN_QA), pytest.param("decision", marks=IN_QA)],
)
async def test_ctrl_c_ends_all_processes_even_if_one_hangs(home: Home, frozen: str) -> None:
    demo = home.start(*AVOID, "--headless")
    async with probing(await robot_of(home, demo)) as robot:
        await until(lambda: robot.state.gate.mode == "enabled", "driving")
        assert len(home.processes()) == 6
        if frozen != "none":
            os.kill(await robot.pid(frozen), signal.SIGSTOP)
        demo.send(signal.SIGINT)
        assert await demo.ended() == 0
    assert home.processes() == []
    assert list((home.folder / "run" / "gigabrain").iterdir()) == []


async def test_with_a_driver_that_hangs_at_the_end_there_is_still_a_report(
    home: Home,
) -> None:
    path = home.folder / "report.json"
    demo = home.start(*AVOID, "--headless", "--keep-stuck", "--report", str(path))
    async with probing(await robot_of(home, demo)) as robot:
        await until(lambda: robot.health.get("driver"), "the driver's health")
        await robot.driving_straight(0.15, room=0.0)
        os.kill(await robot.pid("driver"), signal.SIGSTOP)
        demo.send(signal.SIGINT)
        assert await demo.ended() == 0
    results = json.loads(path.read_bytes())
    assert results["verdict"].endswith("the driver did not answer at the end")
    assert (results["contacts"], results["stale_commands_executed"]) == (None, 0)
    assert "the driver did not answer at the end: " in demo.out


async def test_two_demos_at_once_do_not_connect_to_each_other(home: Home) -> None:
    demos = [home.start(*AVOID, "--headless", "--seed", seed) for seed in ("1", "2")]
    boots = []
    for demo in demos:
        async with probing(await robot_of(home, demo)) as robot:
            await robot.ticks(25)
            boots.append({state.boot for state in robot.states})
    assert [len(boots[0]), len(boots[1])] == [1, 1]
    assert boots[0] != boots[1]
    for demo in demos:
        demo.send(signal.SIGINT)
    assert [await demo.ended() for demo in demos] == [0, 0]


def test_the_verdict_depends_on_contacts_motion_and_deaths() -> None:
    truth = {
        "body": "waffle", "distance_m": 0.049, "contacts": 2, "min_clearance_m": 0.0,
        "sim_seconds": 9.0, "stale_commands_executed": 0, "scan_to_cmd_p50_ms": 1.25,
        "scan_to_cmd_p99_ms": None, "lockstep_timeouts": 0,
    }  # fmt: skip
    seen = Observed(
        body="waffle", world="arena", seed=1, speed=1.0, seconds=9.02, distance_m=0.06,
        decisions=((1.0, "turning left: obstacle"), (2.0, "forward 0.20 m/s")), turns=1, deaths=1,
        restarts=1, rejected=3,
    )  # fmt: skip
    report = make_report(truth, seen)
    assert not report.ok
    assert summary(report) == (
        "2 contacts, no motion, 1 process died: 0.05 m in 9 s, 1 turn, 2 contacts, "
        "closest 0.00 m, scan to command 1.2 ms (p99 0.0)"
    )
    assert (report.rejected_messages, report.turns, report.sim_seconds) == (3, 1, 9.0)


def test_a_mapping_robot_reports_area_and_tasks_instead_of_turns() -> None:
    truth = {
        "distance_m": 4.0, "contacts": 0, "min_clearance_m": 0.4, "stale_commands_executed": 0,
        "scan_to_cmd_p50_ms": 20.0, "scan_to_cmd_p99_ms": 30.0, "lockstep_timeouts": 0,
    }  # fmt: skip
    task = Task(id="goal-1", kind="goal", label="(1, 2)", source="ann", state="succeeded")
    status = TaskStatus(done=(task, replace(task, id="goal-2", state="failed")))
    seen = Observed(
        body="waffle", world="house", seed=1, speed=1.0, seconds=20.0, distance_m=4.0,
        decisions=((1.0, "exploring: going"),), turns=0, deaths=0, restarts=0, rejected=0,
        mapped_m2=33.61, tasks=status,
    )  # fmt: skip
    report = make_report(truth, seen)
    assert (report.mapped_m2, report.tasks_done) == (33.6, 1)
    problem = "states come from the future"
    assert report.ok
    assert not make_report(truth, replace(seen, problem=problem)).ok
    assert summary(make_report(truth, replace(seen, problem=problem))).startswith(problem)
    assert summary(report).startswith("ok: 4.00 m in 20 s, 34 m² mapped, 1 task done, 0 contacts")
    assert ", 34 m² mapped, 0 contacts" in summary(make_report(truth, replace(seen, tasks=None)))


def test_without_a_reply_of_the_driver_the_report_uses_its_last_health() -> None:
    figures = {"scan_to_cmd_p50": 30.0, "scan_to_cmd_p99": 148.0}
    health = replace(DRIVER_HEALTH, latency_ms=figures, counters={"others": 3})
    seen = Observed(
        body="waffle", world="house", seed=1, speed=1.0, seconds=31.0, distance_m=2.5,
        decisions=((1.0, "exploring: going"),), turns=0, deaths=0, restarts=0, rejected=0,
        mapped_m2=33.61, answered=False,
    )  # fmt: skip
    report = make_report(truth_in_health(health), seen)
    assert (report.ok, report.contacts, report.stale_commands_executed) == (False, None, 0)
    assert (report.sim_seconds, report.distance_m) == (31.0, 2.5)
    assert summary(report) == (
        "the driver did not answer at the end: 2.50 m in 31 s, 34 m² mapped, "
        "scan to command 30.0 ms (p99 148.0)"
    )
    unknown = make_report(truth_in_health(None), seen)
    assert (unknown.stale_commands_executed, unknown.lockstep_timeouts) == (None, None)


async def test_the_mapped_area_counts_free_and_occupied_cells() -> None:
    net = Net()
    watch = RunMonitor(net.one)
    assert watch.mapped_m2 is None
    grid = OccupancyGrid(
        width=3, height=2, resolution=0.5, origin_x=0.0, origin_y=0.0, cells=b"\x00\x64\xff" * 2
    )
    net.two.publish(MAP, grid)
    assert watch.mapped_m2 == pytest.approx(1.0)


async def test_a_starting_process_is_shown_until_the_gate_is_enabled() -> None:
    watch = RunMonitor(Net().one)
    assert doing(watch) == "starting"
    late = "decision is starting up, compiling, once per installation"
    assert doing(watch, late) == late


async def test_an_unwritable_report_path_is_refused_before_the_start(
    home: Home,
) -> None:
    nowhere = Path("nowhere") / "report.json"
    demo = await home.run(*AVOID, "--headless", "--seconds", "1", "--report", str(nowhere))
    assert await demo.ended() == 2
    assert "nowhere/report.json" in demo.err
    assert not (home.folder / "state").exists()


async def test_a_stopped_clock_ends_the_demo_unless_a_process_is_starting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first start compiles, which may take minutes on a busy machine."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.setattr(demo_module, "STALL_TIMEOUT_S", 1.0)
    net, stop = Net(), asyncio.Event()
    demo = Demo(Deployment(router="tcp/127.0.0.1:0"), DemoOptions(headless=True))
    statuses = demo._supervisor.statuses
    for name, status in statuses.items():
        status.state = "starting" if name == "decision" else "ready"
    watching = asyncio.ensure_future(demo._watch(RunMonitor(net.one), stop))
    await asyncio.sleep(2.0)
    assert not watching.done()
    statuses["decision"].state = "ready"
    async with asyncio.timeout(60):
        await watching
    assert demo._failure() == "the robot's clock stood still for 1 s"
    await net.one.close()
    await net.two.close()


async def test_the_address_of_the_page_is_shown_once_when_it_is_served(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    net = Net()
    watch = RunMonitor(net.one)
    net.two.publish(STATE, EXAMPLES["RobotState"])
    watch.look()
    hosts = {"robot": (*ROBOT, "page")}
    where = DemoOptions(headless=True, page="http://127.0.0.1:8080")
    demo = Demo(Deployment(router="tcp/127.0.0.1:0", hosts=hosts), where)
    view, page = demo._view(watch), demo._supervisor.statuses["page"]
    counts = []
    for page.state in ("starting", "ready", "ready"):
        with view:
            view.show()
        counts.append(capfd.readouterr().err.count("operator page: http://127.0.0.1:8080\n"))
    assert counts == [0, 1, 0]
    await net.one.close()
    await net.two.close()


def test_a_contradicting_model_is_reported_once_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    demo = Demo(Deployment(router="tcp/127.0.0.1:0"), DemoOptions(headless=True))
    record = {"process": "driver", "level": "warning", "event": "mismatch", "text": "a.xml: 1 m"}
    demo._record("driver", record)
    demo._record("driver", record)  # the same after a restart of the driver
    demo._finish(None, "", stopped=True)
    assert capfd.readouterr().err.count("warning: a.xml: 1 m\n") == 1
