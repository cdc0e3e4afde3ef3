"""The `gigabrain` command: help, names that are nearly right, and what it costs to ask."""

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import version

import pytest
from cyclopts import App

from gigabrain_zenoh.cli.app import COMMANDS, make_app
from gigabrain_zenoh.testing.processes import GIGABRAIN, Home, free_port

# takes longer than all the rest of `gigabrain --help` together
HEAVY = {"numpy", "zenoh", "mujoco", "asyncio", "yaml", "rich.markdown", "importlib.metadata"}


def words(app: App, prefix: str = "") -> Iterator[str]:
    """Every command with its group."""
    for name in app:
        if name.startswith("-"):
            continue
        inner = list(words(app[name], f"{prefix}{name} "))
        yield from inner or [f"{prefix}{name}"]


def test_the_table_of_commands_is_complete() -> None:
    assert sorted(words(make_app())) == sorted(COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_answers_help_with_an_example(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [*command.split(), "--help"]
    make_app(arguments)(arguments, result_action="return_value")
    said = capsys.readouterr().out
    assert said.startswith(f"Usage: gigabrain {command}")
    assert re.search(rf'^Example: (eval "\$\()?gigabrain {command}', said, re.MULTILINE)


def test_help_imports_nothing_that_takes_long() -> None:
    told = subprocess.run(
        (sys.executable, "-X", "importtime", *GIGABRAIN[1:], "--help"),
        capture_output=True,
        text=True,
        check=True,
    )
    imported = {line.rpartition("|")[2].strip() for line in told.stderr.splitlines()}
    assert "cyclopts" in imported
    assert imported & HEAVY == set()
    for name in ("demo", "up", "driver", "estop", "robots", "worlds"):
        assert re.search(rf"^│ {name} +[A-Z]", told.stdout, re.MULTILINE)


async def test_the_version_is_that_of_the_package(home: Home) -> None:
    assert (await home.run("--version")).out == f"{version('gigabrain-zenoh')}\n"


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ("dmeo", 'Unknown command "dmeo". Did you mean "demo"?'),
        ("driver rnu mock", 'Unknown command "rnu". Did you mean "run"?'),
        ("demo --wrold house", "Unknown option: --wrold. Did you mean --world?"),
        ("demo --behaviour avoid --set turn=rihgt", "got 'rihgt'; did you mean 'right'?"),
        ("demo --seed one", 'Invalid value for --seed: unable to convert "one" into int.'),
        ("demo --seed -3", "--seed: expected `int` >= 0"),
        ("patrol round.yaml --loops 1.5", "--loops: expected a whole number, got 1.5"),
        ("bench plan --size 100 --size 1e-3", "--size: expected a whole number, got 1e-3"),
        ("log -n 0.5", "--newest: expected a whole number, got 0.5"),
        ("demo --speed 1000", "--speed: expected `float` <= 100.0"),
        ("demo --seconds nan", "--seconds: expected a number above 0, got nan"),
        ("bench bodies --seconds 0", "--seconds: expected a number above 0, got 0"),
        ("faults --repeat 0", 'Invalid value "0" for --repeat'),
        ("demo --resume auto --link real", "resume: auto is for simulation"),
        ("demo --body wafle", "no robot 'wafle'; did you mean 'turtlebot3_waffle'? known: alpha,"),
        ("demo --body turtlebot3_wafle", "did you mean 'turtlebot3_waffle'?"),
        ("demo --world hose", "no world 'hose'; did you mean 'house'? known: arena, house,"),
        ("demo --world random:x", "random:SEED wants a whole number, as in random:7"),
        ("driver run mcok", "no robot 'mcok'; did you mean 'mock'? known: alpha, mock,"),
        ("driver run mock --speed 0", "--speed: expected `float` >= 0.1"),
        ("decision --behaviour avod", "no behaviour 'avod'; did you mean 'avoid'?"),
        ("decision --behaviour navigate --scripts /nowhere/beeps", "no folder '/nowhere/beeps'"),
        ("up dmeo", "no deployment 'dmeo'; did you mean 'demo'? known: demo, three_hosts"),
        ("up", 'Command "up" parameter --deployment requires an argument.'),
        ("completion fihs", 'Invalid value "fihs" for SHELL.'),
    ],
)
async def test_what_is_mistyped_is_refused_in_one_line(
    home: Home, arguments: str, complaint: str
) -> None:
    command = await home.run(*arguments.split())
    assert await command.ended() == 2
    assert complaint in command.err
    assert (command.err.startswith("gigabrain: "), command.err.count("\n")) == (True, 1)
    assert command.out == ""


async def test_robots_and_worlds_are_listed(home: Home) -> None:
    robots = (await home.run("robots")).out.splitlines()
    assert [line.split()[0] for line in robots] == [
        "alpha",
        "mock",
        "mycustombot",
        "turtlebot3_burger",
        "turtlebot3_waffle",
    ]
    assert all(re.search(r"  \S.* \(sim.*\)  /.*robot\.yaml$", line) for line in robots)
    worlds = (await home.run("worlds")).out.splitlines()
    assert [line.split()[0] for line in worlds] == ["arena", "house", "warehouse", "random:SEED"]


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
    assert refused.err == f"gigabrain: cannot write {home.folder / 'file'}: File exists\n"


@pytest.mark.parametrize("command", ["release", "enable", "audit"])
async def test_without_a_robot_it_says_so(home: Home, command: str) -> None:
    alone = await home.run(command)
    assert await alone.ended() == 1
    assert alone.err == (
        "gigabrain: no robot runs here; start one with `gigabrain demo`, or name its router\n"
    )


async def test_an_e_stop_that_reaches_nobody_says_so(home: Home) -> None:
    where = f"tcp/127.0.0.1:{free_port()}"
    unreachable = await home.run("estop", "--connect", where)
    assert await unreachable.ended() == 3
    assert unreachable.err == (
        f"gigabrain: NOT CONFIRMED: no router answers at {where}; is the robot running, and "
        "without keys?; press the hardware e-stop or cut the robot's power\n"
    )
    alone = await home.run("estop")
    assert await alone.ended() == 3
    assert alone.err.startswith("gigabrain: NOT CONFIRMED: no robot runs here; start one with")
    nowhere = await home.run("estop", "--connect", "nowhere")
    assert await nowhere.ended() == 3
    assert nowhere.err.startswith("gigabrain: NOT CONFIRMED: 'nowhere' is not a Zenoh endpoint; ")
