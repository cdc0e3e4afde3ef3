"""The gatekeeper in a whole robot in memory: commanders, e-stops, causes and the audit log."""

import asyncio
import itertools
import threading
from pathlib import Path

import msgspec
import pytest

from gigabrain_drivers.driver.gatekeeper import LatchFile
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.logs import AuditRecord
from gigabrain_schemas.requests import EnableRequest, EstopRequest, GateReply, ReleaseRequest
from gigabrain_schemas.topics import AUDIT, CMD_VEL, ENABLE, ESTOP, ESTOP_TOPIC, RELEASE
from gigabrain_zenoh.runtime.audit import read_audit
from gigabrain_zenoh.testing.in_memory import RobotInMemory
from gigabrain_zenoh.testing.samples import TICK_NS


class Log:
    """The audit log of a robot, as others hear it."""

    def __init__(self, robot: RobotInMemory) -> None:
        self._records: list[AuditRecord] = []
        robot.operator.subscribe(AUDIT, lambda _key, record: self._records.append(record))

    def of(self, *what: str) -> list[tuple[str, str, bool, str]]:
        return [(r.what, r.source, r.ok, r.text) for r in self._records if r.what in what]


async def enable(robot: RobotInMemory, source: str, take: bool = False, by: str = "") -> GateReply:
    [reply] = await robot.operator.ask(ENABLE, EnableRequest(source=source, take=take, by=by))
    return reply


async def driving(robot: RobotInMemory) -> None:
    for _ in range(20):
        if (await robot.go(10))[-1] == pytest.approx(0.26):
            return
    raise AssertionError(robot.causes)


async def test_whoever_just_publishes_commands_is_not_obeyed_counted_and_named(
    tmp_path: Path,
) -> None:
    async with RobotInMemory(tmp_path) as robot:
        log = Log(robot)
        await driving(robot)
        for _ in range(50):
            robot.operator.publish(CMD_VEL, CmdVel(linear_x=-0.2, source="stranger"))
            assert await robot.go(1) == pytest.approx([0.26])
        assert log.of("refused") == [
            (
                "refused", "stranger", False,
                "its commands are not obeyed (commander); control drives",
            )
        ]  # fmt: skip
        assert robot.counters["refused_commander"] == 50
        assert robot.state
        assert robot.state.gate.commander == "control"


async def test_a_second_commander_is_told_who_drives_and_a_take_over_names_both(
    tmp_path: Path,
) -> None:
    async with RobotInMemory(tmp_path) as robot:
        log = Log(robot)
        await driving(robot)
        reply = await enable(robot, "ann")
        assert (reply.ok, reply.text) == (
            False,
            "control drives; take it over with --take (in a script take=True)",
        )
        assert (await enable(robot, "ann", take=True)).ok
        reply = await enable(robot, "control", take=True)
        assert (reply.ok, reply.text) == (False, "ann drives; only a person can enable the brain")
        assert (await enable(robot, "control", take=True, by="bob")).ok
        assert log.of("enable", "take") == [
            (
                "enable",
                "ann",
                False,
                "control drives; take it over with --take (in a script take=True)",
            ),
            ("take", "ann", True, "ann drives, taken over from control"),
            ("enable", "control", False, "ann drives; only a person can enable the brain"),
            ("take", "bob", True, "control drives, taken over from ann"),
        ]


@pytest.mark.long
@pytest.mark.parametrize(
    "payload", [b"", b"{}", b"\x80", b'{"source": "ann", "reason": "a child"}']
)
async def test_an_e_stop_that_is_said_and_not_asked_for_stops_just_the_same(
    tmp_path: Path, payload: bytes
) -> None:
    async with RobotInMemory(tmp_path) as robot:
        await driving(robot)
        client = robot.network.transport()
        client.publish(ESTOP_TOPIC, "robot/estop", payload, "")
        assert (await robot.go(1))[-1] == 0.0
        assert robot.mode == "latched"
    assert LatchFile(tmp_path).read().estop_generation == 1


async def test_garbage_that_is_said_on_the_key_of_the_e_stop_stops_nobody(tmp_path: Path) -> None:
    async with RobotInMemory(tmp_path) as robot:
        await driving(robot)
        for payload in (b"\xc1", b"{", b'{"source": 3}', b"x" * 2000):
            robot.network.transport().publish(ESTOP_TOPIC, "robot/estop", payload, "")
        assert (await robot.go(5))[-1] == pytest.approx(0.26)


