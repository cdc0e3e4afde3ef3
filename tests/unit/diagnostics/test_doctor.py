"""`gigabrain doctor`: what is broken on purpose is found, with its cure."""

import asyncio
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from gigabrain_schemas.base import Cause
from gigabrain_schemas.examples import example
from gigabrain_schemas.requests import Description
from gigabrain_schemas.safety import Health
from gigabrain_schemas.topics import HEALTH
from gigabrain_zenoh.diagnostics import doctor
from gigabrain_zenoh.diagnostics.doctor import (
    Certificate,
    Diagnosis,
    Folder,
    MachineFacts,
    Port,
    RobotFacts,
    examine,
    exit_code,
    inspect_machine,
)
from gigabrain_zenoh.testing.in_memory import Net
from tests.closed import close_folder

SENT = {
    "driver": {"robot/state": 50.0, "robot/scan": 10.0},
    "perception": {"robot/world": 10.0},
    "decision": {"robot/intent": 50.0},
    "control": {"robot/cmd_vel": 50.0},
    "safety": {"robot/safety": 25.0},
    "router": {},
}
MACHINE = MachineFacts(
    python=(3, 11, 7),
    system="Linux",
    libraries={"eclipse-zenoh": "1.10.2", "textual": "8.2.8"},
    folders=(Folder(path="/var/robot", writable=True, free_mb=9000),),
    ports=(),
    multicast=False,
)


def health(name: str, **other: Any) -> Health:
    told = replace(example(Health), process=name, sent_hz=SENT[name], rejected={}, cpu=0.03)
    told = replace(told, problems=())
    return replace(told, **other)


ROBOT = RobotFacts(
    router="tcp/127.0.0.1:7447",
    described={name: replace(example(Description), process=name) for name in SENT},
    health={name: health(name) for name in SENT},
    lead_ms={"waffle": 0.4},
    pace=1.0,
)
PORT = Port(path="/dev/ttyACM0", about="OpenCR", usb="0483:5740", usable=False)
EXPIRED = Certificate(folder="keys/red", problem="identity.crt expired on 2026-01-01")


def found(machine: MachineFacts = MACHINE, robot: RobotFacts = ROBOT) -> list[Diagnosis]:
    return [one for one in examine(machine, robot) if one.grade != "ok"]


@pytest.mark.parametrize(("name", "grade"), [("decision", "bad"), ("page", "hint")])
def test_processes_of_one_name_are_found(name: str, grade: str) -> None:
    robot = replace(ROBOT, namesakes={name: ("pid 7 on waffle", "pid 8 on desk")})
    (one,) = found(robot=robot)
    assert (one.grade, one.about) == (grade, name)
    assert one.text == "2 processes have this name: pid 7 on waffle, pid 8 on desk"


@pytest.mark.parametrize(
    ("pids", "both"),
    [((1, 1, 1), False), ((1, 1, 2, 2), False), ((1, 2, 1), True), ((1, 2, 2, 1), True)],
)
async def test_only_processes_that_report_in_turn_share_a_name(
    pids: tuple[int, ...], both: bool
) -> None:
    net = Net()
    facts = asyncio.ensure_future(doctor._collect(net.two, "", 0.05))
    await asyncio.sleep(0)
    for pid in pids:
        net.one.publish(HEALTH, health("decision", pid=pid, host="waffle"), name="decision")
    places = {"decision": ("pid 1 on waffle", "pid 2 on waffle")} if both else {}
    assert (await facts).namesakes == places


def test_what_a_process_reports_is_found_with_its_cure() -> None:
    problem = Cause(code="process_silent", text="mine died of KeyError", remedy="read its log")
    robot = replace(ROBOT, health={"router": health("router", problems=(problem,))})
    (one,) = [one for one in found(robot=robot) if one.cure == "read its log"]
    assert (one.grade, one.about, one.text) == ("bad", "router", "mine died of KeyError")


def test_a_healthy_machine_and_robot_have_only_good_results() -> None:
    assert found() == []
    assert exit_code(examine(MACHINE, ROBOT)) == 0


