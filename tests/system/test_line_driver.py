"""A body driven by text templates, on a real pty: it obeys, stops, and never gets old bytes."""

import asyncio
import math
from pathlib import Path

import pytest

from gigabrain_drivers.emulators.faults import NO_FAULTS, Faults
from gigabrain_drivers.links import serial_link
from gigabrain_schemas.base import Velocity
from gigabrain_zenoh.errors import BodyLost
from gigabrain_zenoh.testing.line import BARE, bench
from gigabrain_zenoh.testing.waiting import until

ZERO = Velocity()
STARTED = BARE.replace(
    "  ticks_per_turn", '  start: "ENABLE\\n"\n  stop: "DISABLE\\n"\n  ticks_per_turn'
)


async def test_it_drives_as_commanded_and_reports_its_motion(tmp_path: Path) -> None:
    async with bench(tmp_path) as it:
        await it.drive_until(
            lambda state: it.body.commanded == (0.3, 0.0, 0.6)
            and abs(state.velocity.linear_x - 0.3) < 0.03
            and abs(state.velocity.angular_z - 0.6) < 0.06
            and state.pose.x > 0.1,
            0.3, 0.6,
        )  # fmt: skip
        await it.driver.stop()
        state, true = await it.at_rest(), it.body.snapshot.odometry
        assert state.pose.yaw == pytest.approx(true.yaw, abs=0.005)
        assert [joint.name for joint in state.joints] == ["wheel_left_joint", "wheel_right_joint"]
        assert state.link.connected
        assert state.link.errors == 0


async def test_it_returns_the_written_velocity(tmp_path: Path) -> None:
    async with bench(tmp_path) as it:
        sent = await it.driver.set_base_velocity(0.12345, 0.3, 9.0)
        assert sent == Velocity(linear_x=0.123, linear_y=0.0, angular_z=1.2)
        await until(lambda: it.firmware.executed and it.firmware.executed[-1] == sent)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
async def test_nan_in_one_axis_sets_all_axes_to_zero(tmp_path: Path, bad: float) -> None:
    async with bench(tmp_path) as it:
        await it.driver.set_base_velocity(0.2, 0.0, 0.0)
        assert await it.driver.set_base_velocity(0.2, 0.0, bad) == ZERO
        await until(lambda: it.body.commanded == (0.0, 0.0, 0.0))


@pytest.mark.parametrize("text", [BARE, STARTED])
async def test_it_writes_nothing_until_the_body_reports_and_then_zero(
    tmp_path: Path, text: str
) -> None:
    async with bench(tmp_path, text, plugged=False) as it:
        written: list[bytes] = []
        it.driver.link.trace = lambda way, data: written.append(data) if way == "tx" else None
        assert await it.driver.set_base_velocity(0.2, 0.0, 0.0) == ZERO
        it.station.set(Faults(silence=True))
        await until(lambda: it.driver.link.connected)
        assert await it.driver.set_base_velocity(0.2, 0.0, 0.0) == ZERO
        assert written == []
        it.station.set(NO_FAULTS)
        await until(lambda: written)
        assert written == [b"V,0.000,0.000\n"]
        assert (await it.driver.set_base_velocity(0.2, 0.0, 0.0)).linear_x == 0.2


async def test_without_commands_the_line_is_silent_and_the_firmware_stops(
    tmp_path: Path,
) -> None:
    async with bench(tmp_path) as it:
        await it.drive(0.1, 0.2)
        before = len(it.firmware.executed)
        await until(lambda: it.body.commanded == (0.0, 0.0, 0.0))
        assert len(it.firmware.executed) <= before + 1  # the firmware stops it, not a command


async def test_an_unplugged_body_is_lost_at_once_and_gets_zero_when_it_returns(
    tmp_path: Path,
) -> None:
    async with bench(tmp_path) as it:
        await it.drive(0.1, 0.2)
        it.station.set(Faults(unplugged=True))
        await it.until_connected(False)
        assert await it.driver.set_base_velocity(0.2, 0.0, 0.0) == ZERO
        await until(lambda: it.body.commanded == (0.0, 0.0, 0.0))
        it.firmware.executed.clear()
        it.station.set(NO_FAULTS)
        await it.until_connected()
        await until(lambda: it.firmware.executed)
        assert it.firmware.executed[0] == ZERO
        await it.drive_until(lambda _: it.body.commanded == (0.2, 0.0, 0.0), 0.2)
        assert (await it.driver.read_state()).link.reconnects == 1


