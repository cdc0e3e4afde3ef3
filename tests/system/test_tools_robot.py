"""The command-line tools beside one running demo, whose processes get real signals."""

import asyncio
import contextlib
import json
import os
import re
import signal
from collections.abc import AsyncIterator

import msgspec
import pytest
import yaml

from gigabrain_drivers.driver.catalog import robot_path
from gigabrain_zenoh.diagnostics.discovery import ORDER
from gigabrain_zenoh.gate.state import BRAIN
from gigabrain_zenoh.qa.probe import Probe, probing
from gigabrain_zenoh.runtime.running import Running
from gigabrain_zenoh.testing.processes import AVOID, Home, free_port, robot_of
from gigabrain_zenoh.testing.waiting import until


@pytest.fixture
async def demo(shared_home: Home) -> Home:
    """The driving mock robot, shared by all tests of this file."""
    if not shared_home.processes():
        arguments = (
            *AVOID,
            "--headless",
            "--body",
            "mock",
            "--seconds",
            "3000",
        )
        await robot_of(shared_home, shared_home.start(*arguments))
    await until_driving(shared_home)
    return shared_home


@contextlib.asynccontextmanager
async def probe_of(home: Home) -> AsyncIterator[Probe]:
    """Yield a probe of the robot of this home."""
    (note,) = (home.folder / "run" / "gigabrain").glob("*.json")
    endpoint = msgspec.json.decode(note.read_bytes(), type=Running).endpoint
    async with probing(endpoint) as seen:
        yield seen


async def until_driving(home: Home) -> None:
    """Repair the robot and wait until the brain drives."""
    async with probe_of(home) as seen:
        while (seen.state.gate.mode, seen.state.gate.commander) != ("enabled", BRAIN):
            if seen.state.gate.mode == "idle":
                await seen.enable_brain()
            await seen.ticks(5)


async def output_of(home: Home, *arguments: str) -> str:
    """Run a command that must succeed, and return its output."""
    command = await home.run(*arguments)
    assert await command.ended() == 0, command.err
    return command.out


async def test_topic_commands_list_show_and_measure_topics(demo: Home) -> None:
    commands = (
        "list", "echo scan -n 1", "echo state --json -n 3", "hz scan -n 1", "bw scan -n 1",
        "delay scan -n 1", "info scan",
    )  # fmt: skip
    outputs = [output_of(demo, "topic", *command.split()) for command in commands]
    table, scan, states, hz, size, delay, about = await asyncio.gather(*outputs)
    assert re.search(r"^scan +LaserScan +\d+\.\d +10 +\d{4} .* driver +perception", table, re.M)
    assert re.search(r"^ranges: 360 values, min ", scan, re.M)
    assert [json.loads(line)["key"] for line in states.splitlines()] == ["robot/state"] * 3
    assert " Hz  promised 10" in hz
    assert "kB/s" in size
    assert "delay median" in delay
    assert "from driver to perception" in about


async def test_foreign_keys_are_shown_raw_and_unknown_ones_get_a_suggestion(
    demo: Home,
) -> None:
    wrong = await demo.run("topic", "echo", "scna")
    assert await wrong.ended() == 2
    assert "no topic 'scna'; did you mean 'scan'?" in wrong.err
    silent = await demo.run("topic", "echo", "pose", "--within", "0.5")
    assert await silent.ended() == 1
    assert "robot/pose (senders: none" in silent.err


async def test_a_message_published_by_command_arrives(demo: Home) -> None:
    ear = demo.start("topic", "echo", "teleop", "-n", "1", "--fields", "linear_x")
    for _ in range(20):
        if not ear.running:
            break
        await output_of(demo, "topic", "pub", "teleop", "linear_x=0", "--rate", "20", "-n", "3")
    assert await ear.ended() == 0
    assert ear.out == "linear_x=0\n"
    assert await (await demo.run("enable", "--take")).ended() == 0


