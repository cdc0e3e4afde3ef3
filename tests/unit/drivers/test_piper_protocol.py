"""AgileX Piper's frames, against those that the vendor's SDK makes."""

import math

import pytest

from gigabrain_drivers.bodies.piper import protocol as piper
from gigabrain_drivers.bodies.piper.protocol import ArmStatus, Drive, Gripper, Motor
from gigabrain_drivers.links.can_link import CanFrame


def shown(frame: CanFrame) -> str:
    return f"{frame.id:03X}#{frame.data.hex().upper()}"


def test_commands_are_those_of_the_vendors_sdk() -> None:
    assert shown(piper.mode(piper.BY_CAN, piper.MOVE_J, 30)) == "151#01011E0000000000"
    angles = [math.radians(90), 0.0, 0.0, 0.0, 0.0, math.radians(-1)]
    assert [shown(frame) for frame in piper.move(angles)] == [
        "155#00015F9000000000",
        "156#0000000000000000",
        "157#00000000FFFFFC18",
    ]
    assert shown(piper.move_gripper(0.05, 1.0)) == "159#0000C35003E80100"
    assert shown(piper.enable(on=True)) == "471#0702000000000000"
    assert shown(piper.enable(on=False, motor=3)) == "471#0301000000000000"


def test_reports_are_read_as_the_vendors_sdk_reads_them() -> None:
    first, second = piper.decode_pair(bytes.fromhex("00003039FFFFFC18"))
    assert (math.degrees(first), math.degrees(second)) == pytest.approx((12.345, -1.0))
    assert piper.decode_status(bytes.fromhex("0107010001000402")) == ArmStatus(
        control=1, state=7, move=1, teaching=0, moving=1, trajectory=0, faults=0x0402
    )
    assert piper.decode_motor(bytes.fromhex("FF3803E800000000")) == Motor(-0.2, 1.0)
    assert piper.decode_drive(bytes.fromhex("00F0001EFF4101F4")) == pytest.approx(
        Drive(24.0, 30, -1, 0x41, 0.5)
    )
    assert piper.decode_gripper(bytes.fromhex("0000C350FC18C000")) == pytest.approx(
        Gripper(0.05, -1.0, 0xC0)
    )


def test_what_is_encoded_is_decoded_to_the_same() -> None:
    status = ArmStatus(1, 4, 1, 0, 1, 0, 0x0100)
    assert piper.decode_status(piper.encode_status(status).data) == status
    motor = Motor(-1.234, 0.567)
    assert piper.decode_motor(piper.encode_motor(3, motor).data) == pytest.approx(motor)
    drive = Drive(23.9, 41.0, 39.0, 0x43, 0.25)
    assert piper.encode_drive(5, drive).id == 0x266
    assert piper.decode_drive(piper.encode_drive(5, drive).data) == pytest.approx(drive)
    gripper = Gripper(0.0123, 0.5, 0x40)
    assert piper.decode_gripper(piper.encode_gripper(gripper).data) == pytest.approx(gripper)


def test_a_mit_command_with_a_wrong_check_is_refused() -> None:
    good = bytes.fromhex("84187FF051B327F6")  # of the SDK: JointMitCtrl(1, 0.4, 0, 10, 2, 0)
    command = piper.decode_mit(good)
    assert command is not None
    assert tuple(command) == pytest.approx((0.4, 0.0, 10.0, 2.0, 0.0), abs=0.13)
    assert piper.decode_mit(good[:7] + bytes((good[7] ^ 1,))) is None
    assert piper.decode_mit(good[:5]) is None


def test_values_beyond_what_a_frame_can_hold_are_cut_off() -> None:
    assert piper.decode_motor(piper.encode_motor(0, Motor(99.0, -99.0)).data) == pytest.approx(
        Motor(32.767, -32.767)
    )
    _, torque, _, _ = piper.decode_gripper_command(piper.move_gripper(0.01, 9.0).data)
    assert torque == pytest.approx(5.0)


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        (piper.move([0.1] * 6)[1], "targets 3 at 0.1000 rad, 4 at 0.1000 rad"),
        (piper.move_gripper(0.02, 1.5), "gripper to 0.0200 m, 1.50 N m, state 1"),
        (piper.enable(on=True), "motor 7 on"),
        (piper.mode(1, 1, 100), "control 1, move 1, 100 % of its speed"),
        (CanFrame(piper.STATUS, b"123"), "3 bytes"),
        (CanFrame(0x7FF, bytes(8)), "unknown"),
        (piper.encode_drive(0, Drive(24.0, 30.0, 31.0, 0, 0.0)), "drive 1: "),
    ],
)
def test_frames_are_described_for_the_log(frame: CanFrame, text: str) -> None:
    assert piper.describe(frame).startswith(text)
