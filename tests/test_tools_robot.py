"""The tools beside a robot that runs: one demo, broken link by link with real signals."""

import asyncio
import json
import os
import re
import signal

import pytest

from gigabrain_zenoh.tools.graph import ORDER
from tests.stack import Command, Home, free_port, robot_of, until


@pytest.fixture
async def demo(shared_home: Home) -> Home:
    """A robot that drives: the mock, the same one for all tests."""
    if not shared_home.processes():
        command = shared_home.start("demo", "--behaviour", "avoid", "--headless", "--body", "mock", "--seconds", "3000")
        await robot_of(shared_home, command)
        await until_why(shared_home, 0)
    return shared_home


async def until_why(home: Home, code: int) -> Command:
    """`gigabrain why`, again and again until it ends with `code`."""
    for _ in range(30):
        why = await home.run("why")
        if await why.ended() == code:
            return why
    raise AssertionError(why.out)


async def printed(home: Home, *arguments: str) -> str:
    """What a command prints that has to succeed."""
    command = await home.run(*arguments)
    assert await command.ended() == 0, command.err
    return command.out


async def test_topics_are_listed_shown_measured_and_sent(demo: Home) -> None:
    table = await printed(demo, "topic", "list")
    assert re.search(r"^scan +LaserScan +\d+\.\d +10 +\d{4} .* driver +perception", table, re.M)
    told = await printed(demo, "topic", "echo", "scan", "-n", "1")
    assert re.search(r"^ranges: 360 values, min ", told, re.M)
    lines = (await printed(demo, "topic", "echo", "state", "--json", "-n", "3")).splitlines()
    assert [json.loads(line)["key"] for line in lines] == ["robot/state"] * 3
    assert " Hz  promised 10" in await printed(demo, "topic", "hz", "scan", "-n", "1")
    assert "kB/s" in await printed(demo, "topic", "bw", "scan", "-n", "1")
    assert "delay median" in await printed(demo, "topic", "delay", "scan", "-n", "1")
    assert "from driver to perception" in await printed(demo, "topic", "info", "scan")


async def test_foreign_keys_are_shown_raw_and_unknown_ones_answered_with_the_nearest(
    demo: Home,
) -> None:
    wrong = await demo.run("topic", "echo", "scna")
    assert await wrong.ended() == 2
    assert "no topic 'scna'; did you mean 'scan'?" in wrong.err
    silent = await demo.run("topic", "echo", "pose", "--within", "0.5")
    assert await silent.ended() == 1
    assert "nothing comes on robot/pose (senders: nobody" in silent.err


async def test_a_message_that_is_sent_arrives(demo: Home) -> None:
    ear = demo.start("topic", "echo", "teleop", "-n", "1", "--fields", "linear_x")
    for _ in range(20):
        if not ear.running:
            break
        await printed(demo, "topic", "pub", "teleop", "linear_x=0", "--rate", "20", "-n", "3")
    assert await ear.ended() == 0
    assert ear.out == "linear_x=0\n"
    assert await (await demo.run("enable", "--take")).ended() == 0


async def test_a_velocity_asks_for_the_body_and_gives_it_back(demo: Home) -> None:
    await until_why(demo, 0)
    refused = await demo.run("topic", "pub", "cmd_vel", "linear_x=0.1")
    assert await refused.ended() == 1
    assert refused.err == "gigabrain: control drives; take it over with --take\n"
    for _ in range(5):  # a process that is starved for 150 ms closes the gate meanwhile
        driven = await demo.run("topic", "pub", "cmd_vel", "linear_x=0.1", "--take")
        if re.fullmatch(r"driven for \d\.\d s; control drives\n", driven.out):
            break
        await until_moving(demo)
    else:
        raise AssertionError(driven.out + driven.err)
    driving = demo.start("topic", "pub", "cmd_vel", "linear_x=0.1", "--take", "--rate", "20")
    ask = ("topic", "echo", "state", "-n", "1", "--fields", "gate.commander")
    while "-pub" not in await printed(demo, *ask):
        assert driving.running, driving.err
    driving.send(signal.SIGINT)
    assert await driving.ended() == 0
    assert re.search(r"; (control drives|the brain has not got it back: .*)\n$", driving.out)
    await until_moving(demo)


async def test_processes_and_who_talks_to_whom_are_shown(demo: Home) -> None:
    table = await printed(demo, "node", "list")
    assert {line.split()[0] for line in table.splitlines()} >= set(ORDER)
    assert "stale_commands_executed" in await printed(demo, "node", "info", "driver")
    graph = await printed(demo, "graph")
    assert re.search(r"^perception\n  world +\d+\.\d Hz  -> decision, safety$", graph, re.M)
    once = await printed(demo, "top", "--once")
    assert re.search(r"^control +ok ", once, re.M)
    assert re.search(r"^cmd_vel +\d", once, re.M)