@pytest.mark.parametrize(
    ("change", "about", "words", "cure"),
    [
        ({"python": (3, 10, 2)}, "python", "3.10.2 is too old", "Python 3.11"),
        ({"libraries": {"numpy": None}}, "numpy", "is not installed", "pip install"),
        ({"libraries": {"eclipse-zenoh": "1.9.9"}}, "eclipse-zenoh", "1.9.9 is too old", ">=1.10"),
        (
            {"folders": (Folder(path="/v", writable=False, free_mb=9000),)},
            "folder", "cannot write to /v", "XDG_STATE_HOME",
        ),
        (
            {"folders": (Folder(path="/v", writable=True, free_mb=12),)},
            "disk", "12 MB free", "delete old runs",
        ),
        ({"ports": (PORT,)}, "serial", "/dev/ttyACM0", 'ATTRS{idVendor}=="0483"'),
        ({"ports": (PORT,)}, "serial", "0483:5740", "usermod -aG dialout"),
        ({"multicast": True}, "multicast", "scouting is on", "reinstall"),
        ({"certificate": EXPIRED}, "keys", "expired on 2026-01-01", "gigabrain keys issue"),
        (
            {"certificate": Certificate(folder="keys/red", name="robot@red", days_left=12.0)},
            "keys", "12 days left", "gigabrain keys issue",
        ),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_machine_is_found(
    change: dict[str, Any], about: str, words: str, cure: str
) -> None:
    (one,) = found(machine=replace(MACHINE, **change))
    assert (one.about, one.grade) == (about, "bad")
    assert words in one.text
    assert cure in one.cure


def test_a_library_that_one_can_do_without_is_a_hint_and_no_fault() -> None:
    (one,) = found(machine=replace(MACHINE, libraries={"textual": None}))
    assert one.grade == "hint"
    assert "pip install 'gigabrain-zenoh[view]'" in one.cure
    assert exit_code([one]) == 0


@pytest.mark.parametrize("name", SENT)
def test_a_process_that_is_gone_is_found(name: str) -> None:
    rest = {key: one for key, one in ROBOT.described.items() if key != name}
    told = {key: one for key, one in ROBOT.health.items() if key != name}
    (one,) = found(robot=replace(ROBOT, described=rest, health=told))
    assert (one.about, one.text) == (name, "does not answer")
    assert one.cure == f"start it, or read its log: gigabrain log --process {name}"


@pytest.mark.parametrize(
    ("change", "about", "words"),
    [
        ({"described": {**ROBOT.described, "safety": replace(example(Description), version="9")}},
         "versions", "the processes differ: 0.1.0, 9"),
        ({"health": {**ROBOT.health, "driver": health("driver", sent_hz={"robot/scan": 10.0})}},
         "robot/state", "0 Hz from driver, expected 50"),
        ({"health": {k: v for k, v in ROBOT.health.items() if k != "control"}},
         "control", "reports no health"),
        ({"lead_ms": {"waffle": 1800.0}}, "clock", "waffle is 1.8 s behind this one"),
        ({"lead_ms": {"waffle": -1800.0}}, "clock", "waffle is 1.8 s ahead of this one"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_robot_is_found(
    change: dict[str, Any], about: str, words: str
) -> None:
    (one,) = found(robot=replace(ROBOT, **change))
    assert (one.about, one.grade) == (about, "bad")
    assert words in one.text
    assert one.cure


@pytest.mark.parametrize(
    ("port_open", "words"),
    [(True, "Something listens on that port."), (False, "Nothing listens on that port.")],
)
def test_a_router_that_does_not_answer_is_found(port_open: bool, words: str) -> None:
    gone = RobotFacts(problem="no router answers.", router="tcp/127.0.0.1:1", port_open=port_open)
    (one,) = found(robot=gone)
    assert (one.about, one.text) == ("router", f"no router answers. {words}")


def test_that_no_robot_runs_is_no_fault_of_the_machine() -> None:
    (one,) = found(robot=RobotFacts(problem="no robot runs here; start one"))
    assert (one.grade, one.text) == ("hint", "no robot runs here; start one")


def test_of_several_robots_one_is_to_be_chosen() -> None:
    problem = "several robots run here; choose one with --connect: a, b"
    (one,) = found(robot=RobotFacts(problem=problem))
    assert (one.grade, one.text) == ("hint", problem)


def test_a_slow_simulation_is_no_slow_robot() -> None:
    slow = {
        name: health(name, sent_hz={k: v * 0.2 for k, v in SENT[name].items()}) for name in SENT
    }
    assert found(robot=replace(ROBOT, health=slow, pace=0.2)) == []


def test_invalid_messages_and_a_busy_process_are_hints() -> None:
    busy = {**ROBOT.health, "driver": health("driver", cpu=0.97, rejected={"robot/cmd_vel": 4})}
    told = found(robot=replace(ROBOT, health=busy))
    assert [(one.about, one.grade) for one in told] == [
        ("robot/cmd_vel", "hint"),
        ("driver", "hint"),
    ]
    assert "4 invalid messages" in told[0].text


def test_a_state_folder_that_this_user_may_not_enter_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed = tmp_path / "closed"
    closed.mkdir()
    monkeypatch.setenv("XDG_STATE_HOME", str(closed / "inner"))
    close_folder(closed, monkeypatch)
    state = inspect_machine().folders[0]
    assert (state.path, state.writable) == (str(closed / "inner" / "gigabrain"), False)