async def test_a_velocity_command_takes_the_body_and_returns_it(demo: Home) -> None:
    refused = await demo.run("topic", "pub", "cmd_vel", "linear_x=0.1")
    assert await refused.ended() == 1
    assert "control drives" in refused.err
    assert "--take" in refused.err
    for _ in range(5):  # repeat: a process starved for 150 ms closes the gate
        driven = await demo.run("topic", "pub", "cmd_vel", "linear_x=0.1", "--take")
        if re.fullmatch(r"driven for \d\.\d s; control drives\n", driven.out):
            break
        await until_driving(demo)
    else:
        raise AssertionError(driven.out + driven.err)
    driving = demo.start("topic", "pub", "cmd_vel", "linear_x=0.1", "--take", "--rate", "20")
    async with probe_of(demo) as seen:
        await until(lambda: seen.state.gate.commander.endswith("-pub"), "it is driven by hand")
    driving.send(signal.SIGINT)
    assert await driving.ended() == 0
    assert re.search(r"; (control drives|the brain has not got it back: .*)\n$", driving.out)


async def test_processes_and_their_graph_are_shown(demo: Home) -> None:
    commands = ("node list", "node info driver", "graph", "top --once")
    table, driver, graph, once = await asyncio.gather(
        *(output_of(demo, *command.split()) for command in commands)
    )
    assert {line.split()[0] for line in table.splitlines()} >= set(ORDER)
    assert "stale_commands_executed" in driver
    assert re.search(r"^perception\n  world +\d+\.\d Hz  -> decision, safety$", graph, re.M)
    assert re.search(r"^control +ok ", once, re.M)
    assert re.search(r"^cmd_vel +\d", once, re.M)


async def test_the_log_names_the_user_who_changed_a_parameter(demo: Home) -> None:
    follow = demo.start("log", "--follow", "--process", "decision", "--json", "-n", "1")
    await until(lambda: follow.out, "the log's past")
    output = await output_of(demo, "param", "set", "decision", "max_linear_speed", "0.15")
    assert output == "decision: max_linear_speed is 0.15 now, it was 0.2\n"
    assert await output_of(demo, "param", "get", "decision", "max_linear_speed") == "0.15\n"
    refused = await demo.run("param", "set", "decision", "max_linear_speed", "fast")
    assert await refused.ended() == 1
    assert "expected a number above 0" in refused.err
    await output_of(demo, "param", "set", "decision", "max_linear_speed", "0.2")
    wanted = "max_linear_speed is 0.2 now, it was 0.15"
    await until(lambda: wanted in follow.out, "the change in the log")
    follow.send(signal.SIGINT)
    assert await follow.ended() == 0
    assert wanted in await output_of(demo, "log", "--process", "decision", "--since", "10m")


@pytest.mark.parametrize(
    ("process", "code", "words"),
    [
        ("perception", 14, "world: perception does not answer"),
        ("driver", 11, "driver: driver does not answer"),
        ("router", 10, "router: no router answers"),
    ],
)
async def test_a_process_that_hangs_is_named(
    process: str, code: int, words: str, demo: Home
) -> None:
    pid = pid_of(demo, process)
    os.kill(pid, signal.SIGSTOP)
    try:
        why = await demo.run("why")
        assert (await why.ended(), words in why.out) == (code, True), why.out
    finally:
        with contextlib.suppress(ProcessLookupError):  # it may already be restarted, after 5 s
            os.kill(pid, signal.SIGCONT)


def pid_of(home: Home, process: str) -> int:
    """Return the pid of a supervised process."""
    for pid in home.processes():
        with open(f"/proc/{pid}/cmdline") as file:
            if f'"name":"{process}"' in file.read():
                return pid
    raise AssertionError(process)


