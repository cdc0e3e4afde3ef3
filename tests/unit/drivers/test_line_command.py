"""Velocities as numbers in a line, and back: speeds of the body, or of its wheels."""

import pytest

from gigabrain_drivers.bodies.line.conversion import LineCommand, SentWording
from gigabrain_drivers.bodies.line.protocol import COMMAND, Template
from gigabrain_drivers.kinematics.wheels import Ackermann, Differential
from gigabrain_schemas.base import Velocity

BASE = Differential(0.033, 0.287)


def test_a_velocity_is_rounded_to_whole_radians_per_second_of_the_wheels() -> None:
    command = LineCommand(Template("W,{wheel_left:d},{wheel_right:d}\n", COMMAND), BASE)
    wanted = Velocity(linear_x=0.1)  # 3.03 rad/s
    assert command.line(wanted, 0) == b"W,3,3\n"
    assert command.sent(wanted).linear_x == pytest.approx(0.099)


def test_a_command_of_a_car_may_have_its_speed_and_steering_angle() -> None:
    template = Template("C,{linear_x:.1f},{wheel_steering|deg:d}\n", COMMAND)
    command = LineCommand(template, Ackermann(0.05, 0.5))
    wanted = Velocity(linear_x=0.52, angular_z=0.5)  # atan(0.5 * 0.5 / 0.52) = 25.7 degrees
    assert command.line(wanted, 0) == b"C,0.5,25\n"
    sent = command.sent(wanted)
    assert (sent.linear_x, sent.angular_z) == pytest.approx((0.5, 0.4663), abs=1e-4)


def test_start_and_stop_strings_are_described_between_commands() -> None:
    template = Template("V,{linear_x:.1f},{angular_z:.1f}\n", COMMAND)
    wording = SentWording(template, {b"$ON\r\nGO\n": "start", b"$OFF\n": "stop"})
    lines = [wording.feed(bytes((byte,))) for byte in b"$ON\r\nGO\nV,0.1,0.0\n$OFF\nV,0.0,0.0\n"]
    assert [text for texts in lines for text in texts] == [
        "start",
        "linear_x 0.1 m/s, angular_z 0 rad/s",
        "stop",
        "linear_x 0 m/s, angular_z 0 rad/s",
    ]