@pytest.mark.parametrize("fault", [Faults(silence=True), Faults(frozen=True)])
async def test_a_silent_body_is_lost_although_its_port_exists(
    tmp_path: Path, fault: Faults
) -> None:
    async with bench(tmp_path) as it:
        it.station.set(fault)
        await it.until_connected(False)
        assert it.driver.link.connected
        it.station.set(NO_FAULTS)
        await it.until_connected()


async def test_garbage_and_half_lines_are_counted_and_have_no_effect(
    tmp_path: Path,
) -> None:
    async with bench(tmp_path) as it:
        it.station.set(Faults(garbage=0.3, half_frames=0.2, bit_errors=0.005))
        await it.drive_until(lambda state: state.link.errors > 5, 0.2)
        it.station.set(NO_FAULTS)
        await it.until_connected()
        await it.driver.stop()
        await it.at_rest()


async def test_a_reboot_does_not_move_the_pose(tmp_path: Path) -> None:
    async with bench(tmp_path) as it:
        await it.drive_until(lambda state: state.pose.x > 0.1, 0.4)
        await it.driver.stop()
        before = (await it.at_rest()).pose.x
        it.station.set(Faults(reboot=True))
        await it.until_connected(False)
        it.station.set(NO_FAULTS)  # banner, then counters restart at zero
        await it.until_connected()
        state = await it.driver.read_state()
        assert state.pose.x == pytest.approx(before, abs=0.005)
        assert (state.link.errors, state.velocity.linear_x) == (2, 0.0)  # two banner lines


async def test_a_board_that_restarts_behind_its_port_is_started_again(tmp_path: Path) -> None:
    async with bench(tmp_path, STARTED) as it:
        await it.drive(0.1, 0.2)
        it.station.set(Faults(reboot=True))
        await it.drive_until(lambda state: not state.link.connected, 0.0)
        it.station.set(NO_FAULTS)
        await it.drive_until(lambda state: state.link.connected, 0.0)
        await it.drive_until(lambda _: it.body.commanded == (0.2, 0.0, 0.0), 0.2)


async def test_after_a_brown_out_the_body_is_at_rest(tmp_path: Path) -> None:
    async with bench(tmp_path) as it:
        await it.drive(0.1, 0.2)
        it.station.set(Faults(brown_out=6.0))
        await until(lambda: it.body.commanded == (0.0, 0.0, 0.0))
        await it.until_connected(False)
        it.station.set(NO_FAULTS)
        await it.until_connected()
        assert it.body.commanded == (0.0, 0.0, 0.0)