async def test_an_e_stop_is_on_disk_when_it_is_confirmed(tmp_path: Path) -> None:
    async with RobotInMemory(tmp_path) as robot:
        await driving(robot)
        [reply] = await robot.operator.ask(ESTOP, EstopRequest(source="ann", reason="a child"))
        assert (reply.ok, reply.gate.mode, reply.gate.estop_generation) == (True, "latched", 1)
        on_disk = LatchFile(tmp_path).read()
        assert (on_disk.estop_generation, on_disk.causes[0].code) == (1, "estop")
        assert await robot.go(1) == [0.0]
    entries = read_audit(tmp_path, 1000)
    assert [(e.what, e.source, e.text) for e in entries if e.what == "estop"] == [
        ("estop", "ann", "stopped and latched; e-stop number 1, a child")
    ]
    assert (entries[0].what, entries[-1].what) == ("boot", "end")


@pytest.mark.long
async def test_a_disk_that_hangs_holds_up_the_confirmation_and_no_tick(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with RobotInMemory(tmp_path) as robot:
        await driving(robot)
        wakes = threading.Event()
        monkeypatch.setattr("os.fsync", lambda _fd: wakes.wait(10.0))
        asking = asyncio.create_task(robot.operator.ask(ESTOP, EstopRequest(source="ann")))
        assert (await robot.go(50))[1:] == [0.0] * 49
        assert robot.mode == "latched"
        assert not asking.done()
        wakes.set()
        [reply] = await asking
        assert (reply.ok, reply.gate.mode, reply.gate.estop_generation) == (True, "latched", 1)


@pytest.mark.long
async def test_a_disk_that_takes_nothing_stops_no_e_stop_and_is_reported(tmp_path: Path) -> None:
    async with RobotInMemory(tmp_path) as robot:
        await driving(robot)
        (tmp_path / ".latch.json.new").mkdir()  # where the file would be written first
        [reply] = await robot.operator.ask(ESTOP, EstopRequest(source="ann"))
        assert reply.gate.mode == "latched"
        assert "; but a restart would lose it: cannot write" in reply.text
        assert await robot.go(100) == [0.0] * 100
        (tmp_path / ".latch.json.new").rmdir()
        await robot.go(100)  # tried again once a second
        request = ReleaseRequest(estop_generation=1, source="ann")
        [reply] = await robot.operator.ask(RELEASE, request)
        assert (reply.ok, reply.gate.mode) == (True, "idle")
        assert LatchFile(tmp_path).read().estop_generation == 1


@pytest.mark.long
async def test_causes_are_written_down_when_they_come_and_go_with_who_raised_them(
    tmp_path: Path,
) -> None:
    async with RobotInMemory(tmp_path) as robot:
        log = Log(robot)
        await driving(robot)
        robot.freeze("control")
        await robot.go(30)
        robot.thaw("control")
        await driving(robot)
        seen = [(what, source) for what, source, _, text in log.of("raised", "cleared")]
        assert ("raised", "gate") in seen
        assert ("cleared", "gate") in seen
        assert [text for _, _, _, text in log.of("mode")][-3:-1][0].startswith(
            "enabled -> stopping"
        )
    assert msgspec.json.decode((tmp_path / "latch.json").read_bytes())["causes"] == []


async def test_a_driver_that_was_held_up_keeps_its_count_and_speeds_up_by_one_step(
    tmp_path: Path,
) -> None:
    async with RobotInMemory(tmp_path) as robot:
        while not 0.0 < (await robot.go(1))[-1] < 0.1:
            pass
        assert robot.state
        tick, now = robot.state.tick, robot.clock.now_ns()
        robot.clock.stall(3 * TICK_NS)
        speeds = await robot.go(20)
        passed = (robot.clock.now_ns() - now) // TICK_NS
        assert (robot.mode, robot.state.tick - tick) == ("enabled", passed)
        steps = [after - before for before, after in itertools.pairwise(speeds)]
        assert max(steps) == pytest.approx(0.02)
        assert speeds[-1] == pytest.approx(0.26)


async def test_a_driver_that_was_held_up_stops_the_body_as_soon_as_it_goes_on(
    tmp_path: Path,
) -> None:
    async with RobotInMemory(tmp_path) as robot:
        await driving(robot)
        robot.clock.stall(40 * TICK_NS)
        assert (await robot.go(1))[-1] == 0.0