@pytest.mark.slow
async def test_an_e_stop_is_shown_with_its_remedy(demo: Home) -> None:
    for _ in range(20):  # repeat on a busy machine
        moves = await demo.run("why")
        if await moves.ended() == 0:
            break
    else:
        raise AssertionError(moves.out)
    assert await (await demo.run("estop")).ended() == 0
    latched = await demo.run("why", "--json")
    assert await latched.ended() == 18
    explained = json.loads(latched.out)
    assert "latched" in {one["link"]: one["text"] for one in explained["findings"]}["gate"]
    async with probe_of(demo) as seen:
        await seen.at_rest(30)
    assert await (await demo.run("release")).ended() == 0
    idle = await demo.run("why")
    assert await idle.ended() == 18
    assert "idle: not enabled yet" in idle.out


async def test_the_doctor_finds_a_missing_process(demo: Home) -> None:
    pid = pid_of(demo, "safety")
    os.kill(pid, signal.SIGSTOP)
    doctor = await demo.run("doctor")
    with contextlib.suppress(ProcessLookupError):  # as above
        os.kill(pid, signal.SIGCONT)
    assert await doctor.ended() == 1
    assert re.search(r"^BAD +safety +does not answer$", doctor.out, re.M)
    assert "-> start it, or read its log: gigabrain log --process safety" in doctor.out


async def test_a_closed_pipe_ends_a_command_without_an_error(demo: Home) -> None:
    async def broken_off(*arguments: str) -> str:
        read, write = os.pipe()
        command = demo.start(*arguments, stdout=write)
        os.close(write)
        with os.fdopen(read, "rb") as output_of:
            await asyncio.to_thread(output_of.readline)
        await command.ended()
        return command.err

    # the router logs no more, so no failing write reports the closed pipe
    commands = ("topic echo state", "log -n 1 --follow --process router", "topic list")
    assert await asyncio.gather(*(broken_off(*one.split()) for one in commands)) == ["", "", ""]


async def test_without_a_robot_one_line_names_the_remedy(home: Home) -> None:
    commands = (
        "topic list", "topic echo scan", "node list", "graph", "top --once", "param list",
        "foxglove", "log --follow --connect tcp/127.0.0.1:1",
    )  # fmt: skip
    for alone in await asyncio.gather(*(home.run(*command.split()) for command in commands)):
        assert await alone.ended() == 1
        assert alone.err.count("\n") == 1
        assert "gigabrain demo" in alone.err or "is the robot running" in alone.err


async def test_why_and_doctor_report_that_no_robot_runs(home: Home) -> None:
    why = await home.run("why")
    assert (await why.ended(), "no robot runs here" in why.out) == (10, True)
    doctor = await home.run("doctor", "--connect", f"tcp/127.0.0.1:{free_port()}")
    assert (await doctor.ended(), "Nothing listens on that port." in doctor.out) == (1, True)


@pytest.mark.slow
async def test_a_body_with_its_own_control_topic_is_driven_and_explained(
    home: Home,
) -> None:
    known = yaml.safe_load(robot_path("mock").read_text())
    body = home.folder / "own.yaml"
    body.write_text(yaml.safe_dump(known | {"control_topic": "robot/base/cmd"}))
    home.start("up", str(home.deployment(body=str(body), resume="auto")))
    await until(lambda: list((home.folder / "run" / "gigabrain").glob("*.json")), "it runs")
    await until_driving(home)
    driving = home.start(
        "topic", "pub", "base/cmd", "linear_x=0", "angular_z=0.8", "--take", "--rate", "20"
    )
    async with probe_of(home) as seen:
        await until(lambda: seen.state.velocity.angular_z > 0.5, "it turns left")
    driving.send(signal.SIGINT)
    assert await driving.ended() == 0
    await until_driving(home)
    other, why, doctor = await asyncio.gather(
        home.run("topic", "pub", "base/cmt", "linear_x=0.1", "--take"),
        home.run("why", "--json"),
        home.run("doctor", "--json"),
    )
    assert "no topic 'base/cmt'; did you mean 'base/cmd'?" in other.err
    links = {one["link"]: one["ok"] for one in json.loads(why.out)["findings"]}
    assert links["control"] is True, why.out
    assert "cmd_vel" not in doctor.out
