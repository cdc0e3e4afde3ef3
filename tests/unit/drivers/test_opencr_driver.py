"""TurtleBot3's driver: what it tells the board, and what the board tells it."""

import math
import struct

import pytest

from gigabrain_drivers.bodies.turtlebot3 import protocol as opencr
from gigabrain_drivers.bodies.turtlebot3.driver import imu_data
from gigabrain_schemas.sensors import Imu
from gigabrain_zenoh.errors import BodyLost, Unsupported
from tests.unit.drivers.opencr import MS, Rig, make_rig  # noqa: F401


async def test_a_connection_begins_with_zero_and_with_the_question_who_is_there(rig: Rig) -> None:
    first, second = rig.cable.sent[:2]
    assert rig.cable.velocities()[0] == (0, 0)
    assert (first.instruction, second.instruction) == (opencr.WRITE, opencr.PING)
    assert rig.driver.problem == ""


async def test_it_drives_and_says_what_was_really_sent(rig: Rig) -> None:
    await rig.drive(0.123, 0.456, 100)
    assert rig.cable.velocities()[-1] == (12, 46)
    sent = await rig.driver.set_base_velocity(0.123, 0.3, 0.456)
    assert (sent.linear_x, sent.linear_y, sent.angular_z) == pytest.approx((0.12, 0.0, 0.46))
    assert rig.body.commanded[0] == pytest.approx(0.12, abs=1e-3)


async def test_commands_stay_within_what_the_body_can_do_and_keep_their_curve(rig: Rig) -> None:
    fast = await rig.driver.set_base_velocity(9.0, 0.0, 0.0)
    assert fast.linear_x == pytest.approx(0.26)
    curve = await rig.driver.set_base_velocity(0.26, 0.0, 1.3)
    assert curve.angular_z / curve.linear_x == pytest.approx(5.0, rel=0.05)
    wheel = curve.linear_x + curve.angular_z * 0.287 / 2
    assert 0.26 < wheel < 0.275


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
async def test_what_is_no_number_stops_it(rig: Rig, bad: float) -> None:
    await rig.drive(0.2, 0.0, 100)
    await rig.driver.set_base_velocity(0.2, 0.0, bad)
    assert rig.cable.velocities()[-1] == (0, 0)
    await rig.drive(0.2, 0.0, 100)
    await rig.driver.set_base_velocity(bad, 0.0, 0.1)
    assert rig.cable.velocities()[-1] == (0, 0)


async def test_the_body_stops_within_150_ms_of_the_last_command(rig: Rig) -> None:
    await rig.drive(0.2, 0.0, 200)
    await rig.driver.set_base_velocity(0.2, 0.0, 0.0)
    last = rig.clock.now_ns()
    while rig.body.commanded[0] > 0:
        await rig.driver.read_state()  # the process lives; only nobody commands any more
        await rig.wait(20)
    assert rig.clock.now_ns() - last <= 150 * MS


async def test_where_zero_gets_lost_it_is_sent_again(rig: Rig) -> None:
    await rig.drive(0.2, 0.0, 200)
    rig.cable.to_board = lambda data: None
    await rig.wait(120)
    rig.cable.to_board = rig.board.feed
    await rig.wait(40)
    assert rig.body.commanded == (0.0, 0.0, 0.0)


async def test_the_board_stops_half_a_second_after_the_driver_has_died(rig: Rig) -> None:
    await rig.drive(0.2, 0.0, 200)
    rig.cable.to_board = lambda data: None
    for _ in range(24):
        rig.board.step(rig.clock.now_ns())
        await rig.clock.advance(20 * MS)
    assert rig.body.commanded[0] > 0.19
    await rig.wait(60)
    assert rig.body.commanded == (0.0, 0.0, 0.0)


async def test_stop_is_zero_at_once_and_can_be_had_in_any_state(rig: Rig) -> None:
    await rig.drive(0.2, 0.0, 200)
    await rig.driver.stop()
    assert rig.cable.velocities()[-1] == (0, 0)
    await rig.driver.close()
    assert rig.cable.velocities()[-1] == (0, 0)
    await rig.driver.close()
    await rig.driver.stop()


async def test_nothing_is_ever_written_to_address_14(rig: Rig) -> None:
    await rig.drive(0.2, 0.5, 400)
    rig.cable.drop("cut")
    rig.cable.plug()
    await rig.drive(-0.2, 0.5, 400)
    await rig.driver.stop()
    await rig.driver.close()
    written = {
        struct.unpack_from("<H", packet.params)[0]: len(packet.params) - 2
        for packet in rig.cable.sent
        if packet.instruction == opencr.WRITE
    }
    assert written == {19: 1, 149: 1, 150: 24}


async def test_the_state_is_the_boards(rig: Rig) -> None:
    state = await rig.driver.read_state()
    assert state.robot_type == "turtlebot3_waffle"
    assert state.battery
    assert state.battery.voltage == pytest.approx(12.54, abs=0.02)
    assert state.battery.percentage == 100.0
    assert state.imu
    assert state.imu.orientation == pytest.approx((0, 0, 0, 1), abs=0.02)
    assert state.bumpers == (False, False)
    assert [joint.name for joint in state.joints] == ["wheel_left_joint", "wheel_right_joint"]
    assert [joint.position for joint in state.joints] == pytest.approx(
        [1234 * 0.001533981, 3210 * 0.001533981], abs=0.01
    )
    assert state.link.connected
    assert state.link.age_ms == 0.0
    assert isinstance(rig.published[-1][1], Imu)
    assert await rig.driver.get_sensor_data("imu") is rig.published[-1][1]


async def test_an_unknown_sensor_is_refused_with_the_known_ones(rig: Rig) -> None:
    with pytest.raises(Unsupported, match="no sensor 'sonar'; it has: imu"):
        await rig.driver.get_sensor_data("sonar")


@pytest.mark.parametrize("broken", [(0.0,) * 4, (math.nan,) * 4, (2.0, 0.0, 0.0, 0.0)])
def test_an_attitude_that_cannot_be_is_left_out(broken: tuple[float, ...]) -> None:
    data = bytearray(172)
    data[86:102] = struct.pack("<4f", *broken)
    assert imu_data(opencr.decode_readings(bytes(data))) is None


async def test_its_motors_can_be_let_go_and_the_next_connection_holds_them_again(
    rig: Rig,
) -> None:
    def torques() -> list[int]:
        written = [p.params for p in rig.cable.sent if p.instruction == opencr.WRITE]
        return [params[2] for params in written if params[:2] == b"\x95\x00"]

    assert torques() == [1]
    await rig.driver.limp()
    await rig.drive(0.2, 0.0, 200)
    await rig.driver.stop()
    assert torques() == [1, 0]
    rig.cable.drop("unplugged")
    with pytest.raises(BodyLost, match="unplugged"):
        await rig.driver.limp()
    rig.cable.plug()
    await rig.wait(100)
    assert torques() == [1, 0, 1]
