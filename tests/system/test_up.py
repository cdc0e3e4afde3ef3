"""`gigabrain up` starts, restarts, gives up and ends processes, and leaves none behind."""

import asyncio
import contextlib
import os
import re
import signal
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from gigabrain_zenoh.client.robot import Robot
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.qa.probe import probing
from gigabrain_zenoh.testing.processes import (
    AVOID,
    CommandProcess,
    Home,
    endpoint_of,
    free_port,
    robot_of,
)
from gigabrain_zenoh.testing.waiting import until
from tests.places import ROOT

ALL_PROCESSES = ["router", "driver", "perception", "decision", "control", "safety"]
READY_LINE = re.compile(r"^\S+ (\w+) +info +ready pid=\d+$", re.MULTILINE)


def ready(command: CommandProcess) -> list[str]:
    """Return the processes in the order in which they became ready."""
    return READY_LINE.findall(command.out)


async def test_up_starts_in_order_of_readiness_restarts_dead_processes_and_ends_cleanly(
    home: Home,
) -> None:
    file = home.deployment()
    up = home.start("up", str(file))
    await until(lambda: len(ready(up)) == 6, "six processes are ready")
    assert up.out.startswith(
        "turtlebot3_waffle on robot: router, driver, perception, decision, control, safety; "
    )
    assert ready(up)[0] == "router"
    assert sorted(ready(up)) == sorted(ALL_PROCESSES)
    assert len(home.processes()) == 6
    async with probing(endpoint_of(file)) as robot:
        os.kill(await robot.pid("safety"), signal.SIGKILL)
        await until(lambda: ready(up)[6:] == ["safety"], "safety is ready again")
        assert "safety ended with signal 9 (Killed); next start in 0.2 s" in up.out
        up.send(signal.SIGINT)
        assert await up.ended() == 0
    assert up.err == ""
    assert home.processes() == []


async def test_after_five_deaths_within_a_minute_a_process_is_given_up_in_one_line(
    home: Home,
) -> None:
    up = home.start("up", str(home.deployment()))
    async with probing(await robot_of(home, up)) as robot:
        killed = {await robot.pid("decision")}
        os.kill(*killed, signal.SIGKILL)
        while len(killed) < 5:  # kill each at once: on a busy machine five starts may take a minute
            for pid in set(home.processes("decision")) - killed:
                killed.add(pid)
                os.kill(pid, signal.SIGKILL)
            await asyncio.sleep(0.01)
        given_up = "decision ended with signal 9 (Killed) and is given up: 5 deaths within 60 s"
        await until(lambda: given_up in up.out, "it is given up")
        assert len([line for line in up.out.splitlines() if given_up in line]) == 1
        await robot.ticks(25)  # the others go on; the body stands
        assert robot.state.gate.mode == "latched"
    up.send(signal.SIGINT)
    assert await up.ended() == 0


async def test_up_goes_on_if_its_output_is_not_read(home: Home) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    up = home.start("up", str(home.deployment()), stdout=writer)
    os.close(writer)
    async with probing(await robot_of(home, up)) as robot:
        await robot.pids()
        await robot.ticks(25)
        up.send(signal.SIGINT)
        assert await up.ended() == 0
    assert up.err == ""


async def test_a_blocked_terminal_delays_neither_restarts_nor_the_end(
    home: Home,
) -> None:
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(writer, bytes(4096))  # until the pipe is full
    os.set_blocking(writer, True)
    up = home.start("up", str(home.deployment()), stdout=writer)
    os.close(writer)
    async with probing(await robot_of(home, up)) as robot:
        pid = (await robot.pids())["decision"]
        os.kill(pid, signal.SIGKILL)
        for _ in range(500):
            if await robot.pid("decision") != pid:
                break
            await asyncio.sleep(0.02)
        assert await robot.pid("decision") != pid
        up.send(signal.SIGINT)
        assert await up.ended() == 0
    os.close(reader)
    assert (up.err, home.processes()) == ("", [])


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
async def test_up_ends_cleanly_by_signal_or_when_its_terminal_is_closed(
    home: Home, number: signal.Signals
) -> None:
    terminal, side = os.openpty()
    inherited = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # nohup may have ignored it
    up = home.start("up", str(home.deployment()), stdout=side)
    signal.signal(signal.SIGHUP, inherited)
    os.close(side)
    async with probing(await robot_of(home, up)) as robot:
        await robot.pids()
    os.close(terminal)  # later writes of the command fail
    up.send(number)
    assert await up.ended() == 0
    assert (up.err, home.processes()) == ("", [])


async def test_repeated_ctrl_c_does_not_disturb_the_end(home: Home) -> None:
    up = home.start("up", str(home.deployment()))
    await until(lambda: len(ready(up)) == 6, "six processes are ready")
    for _ in range(5):
        up.send(signal.SIGINT)
        await asyncio.sleep(0.02)
    assert await up.ended() == 0
    assert (up.err, home.processes()) == ("", [])


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Home]:
    """Return a home with 128 kB of disk, which ends with the last process that sees it."""
    script = f'mount -t tmpfs -o size=128k none {tmp_path}/home/state && exec "$@"'
    inside = ("unshare", "--mount", "--", "sh", "-c", script, "sh")
    (tmp_path / "home" / "state").mkdir(parents=True)
    if subprocess.run((*inside, "true"), capture_output=True).returncode:
        pytest.skip("no disk of its own here; mounting one needs root")
    home = Home(tmp_path / "home", inside)
    yield home
    home.close()


