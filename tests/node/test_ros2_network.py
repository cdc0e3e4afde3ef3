"""The driver of a ROS 2 robot on a machine whose network changes."""

from pathlib import Path

import pytest

from gigabrain_drivers.bodies.ros2 import link
from gigabrain_zenoh.testing.waiting import until
from tests.node.test_ros2_driver import Bench, options_with, running

WLAN = {"10.9.9.1"}


async def joins_again(bench: Bench) -> bool:
    """Advance the clock by 3 s; return whether the driver has joined again."""
    before = bench.driver.link.transport
    for _ in range(30):
        await bench.pass_ms(100)
    await until(lambda: bench.driver.link.transport, "the driver's node")
    return bench.driver.link.transport is not before


@pytest.mark.parametrize(("transport", "joined"), [("dds", True), ("rmw_zenoh", False)])
async def test_a_driver_without_a_robot_joins_again_in_another_network(
    transport: str, joined: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(link, "outer_addresses", set)
    router = {"router": "tcp/127.0.0.1:7447"} if transport == "rmw_zenoh" else {}
    async with running(options_with(transport=transport, **router)) as bench:
        await bench.robot.die()
        assert not await joins_again(bench)
        monkeypatch.setattr(link, "outer_addresses", lambda: WLAN)
        assert await joins_again(bench) is joined
        assert not await joins_again(bench)
        bench.robot.start()
        assert await bench.found_after_ms() <= 500


async def test_a_driver_with_a_robot_does_not_join_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link, "outer_addresses", set)
    async with running() as bench:
        await bench.found_after_ms()
        monkeypatch.setattr(link, "outer_addresses", lambda: WLAN)
        assert not await joins_again(bench)
        await bench.robot.die()
        assert await joins_again(bench)


async def test_a_driver_follows_an_emulator_to_its_new_address(tmp_path: Path) -> None:
    file = tmp_path / "base"
    file.write_text('{"domain": 150}')
    async with running(options_with(port=str(file))) as bench:
        await bench.found_after_ms()
        assert not await joins_again(bench)
        file.unlink()  # as while it is unplugged
        assert not await joins_again(bench)
        file.write_text('{"domain": 151}')
        assert await joins_again(bench)
        assert not await joins_again(bench)
        assert await bench.found_after_ms() <= 500
