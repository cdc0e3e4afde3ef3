"""The safe state of a body is taken up whichever way its driver ends."""

import asyncio
from pathlib import Path

import pytest
from msgspec.structs import replace

from gigabrain_drivers.bodies.mock.driver import MockBody, MockOptions
from gigabrain_drivers.driver import process
from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_drivers.driver.robot import Run
from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import RobotState, SafeState
from gigabrain_zenoh.config.settings import DriverConfig
from gigabrain_zenoh.errors import BodyLost, ConfigError
from gigabrain_zenoh.testing.in_memory import Net


class Arm(MockBody):
    """Comes to rest within two looks at it, and says what was done to it."""

    def __init__(self, state: SafeState) -> None:
        robot = replace(load_robot("mock"), safe_state=state)
        super().__init__(robot, MockOptions(driver="mock"), Run(folder=Path()))
        self.done: list[str] = []
        self.moving = 2
        self.lost = False

    async def read_state(self) -> RobotState:
        self.moving -= 1
        self.done.append("look")
        speed = Velocity(linear_x=0.2 if self.moving >= 0 else 0.0)
        return replace(await super().read_state(), velocity=speed)

    async def stop(self) -> None:
        self.done.append("stop")

    async def hold(self) -> None:
        self.done.append("hold")

    async def park(self) -> None:
        self.done.append("park")
        if self.lost:
            raise BodyLost("it is gone")

    async def limp(self) -> None:
        self.done.append("limp")

    async def close(self) -> None:
        self.done.append("close")


EXPECTED: dict[SafeState, list[str]] = {
    "stop": ["stop", "close"],
    "hold": ["hold", "close"],
    "park": ["stop", "look", "look", "look", "park", "close"],
    "limp": ["stop", "look", "look", "look", "limp", "close"],
}


@pytest.mark.parametrize("state", EXPECTED)
async def test_it_is_taken_up_at_the_end_of_the_block_once_the_body_rests(state: SafeState) -> None:
    async with Arm(state) as arm:
        pass
    assert arm.done == EXPECTED[state]


async def test_an_exception_and_a_cancellation_lead_to_it_too() -> None:
    arm = Arm("park")
    with pytest.raises(ZeroDivisionError):
        async with arm:
            raise ZeroDivisionError
    assert arm.done[-2:] == ["park", "close"]

    cancelled, inside = Arm("limp"), asyncio.Event()

    async def work() -> None:
        async with cancelled:
            inside.set()
            await asyncio.sleep(60)

    task = asyncio.create_task(work())
    await inside.wait()
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert cancelled.done[-2:] == ["limp", "close"]


@pytest.mark.long
async def test_a_body_that_never_rests_is_not_waited_for_longer_than_braking_takes() -> None:
    async with Arm("limp") as arm:
        arm.moving = 1000
    assert arm.done == ["stop", *["look"] * 40, "limp", "close"]


async def test_a_body_that_is_lost_meanwhile_is_reported_and_closed(
    caplog: pytest.LogCaptureFixture,
) -> None:
    arm = Arm("park")
    async with arm:
        arm.lost = True
    assert arm.done[-2:] == ["park", "close"]
    assert "the body has stopped, but park could not be done: it is gone" in caplog.text


@pytest.mark.parametrize(
    ("state", "complaint"),
    [
        ("park", "safe_state: park is not supported by MockBody; expected one of: stop, hold"),
        ("limp", "safe_state: limp is not supported by MockBody; expected one of: stop, hold"),
    ],
)
async def test_a_driver_that_lacks_it_is_refused_at_the_start(
    tmp_path: Path, state: SafeState, complaint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = replace(load_robot("mock"), safe_state=state)
    body = MockBody(robot, MockOptions(driver="mock"), Run(folder=Path()))
    monkeypatch.setattr(process, "make_driver", lambda name, run: (robot, body))
    config, never = DriverConfig(body="mock", state_dir=str(tmp_path)), Ready()
    with pytest.raises(ConfigError, match=f"^{complaint}$"):
        await process.run(config, Net().one, never)
    assert not never.called


class Ready:
    """A `ready` callback that records whether it was called."""

    called = False

    def __call__(self) -> None:
        self.called = True


async def test_a_driver_that_is_cancelled_on_its_way_to_the_safe_state_is_closed() -> None:
    arm = Arm("park")
    arm.moving = 1000

    async def end() -> None:
        async with arm:
            pass

    ending = asyncio.ensure_future(end())
    while "look" not in arm.done:  # noqa: ASYNC110 - it waits for the body to rest
        await asyncio.sleep(0)
    ending.cancel()
    await asyncio.wait((ending,))
    assert ending.cancelled()
    assert arm.done[-1] == "close"


@pytest.mark.parametrize("world", ["../../etc/passwd", "hosue", "random:x"])
async def test_a_simulated_driver_takes_no_world_that_there_is_not(
    world: str, tmp_path: Path
) -> None:
    config = DriverConfig(body="mock", world=world, state_dir=str(tmp_path))
    with pytest.raises(ConfigError, match=f"^no world '{world}'"):
        await process.run(config, Net().one, Ready())