@pytest.mark.slow
async def test_a_full_disk_is_reported_once_and_stops_no_process(small_disk: Home) -> None:
    file = small_disk.deployment(resume="auto")
    up = small_disk.start("up", str(file), "--level", "debug")
    async with probing(endpoint_of(file)) as robot:
        await robot.driving_straight(0.15, room=0.0)
        full = re.compile(
            r"^\S+ driver +warning +cannot write \S+/driver.jsonl: .*No space left.*$", re.M
        )
        await until(lambda: full.search(up.out), "it says that the disk is full")
        await robot.ticks(100)
        await until(lambda: robot.state.gate.mode == "enabled", "it drives on")
        assert len(full.findall(up.out)) == 1
    up.send(signal.SIGINT)
    assert await up.ended() == 0
    assert up.err == ""


async def test_no_process_survives_the_death_of_up_not_even_a_frozen_one(home: Home) -> None:
    file = home.deployment()
    up = home.start("up", str(file))
    async with probing(endpoint_of(file)) as robot:
        os.kill(await robot.pid("control"), signal.SIGSTOP)
        await until(lambda: len(home.processes()) == 6, "all have started")
        up.send(signal.SIGKILL)
        await until(lambda: not home.processes(), "no orphan is left")


async def test_the_hosts_of_a_deployment_form_one_robot(home: Home) -> None:
    ours = (ROOT / "deploy" / "three_hosts.yaml").read_text()
    where = f"tcp/127.0.0.1:{free_port()}"
    file = home.folder / "three_hosts.yaml"
    here = re.sub(r"router: tcp/\S+", f"router: {where}", ours)
    file.write_text(re.sub(r"keys: .*", "", here))  # loopback needs no keys
    brain = home.start("up", str(file), "--host", "brain")
    body = home.start("up", str(file), "--host", "robot")
    async with probing(Endpoint(connect=(where,))) as robot:
        await until(lambda: len(ready(brain)) == 3 and len(ready(body)) == 4, "all are ready")
        assert sorted(ready(brain)) == ["decision", "perception", "relay"]
        person = Robot(robot.bus)
        await robot.ticks(30)
        await person.release()
        await robot.driving_straight(speed=0.15, room=0.0, by_hand=True)
        os.kill(brain.pid, signal.SIGKILL)  # stands for the loss of the host
        await robot.at_rest()
        assert robot.state.gate.mode in ("stopping", "idle")


@pytest.mark.parametrize("name", ["demo", "deploy/demo.yaml", "three_hosts"])
async def test_the_shipped_deployments_can_be_read(home: Home, name: str) -> None:
    up = await home.run("up", name, "--host", "robto")
    known = {"three_hosts": "brain, operator, robot"}.get(name, "robot")
    assert up.err.endswith(f"known: {known}\n")
    assert await up.ended() == 2


async def test_of_several_hosts_one_must_be_chosen(home: Home) -> None:
    up = await home.run("up", "three_hosts")
    assert "--host: robot, brain, operator\n" in up.err
    assert await up.ended() == 2


@pytest.mark.parametrize(
    ("text", "line", "named"),
    [
        ("wrold: arena", 1, "world"),
        ("decision:\n  settings: {turn: rihgt}", 2, "turn"),
        ("body: turtlebot3_wafle", 1, "turtlebot3_waffle"),
        ("seed: 3\nworld: hose", 2, "house"),
        ("decision:\n  behaviour: avod", 2, "avoid"),
    ],
)
async def test_errors_in_a_deployment_file_have_its_line(
    home: Home, text: str, line: int, named: str
) -> None:
    file = home.folder / "robot.yaml"
    file.write_text(f"{text}\nrouter: tcp/127.0.0.1:{free_port()}\n")
    up = await home.run("up", str(file))
    assert await up.ended() == 2
    assert up.err.startswith(f"gigabrain: {file}:{line}: ")
    assert named in up.err
    assert up.err.count("\n") == 1
    assert home.processes() == []


@pytest.mark.slow
async def test_a_port_in_use_is_reported_in_one_line(home: Home) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        where = f"tcp/127.0.0.1:{other.getsockname()[1]}"
        up = home.start("up", str(home.deployment(router=where)))
        router = await home.run("router", "--listen", where)
        taken = f"the router's port is taken ({where}); stop what uses it, or choose another"
        assert (await router.ended(), router.err.count("\n"), taken in router.err) == (1, 1, True)
        assert await up.ended() == 1
        assert up.err == f"gigabrain: {taken}\n"
        assert up.out.count(taken) == 1


@pytest.mark.parametrize("where", ["state", "run", "run_dir", "state-dir"])
async def test_an_unwritable_folder_is_reported_in_one_line(home: Home, where: str) -> None:
    """A file is in the place of the folder, which also stops root."""
    place = home.folder / where
    place.write_text("")
    router = ("--connect", f"tcp/127.0.0.1:{free_port()}")
    commands: dict[str, tuple[str, ...]] = {
        "state": ("up", str(home.deployment())),
        "run": (*AVOID, "--headless", "--seconds", "1"),
        "run_dir": ("perception", "--run-dir", str(place), *router),
        "state-dir": ("driver", "run", "mock", "--state-dir", str(place)),
    }
    if where == "state-dir":
        listen = f"tcp/127.0.0.1:{free_port()}"
        home.start("router", "--listen", listen)
        commands[where] += ("--connect", listen)
    command = await home.run(*commands[where])
    assert await command.ended() == 2
    assert "cannot write" in command.err
    assert str(place) in command.err
    assert command.err.count("\n") == 1
