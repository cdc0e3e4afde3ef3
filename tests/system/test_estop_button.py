"""An e-stop button: open contact, lost adapter, wrong echo, dead process."""

import asyncio
import itertools
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest

from gigabrain_drivers.driver import button
from gigabrain_drivers.driver.button import Button, ButtonWatch, EchoLoop
from gigabrain_drivers.emulators.ports import Pty
from gigabrain_schemas.body import GateStatus
from gigabrain_schemas.requests import EstopRequest, GateReply
from gigabrain_schemas.safety import ButtonState
from gigabrain_schemas.topics import BUTTON, ESTOP
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.settings import ButtonConfig
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.launch.deployment import Deployment
from gigabrain_zenoh.launch.specs import process_specs
from gigabrain_zenoh.testing.in_memory import Net, RobotInMemory

MS = 1_000_000
OPEN_TEXT = "the contact is open, or its wire is broken"
WRONG_TEXT = "other bytes come back than were sent"


def counting() -> Callable[[int], bytes]:
    """Return a source of bytes that count up, in place of random ones."""
    numbers = itertools.count()
    return lambda size: bytes(next(numbers) % 256 for _ in range(size))


def closed(loop: EchoLoop, begin_ms: int, end_ms: int) -> None:
    """Let the contact be closed from `begin_ms` to `end_ms`."""
    for now_ms in range(begin_ms, end_ms, 20):
        loop.check_echo(loop.next_bytes(now_ms * MS), (now_ms + 5) * MS)


def test_a_closed_contact_echoes_the_sent_bytes() -> None:
    loop = EchoLoop(counting())
    assert loop.problem(0) == OPEN_TEXT
    closed(loop, 0, 100)
    assert loop.problem(100 * MS) == ""


def test_an_open_contact_is_reported_after_200_ms() -> None:
    loop = EchoLoop(counting())
    closed(loop, 0, 100)  # the last bytes left at 80 ms
    for now in range(100, 281, 20):
        loop.next_bytes(now * MS)
    assert loop.problem(280 * MS) == ""
    assert loop.problem(281 * MS) == OPEN_TEXT


def test_a_late_echo_does_not_count() -> None:
    loop = EchoLoop(counting())
    loop.check_echo(loop.next_bytes(0), 201 * MS)
    assert loop.problem(201 * MS) == OPEN_TEXT


def test_a_wrong_byte_counts_as_pressed_for_at_least_200_ms() -> None:
    loop = EchoLoop(counting())
    closed(loop, 0, 100)
    data = loop.next_bytes(100 * MS)
    loop.check_echo(bytes([data[0] ^ 1, data[1]]), 105 * MS)
    assert loop.problem(105 * MS) == WRONG_TEXT
    assert loop.next_bytes(120 * MS) == b""
    assert loop.problem(304 * MS) == WRONG_TEXT
    assert loop.problem(305 * MS) == OPEN_TEXT
    closed(loop, 305, 330)
    assert loop.problem(330 * MS) == ""


def test_unexpected_bytes_count_as_pressed() -> None:
    loop = EchoLoop(counting())
    closed(loop, 0, 100)
    loop.check_echo(b"\x00", 110 * MS)
    assert loop.problem(110 * MS) == WRONG_TEXT


def test_a_reopened_port_counts_as_pressed_until_an_echo() -> None:
    loop = EchoLoop(counting())
    closed(loop, 0, 100)
    loop.opened()
    assert loop.problem(100 * MS) == OPEN_TEXT


def test_the_sent_bytes_are_random() -> None:
    loop = EchoLoop()
    assert len({loop.next_bytes(now) for now in range(100)}) > 90


class Rig:
    """A button on a pty whose contact the test sets, and a fake driver that may latch."""

    def __init__(self, folder: Path) -> None:
        network, clock = LocalNetwork(), Clock()
        self.robot = Bus(network.transport(), clock, "driver")
        self.check_echo: list[ButtonState] = []
        self.asked: list[EstopRequest] = []
        self.latches = True
        self.robot.subscribe(BUTTON, lambda _key, state: self.check_echo.append(state))
        self.robot.serve(ESTOP, self._stop)
        self.pty = Pty(folder / "button")
        self.closed = True
        self.pty.on_bytes = self._contact
        self.pty.plug()
        bus = Bus(network.transport(), clock, "button")
        self.button = Button(ButtonConfig(port=str(folder / "button")), bus)
        self.task = asyncio.create_task(self.button.run(lambda: None))

    def _contact(self, data: bytes) -> None:
        if self.closed:
            self.pty.write(data)

    async def _stop(self, request: EstopRequest) -> GateReply:
        self.asked.append(request)
        mode = GateStatus(mode="latched" if self.latches else "enabled")
        return GateReply(ok=True, text="", robot_type="mock", gate=mode)

    async def until(self, condition: Callable[[], object]) -> None:
        async with asyncio.timeout(20):
            while not condition():  # noqa: ASYNC110
                await asyncio.sleep(0.005)

    async def wait_for_text(self, text: str) -> None:
        """Wait until the button reports this text, and is pressed unless the text is empty."""
        await self.until(lambda: self.check_echo and text in self.check_echo[-1].text)
        await self.until(lambda: self.check_echo[-1].pressed == bool(text))