async def test_flags_are_logged_once_and_bumpers_reported(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    text = BARE.replace("bumper_left", "bumper")
    async with bench(tmp_path, text) as it:
        await it.drive(0.1, 0.0)
        caplog.clear()
        it.body.bumper = True
        # without commands the firmware sets `watchdog`
        await it.reported(lambda _: "the firmware reports: watchdog" in caplog.messages)
        await it.reported(lambda state: state.bumpers == (True, False))
        await asyncio.sleep(0.1)
        await it.driver.read_state()
        assert caplog.messages == ["the firmware reports: watchdog"]
        no_longer = "the firmware no longer reports: watchdog"
        await it.drive_until(lambda _: no_longer in caplog.messages, 0.0)
        assert caplog.messages[1] == no_longer
        assert not any("bumper" in text for text in caplog.messages)


async def test_a_loss_and_its_end_are_logged_once_each(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "gigabrain_drivers.bodies.line.driver")
    async with bench(tmp_path, plugged=False) as it:
        async with asyncio.timeout(5):
            while not caplog.records:
                await it.connected()
                await asyncio.sleep(0.01)
        await asyncio.sleep(0.1)
        await it.connected()
        assert caplog.messages == [f"no {tmp_path}/base: is it plugged in?"]
        it.station.set(NO_FAULTS)
        await it.until_connected()
        assert "reports again" in caplog.text


async def test_unchanged_commands_are_repeated_at_a_rate_and_new_ones_sent_at_once(
    tmp_path: Path,
) -> None:
    async with bench(tmp_path) as it:
        written: list[bytes] = []
        it.driver.link.trace = lambda way, data: written.append(data) if way == "tx" else None
        rate_ns, it.driver._repeat_ns = it.driver._repeat_ns, 60_000_000_000
        for _ in range(10):
            await it.driver.set_base_velocity(0.1, 0.0, 0.0)
        await it.driver.set_base_velocity(0.2, 0.0, 0.0)
        assert written == [b"V,0.100,0.000\n", b"V,0.200,0.000\n"]
        it.driver._repeat_ns = rate_ns
        await it.drive(0.1, 0.2)
        assert 3 <= len(written) <= 7


async def test_start_and_stop_strings_are_sent_around_the_motion(tmp_path: Path) -> None:
    async with bench(tmp_path, STARTED) as it:
        written: list[bytes] = []
        it.driver.link.trace = lambda way, data: written.append(data) if way == "tx" else None
        await it.driver.set_base_velocity(0.2, 0.0, 0.0)
        await until(lambda: it.body.commanded == (0.2, 0.0, 0.0))
        await it.driver.stop()
        await it.driver.stop()
        await until(lambda: it.body.commanded == (0.0, 0.0, 0.0))
        await it.driver.set_base_velocity(0.1, 0.0, 0.0)
        await until(lambda: it.body.commanded == (0.1, 0.0, 0.0))
        assert [line for line in written if not line.startswith(b"V,0.0")] == [
            b"ENABLE\n", b"V,0.200,0.000\n", b"DISABLE\n", b"ENABLE\n", b"V,0.100,0.000\n",
        ]  # fmt: skip


async def test_a_body_that_was_never_moved_is_never_started(tmp_path: Path) -> None:
    async with bench(tmp_path, STARTED) as it:
        written: list[bytes] = []
        it.driver.link.trace = lambda way, data: written.append(data) if way == "tx" else None
        for _ in range(3):
            await it.driver.set_base_velocity(0.0, 0.0, 0.0)
            await it.driver.stop()
        await it.driver.close()
        assert set(written) <= {b"V,0.000,0.000\n"}


async def test_a_started_body_gets_its_stop_string_also_after_a_reconnection(
    tmp_path: Path,
) -> None:
    async with bench(tmp_path, STARTED) as it:
        written: list[bytes] = []
        it.driver.link.trace = lambda way, data: written.append(data) if way == "tx" else None
        await it.driver.set_base_velocity(0.2, 0.0, 0.0)
        it.station.set(Faults(unplugged=True))
        await it.until_connected(False)
        await it.driver.stop()
        it.station.set(NO_FAULTS)
        await until(lambda: len(written) > 2)
        assert written[:2] == [b"ENABLE\n", b"V,0.200,0.000\n"]
        assert written[2:4] == [b"V,0.000,0.000\n", b"DISABLE\n"]


WHEELED = BARE.replace("V,{linear_x:.3f},{angular_z:.3f}", "W,{wheel_left:.1f},{wheel_right:.1f}")


async def test_rounded_wheel_speeds_are_returned_as_the_resulting_velocity(tmp_path: Path) -> None:
    async with bench(tmp_path, WHEELED) as it:
        sent = await it.driver.set_base_velocity(0.1, 0.0, 0.5)
        # (0.1 -+ 0.5 * 0.25) / 0.08 = -0.31 and 2.81 rad/s
        await until(lambda: it.body.commanded != (0.0, 0.0, 0.0))
        assert sent.linear_x == pytest.approx((2.8 - 0.3) * 0.08 / 2)
        assert sent.angular_z == pytest.approx((2.8 + 0.3) * 0.08 / 0.5)
        assert it.body.commanded == (sent.linear_x, sent.linear_y, sent.angular_z)


async def test_stop_and_close_work_in_any_state(tmp_path: Path) -> None:
    async with bench(tmp_path) as it:
        await it.drive(0.1, 0.2)
        for _ in range(3):
            await it.driver.close()
            await it.driver.stop()
        await until(lambda: it.body.commanded == (0.0, 0.0, 0.0))
        with pytest.raises(BodyLost):
            await it.driver.set_base_velocity(0.1, 0.0, 0.0)


async def test_auto_finds_the_port_that_sends_valid_lines(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    paths = [str(tmp_path / "nothing"), str(tmp_path / "base")]
    async with bench(tmp_path) as it:
        await it.driver.link.close()
        monkeypatch.setattr(serial_link, "candidate_paths", lambda port: paths)
        it.driver.link._port = "auto"
        it.driver.link.open()
        await it.until_connected()
        assert it.driver.link.path == str(tmp_path / "base")