async def test_the_log_tells_who_changed_a_parameter(demo: Home) -> None:
    follow = demo.start("log", "--follow", "--process", "decision", "--json", "-n", "1")
    await until(lambda: follow.out, "the log's past")
    told = await printed(demo, "param", "set", "decision", "linear_speed", "0.15")
    assert told == "decision: linear_speed is 0.15 now, it was 0.2\n"
    assert await printed(demo, "param", "get", "decision", "linear_speed") == "0.15\n"
    refused = await demo.run("param", "set", "decision", "linear_speed", "fast")
    assert await refused.ended() == 1
    assert "expected a number above 0" in refused.err
    await printed(demo, "param", "set", "decision", "linear_speed", "0.2")
    wanted = "linear_speed is 0.2 now, it was 0.15"
    await until(lambda: wanted in follow.out, "the change in the log")
    follow.send(signal.SIGINT)
    assert await follow.ended() == 0
    assert wanted in await printed(demo, "log", "--process", "decision", "--since", "10m")


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
    await until_why(demo, 0)
    pid = pid_of(demo, process)
    os.kill(pid, signal.SIGSTOP)
    try:
        why = await demo.run("why")  # the supervisor ends a stuck process after a few seconds
        assert (await why.ended(), words in why.out) == (code, True), why.out
    finally:
        os.kill(pid, signal.SIGCONT)
    await until_moving(demo)


async def until_moving(home: Home) -> None:
    """Whatever was broken is whole again; a router that was gone takes a little longer."""
    for _ in range(30):
        if await (await home.run("why")).ended() == 0:
            return
        await home.run("enable")
        await asyncio.sleep(0.5)
    raise AssertionError("it does not move again")


def pid_of(home: Home, process: str) -> int:
    """Of a supervised process."""
    for pid in home.processes():
        with open(f"/proc/{pid}/cmdline") as file:
            if f'"name":"{process}"' in file.read():
                return pid
    raise AssertionError(process)


async def test_an_e_stop_is_named_with_the_way_out(demo: Home) -> None:
    await until_why(demo, 0)
    assert await (await demo.run("estop")).ended() == 0
    await until_why(demo, 18)
    told = json.loads((await demo.run("why", "--json")).out)
    assert "latched" in {one["link"]: one["text"] for one in told["findings"]}["gate"]
    assert await (await demo.run("release")).ended() == 0
    assert "it is idle: nobody has enabled it" in (await until_why(demo, 18)).out
    await until_moving(demo)


async def test_the_doctor_finds_a_process_that_is_gone(demo: Home) -> None:
    await until_why(demo, 0)
    os.kill(pid_of(demo, "safety"), signal.SIGSTOP)
    doctor = await demo.run("doctor")
    os.kill(pid_of(demo, "safety"), signal.SIGCONT)
    assert await doctor.ended() == 1
    assert re.search(r"^BAD +safety +does not answer$", doctor.out, re.M)
    assert "-> start it, or read its log: gigabrain log --process safety" in doctor.out


async def test_pipes_end_without_a_complaint(demo: Home) -> None:
    for arguments in (("topic", "echo", "state"), ("log", "--follow"), ("topic", "list")):
        read, write = os.pipe()
        command = demo.start(*arguments, stdout=write)
        os.close(write)
        os.read(read, 1)
        os.close(read)
        await command.ended()
        assert command.err == ""


@pytest.mark.parametrize(
    "command",
    ["topic list", "topic echo scan", "node list", "graph", "top --once", "param list",
     "log --follow --connect tcp/127.0.0.1:1"],
)  # fmt: skip
async def test_without_a_robot_one_line_says_what_to_do(home: Home, command: str) -> None:
    alone = await home.run(*command.split())
    assert await alone.ended() == 1
    assert alone.err.count("\n") == 1
    assert "gigabrain demo" in alone.err or "is the robot running" in alone.err


async def test_why_and_doctor_say_that_no_robot_runs(home: Home) -> None:
    why = await home.run("why")
    assert (await why.ended(), "no robot runs here" in why.out) == (10, True)
    doctor = await home.run("doctor", "--connect", f"tcp/127.0.0.1:{free_port()}")
    assert (await doctor.ended(), "Nothing listens on that port." in doctor.out) == (1, True)