@pytest.fixture
async def rig(tmp_path: Path) -> AsyncIterator[Rig]:
    rig = Rig(tmp_path)
    await rig.until(lambda: rig.check_echo and not rig.check_echo[-1].pressed)
    rig.asked.clear()
    yield rig
    rig.task.cancel()
    await asyncio.gather(rig.task, return_exceptions=True)
    rig.pty.unplug()


async def test_an_open_contact_requests_an_estop_and_a_closed_one_releases_nothing(
    rig: Rig,
) -> None:
    rig.closed = False
    await rig.wait_for_text(OPEN_TEXT)
    await rig.until(lambda: rig.asked)
    assert (rig.asked[0].source, rig.asked[0].reason) == ("button", OPEN_TEXT)
    rig.closed = True
    await rig.until(lambda: not rig.check_echo[-1].pressed)


async def test_an_error_during_the_estop_request_ends_the_process_and_frees_the_port(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def broken(*_: object) -> None:
        raise RuntimeError("a fault of ours")

    monkeypatch.setattr(button, "press_estop", broken)
    rig.closed = False
    with pytest.raises(ExceptionGroup) as raised:
        await asyncio.wait_for(rig.task, 20)
    assert [str(error) for error in raised.value.exceptions] == ["a fault of ours"]
    assert not rig.button._link.connected


async def test_the_estop_request_is_repeated_until_the_driver_latches(rig: Rig) -> None:
    rig.latches = rig.closed = False
    await rig.until(lambda: len(rig.asked) > 3)
    rig.latches = True
    await rig.wait_for_text(OPEN_TEXT)


async def test_an_unplugged_adapter_counts_as_pressed(rig: Rig) -> None:
    rig.pty.unplug()
    await rig.until(lambda: rig.check_echo[-1].pressed)
    await rig.until(lambda: rig.asked)
    rig.pty.plug()
    await rig.until(lambda: not rig.check_echo[-1].pressed)


async def test_foreign_bytes_on_the_line_count_as_pressed(rig: Rig) -> None:
    rig.pty.write(b"Linux login:")
    await rig.wait_for_text(WRONG_TEXT)
    await rig.until(lambda: rig.asked)


async def test_silence_of_a_button_seen_before_is_a_latching_cause() -> None:
    net, pressed = Net(), list[str]()
    watch = ButtonWatch(net.one, pressed.append)
    assert [(c.code, c.latching) for c in watch.faults()] == [("button_lost", False)]
    net.two.publish(BUTTON, ButtonState(pressed=False))
    assert watch.faults() == ()
    await net.clock.advance(200 * MS)
    assert watch.faults() == ()
    await net.clock.advance(1)
    assert [(c.code, c.latching) for c in watch.faults()] == [("button_lost", True)]
    net.two.publish(BUTTON, ButtonState(pressed=True, text="the contact is open"))
    net.two.publish(BUTTON, ButtonState(pressed=True, text="the contact is open"))
    assert [(c.code, c.latching) for c in watch.faults()] == [("button", True)]
    assert pressed == ["the contact is open"]


async def test_a_robot_with_a_button_moves_only_while_the_button_publishes(tmp_path: Path) -> None:
    async with RobotInMemory(tmp_path, button=True) as robot:

        async def publish_button(ticks: int, pressed: bool) -> list[float]:
            speeds: list[float] = []
            for _ in range(ticks // 2):
                robot.operator.publish(BUTTON, ButtonState(pressed=pressed))
                speeds += await robot.go(2)
            return speeds

        assert set(await robot.go(100)) == {0.0}
        assert robot.causes == ["boot", "button_lost"]
        assert (await publish_button(200, False))[-1] == pytest.approx(0.26)
        speeds = await robot.go(30)
        assert speeds[-1] == 0.0
        assert (robot.mode, "button_lost" in robot.causes) == ("latched", True)


def test_a_deployment_runs_the_button_beside_the_driver(tmp_path: Path) -> None:
    deployment = Deployment(button=ButtonConfig(port="/dev/ttyUSB0"))
    specs = {spec.name: spec for spec in process_specs(deployment, "robot", tmp_path, tmp_path)}
    assert '"settings":{"port":"/dev/ttyUSB0"}' in specs["button"].config
    assert '"button":true' in specs["driver"].config
    assert "button" not in {
        spec.name for spec in process_specs(Deployment(), "robot", tmp_path, tmp_path)
    }
    elsewhere = Deployment(
        button=ButtonConfig(port="auto"), hosts={"robot": ("driver",), "desk": ("button",)}
    )
    assert [s.name for s in process_specs(elsewhere, "robot", tmp_path, tmp_path)] == ["driver"]
    assert [s.name for s in process_specs(elsewhere, "desk", tmp_path, tmp_path)] == ["button"]
    for wrong in ({"hosts": {"desk": ("button",)}}, {"button": ButtonConfig(port="x"), "speed": 2}):
        with pytest.raises((ValueError, ConfigError)):
            Deployment(**wrong)  # type: ignore[arg-type]
