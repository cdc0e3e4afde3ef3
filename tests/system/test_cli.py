"""The `gigabrain` command: help, misspelt names, and start-up cost."""

import asyncio
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import pytest
from cyclopts import App

from gigabrain_drivers.driver.catalog import robot_files
from gigabrain_zenoh.cli.app import COMMANDS, PARENTS, make_app
from gigabrain_zenoh.testing.processes import GIGABRAIN, Home, free_port

# importing any of these takes longer than all the rest of `gigabrain --help`
HEAVY = {"numpy", "zenoh", "mujoco", "asyncio", "yaml", "rich.markdown", "importlib.metadata"}


def words(app: App, prefix: str = "") -> Iterator[str]:
    """Return every command with its group."""
    for name in app:
        if name.startswith("-"):
            continue
        if app[name].default_command:
            yield f"{prefix}{name}"
        yield from words(app[name], f"{prefix}{name} ")


def test_the_table_of_commands_is_complete() -> None:
    assert sorted(words(make_app(tuple(PARENTS)))) == sorted(COMMANDS)


def test_help_imports_no_heavy_package() -> None:
    done = subprocess.run(
        (sys.executable, "-X", "importtime", *GIGABRAIN[1:], "--help"),
        capture_output=True,
        text=True,
        check=True,
    )
    imported = {line.rpartition("|")[2].strip() for line in done.stderr.splitlines()}
    assert "cyclopts" in imported
    assert imported & HEAVY == set()
    for name in ("demo", "up", "driver", "estop", "robots", "worlds"):
        assert re.search(rf"^│ {name} +[A-Z]", done.stdout, re.MULTILINE)


async def test_the_version_is_that_of_the_package(home: Home) -> None:
    assert (await home.run("--version")).out == f"{version('gigabrain-zenoh')}\n"


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ("dmeo", "demo"),
        ("demo --wrold house", "--world"),
        ("demo --turn rihgt", "--turn"),
        ("demo --body wafle", "turtlebot3_waffle"),
        ("up dmeo", "demo"),
    ],
)
async def test_mistyped_arguments_are_refused_in_one_line(
    home: Home, arguments: str, named: str
) -> None:
    command = await home.run(*arguments.split())
    assert await command.ended() == 2
    assert named in command.err
    assert (command.err.startswith("gigabrain: "), command.err.count("\n")) == (True, 1)
    assert command.out == ""


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="by /dev/full")
@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize("words", ["robots", "--help", "demo --help", "completion bash"])
def test_an_output_to_a_full_disk_fails_in_one_line(words: str, unbuffered: str) -> None:
    with Path("/dev/full").open("w") as full:
        command = subprocess.run(
            (*GIGABRAIN, *words.split()),
            env=os.environ | {"PYTHONUNBUFFERED": unbuffered},
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert command.stderr == "gigabrain: cannot write: the disk is full; free some space\n"
    assert command.returncode == 1


@pytest.mark.parametrize(
    ("words", "code"), [("robots", 0), ("--help", 0), ("completion bash", 0), ("dmeo", 2)]
)
@pytest.mark.parametrize("stream", [1, 2])
def test_a_command_runs_with_a_closed_stream(stream: int, words: str, code: int) -> None:
    argv = [*GIGABRAIN, *words.split()]
    closing = f"import os, sys; os.close({stream}); os.execv(sys.executable, {argv})"
    command = subprocess.run(
        (sys.executable, "-c", closing), capture_output=True, text=True, check=False
    )
    assert command.returncode == code
    assert "Traceback" not in command.stderr
    assert bool(command.stdout) is (stream == 2 and code == 0)


@pytest.mark.parametrize("words", ["arm limp", "teleop"])
def test_a_question_without_an_input_is_refused_in_one_line(words: str) -> None:
    closing = (
        f"import os, sys; os.close(0); os.execv(sys.executable, {[*GIGABRAIN, *words.split()]})"
    )
    command = subprocess.run(
        (sys.executable, "-c", closing), capture_output=True, text=True, check=False
    )
    assert (command.returncode, command.stderr.count("\n")) == (2, 1)
    assert command.stderr.startswith(f"gigabrain: {words} needs ")


@pytest.mark.parametrize("closed", [(2,), (0, 1, 2)])
async def test_a_robot_runs_with_closed_streams(closed: tuple[int, ...], tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    argv = [
        *GIGABRAIN,
        *["demo", "--headless", "--behaviour", "avoid", "--seconds", "2", "--speed", "5"],
    ]
    argv += ["--report", str(report)]
    closing = f"import os, sys; [os.close(n) for n in {closed}]; os.execv(sys.executable, {argv})"
    process = await asyncio.create_subprocess_exec(sys.executable, "-c", closing)
    assert await process.wait() == 0
    assert json.loads(report.read_text())["sim_seconds"] == 2.0


async def test_robots_and_worlds_are_listed(home: Home) -> None:
    robots = (await home.run("robots")).out.splitlines()
    assert [line.split()[0] for line in robots] == list(robot_files())
    assert all(re.search(r"  \S.* \(sim.*\)  /.*robot\.yaml$", line) for line in robots)
    worlds = (await home.run("worlds")).out.splitlines()
    assert [line.split()[0] for line in worlds] == [
        "arena", "house", "kitchen", "playroom", "table", "warehouse", "random:SEED", "FILE",
    ]  # fmt: skip


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_shells_can_complete_commands_and_options(
    shell: str, capsys: pytest.CaptureFixture[str]
) -> None:
    make_app()(["completion", shell], result_action="return_value")
    script = capsys.readouterr().out
    assert all(word in script for word in ("demo", "perception", "world", "headless"))


async def test_message_schemas_are_exported(home: Home) -> None:
    folder = home.folder / "schemas"
    export = await home.run("schema", "export", str(folder))
    assert re.fullmatch(rf"\d+ files in {folder}\n", export.out)
    assert json.loads((folder / "LaserScan.json").read_bytes())
    (home.folder / "file").write_text("")
    refused = await home.run("schema", "export", str(home.folder / "file"))
    assert await refused.ended() == 2
    assert str(home.folder / "file") in refused.err


@pytest.mark.parametrize("command", ["release", "enable", "audit"])
async def test_without_a_robot_the_exit_code_is_1(home: Home, command: str) -> None:
    alone = await home.run(command)
    assert await alone.ended() == 1
    assert alone.err.count("\n") == 1


@pytest.mark.parametrize("where", [None, "tcp/127.0.0.1:{port}", "nowhere"])
async def test_an_e_stop_that_reaches_no_robot_is_not_confirmed(
    home: Home, where: str | None
) -> None:
    connect = ("--connect", where.format(port=free_port())) if where else ()
    unreachable = await home.run("estop", *connect)
    assert await unreachable.ended() == 3
    assert unreachable.err.startswith("gigabrain: NOT CONFIRMED: ")
    assert unreachable.err.count("\n") == 1
