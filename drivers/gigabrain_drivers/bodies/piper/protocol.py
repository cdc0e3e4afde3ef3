"""AgileX Piper on CAN, 1 Mbit/s, standard identifiers, all numbers big endian.

Source: the vendor's `piper_sdk` 0.6.2, protocol V2 (firmware V1.5-2 and later):
https://github.com/agilexrobotics/piper_sdk, `piper_msgs/msg_v2` and `protocol/protocol_v2`. Its
issue 66 says that the stop of 0x150 lets the arm sink, and the reset lets it fall.
"""

import math
import struct
from collections.abc import Callable, Sequence
from typing import NamedTuple

from gigabrain_drivers.links.can_link import CanFrame

JOINTS = 6

# from the arm, 200 times a second, except DRIVES
STATUS, POSE, POSITIONS, GRIPPER = 0x2A1, 0x2A2, 0x2A5, 0x2A8  # POSE and POSITIONS: three each
MOTORS = 0x251  # speed, current, position; one for each joint
DRIVES = 0x261  # voltage, temperatures, faults; one for each joint
# to the arm
STOP, MODE, MOVE, MOVE_GRIPPER, MIT = 0x150, 0x151, 0x155, 0x159, 0x15A  # MOVE: three, MIT: six
ENABLE, ASK_LIMITS, CONFIGURE, ANSWER = 0x471, 0x472, 0x475, 0x476
LIMITS, MAX_ACCELERATION, FIRMWARE = 0x473, 0x47C, 0x4AF
RECEIVED = (  # identifiers that the driver listens to
    STATUS, *range(POSITIONS, POSITIONS + 3), GRIPPER,
    *range(MOTORS, MOTORS + JOINTS), *range(DRIVES, DRIVES + JOINTS),
)  # fmt: skip

ALL_MOTORS = 7
BY_CAN, STANDBY, TEACHING = 0x01, 0x00, 0x02  # control modes
MOVE_P, MOVE_J, MOVE_M = 0x00, 0x01, 0x04
POSITION_MODE, MIT_MODE = 0x00, 0xAD
FULL_SPEED = 100  # [%]
SINK, RESET = 0x01, 0x02  # of STOP
CLEAR = 0xAE
GRIPPER_OFF, GRIPPER_ON, GRIPPER_CLEAR = 0x00, 0x01, 0x03

NORMAL, STOPPED, OUT_OF_LIMITS = 0x00, 0x01, 0x04
STATUS_TEXTS = {  # of the arm, with remedies
    STOPPED: "its emergency stop is active, in which it sinks: support it, switch it off and on",
    0x02: "no solution for its target",
    0x03: "it is at a singularity",
    OUT_OF_LIMITS: "a target is beyond its limits",
    0x05: "a joint does not answer its controller",
    0x06: "a brake is not released",
    0x07: "it has collided: free it, then switch it off and on",
    0x08: "it was dragged too fast",
    0x09: "a joint reports a fault",
    0x0A: "it reports an unknown fault",
    0x0E: "its controller is too hot",
    0x0F: "its braking resistor is too hot",
}
HARMLESS = (NORMAL, 0x02, 0x03, OUT_OF_LIMITS, 0x0B, 0x0C, 0x0D)  # it can still be commanded
CONTROL_TEXTS = {
    TEACHING: "it is being taught by hand: press its button to end that",
    0x03: "it is controlled by Ethernet",
    0x04: "it is controlled by Wi-Fi",
    0x05: "it is controlled by a remote control",
    0x06: "it is configured as a leader, which takes no commands",
    0x07: "it replays a trajectory",
}
ENABLED = 0x40  # bit of a drive's status
FAULT_TEXTS = {  # bits of a drive's status
    0x01: "has too low a voltage",
    0x02: "is too hot",
    0x04: "draws too much current",
    0x08: "has a drive that is too hot",
    0x10: "has met an obstacle",
    0x20: "has a drive that reports an error",
    0x80: "is stalled",
}
GRIPPER_FAULTS = {  # bits of the gripper's status, which differ
    **{bit: text for bit, text in FAULT_TEXTS.items() if bit < 0x10},
    0x10: "has a sensor that reports an error",
    0x20: "has a drive that reports an error",
}

ANGLE_UNIT = math.radians(0.001)  # [rad]
WIDTH_UNIT = 1e-6  # [m]
TORQUE_UNIT, SPEED_UNIT, CURRENT_UNIT, VOLT_UNIT = 0.001, 0.001, 0.001, 0.1
MAX_GRIPPER_TORQUE = 5.0  # [N m], of its motor
TORQUE_PER_AMPERE = (1.18125,) * 3 + (0.95844,) * 3  # [N m/A], by the vendor's SDK
MIT_RANGES = (  # bits, least and greatest of position, speed, kp, kd and torque
    (16, -12.5, 12.5), (12, -45.0, 45.0), (12, 0.0, 500.0), (12, -5.0, 5.0), (8, -8.0, 8.0),
)  # fmt: skip
_PAIR, _GRIPPER = struct.Struct(">ii"), struct.Struct(">ihB")
_GRIPPER_COMMAND = struct.Struct(">iHBB")
_STATUS = struct.Struct(">6BH")
_MOTOR, _DRIVE = struct.Struct(">hhi"), struct.Struct(">HhbBH")
MAX_INT16, MAX_INT32 = (1 << 15) - 1, (1 << 31) - 1


class ArmStatus(NamedTuple):
    """The arm's own state, 0x2A1."""

    control: int = STANDBY
    state: int = NORMAL
    move: int = MOVE_P
    teaching: int = 0
    moving: int = 0  # 1 while the target is not reached
    trajectory: int = 0
    faults: int = 0  # high byte: joints out of limits; low byte: joints that do not answer


class Motor(NamedTuple):
    """A joint's motor, fast feedback."""

    speed: float  # [rad/s]
    current: float  # [A]


class Drive(NamedTuple):
    """A joint's drive, slow feedback."""

    voltage: float  # [V]
    drive_celsius: float
    motor_celsius: float
    status: int  # bits of ENABLED and FAULT_TEXTS
    bus_current: float  # [A]


class Gripper(NamedTuple):
    """The gripper."""

    width: float  # [m] between its fingers
    torque: float  # [N m] of its motor
    status: int  # bits of ENABLED and GRIPPER_FAULTS; 0x80: it has been homed


class MitCommand(NamedTuple):
    """A joint's target in MIT mode, with gains and an additional torque."""

    position: float  # [rad]
    speed: float  # [rad/s]
    kp: float  # [N m/rad]
    kd: float  # [N m s/rad]
    torque: float  # [N m]


def steps(value: float, unit: float, most: int = MAX_INT32) -> int:
    """Return a value in whole units."""
    return max(-most, min(most, round(value / unit)))


def pairs(first: int, angles: Sequence[float]) -> list[CanFrame]:
    """Return three frames from identifier `first`, of two angles each [rad]."""
    raw = [steps(angle, ANGLE_UNIT) for angle in angles]
    return [
        CanFrame(first + at // 2, _PAIR.pack(raw[at], raw[at + 1])) for at in range(0, JOINTS, 2)
    ]


def decode_pair(data: bytes) -> tuple[float, float]:
    """Return the two angles of a frame [rad]."""
    one, two = _PAIR.unpack(data)
    return one * ANGLE_UNIT, two * ANGLE_UNIT


def mode(control: int, move: int, speed: int, kind: int = POSITION_MODE) -> CanFrame:
    """Return the frame that sets the arm's mode, and its speed [%] of the maximum."""
    return CanFrame(MODE, bytes((control, move, speed, kind, 0, 0, 0, 0)))


def move(angles: Sequence[float]) -> list[CanFrame]:
    """Return the frames that move six joints to angles [rad]."""
    return pairs(MOVE, angles)


def move_gripper(width: float, torque: float, state: int = GRIPPER_ON) -> CanFrame:
    """Return the frame that moves the gripper to a width [m], with at most a torque [N m]."""
    most = round(min(max(torque, 0.0), MAX_GRIPPER_TORQUE) / TORQUE_UNIT)
    return CanFrame(MOVE_GRIPPER, _GRIPPER_COMMAND.pack(steps(width, WIDTH_UNIT), most, state, 0))


def enable(*, on: bool, motor: int = ALL_MOTORS) -> CanFrame:
    """Return the frame that switches motors on or off."""
    return CanFrame(ENABLE, bytes((motor, 2 if on else 1, 0, 0, 0, 0, 0, 0)))


def decode_status(data: bytes) -> ArmStatus:
    """Decode a frame of STATUS."""
    return ArmStatus(*_STATUS.unpack(data))


def encode_status(status: ArmStatus) -> CanFrame:
    """Return the frame of a status."""
    return CanFrame(STATUS, _STATUS.pack(*status))


def decode_motor(data: bytes) -> Motor:
    """Decode a frame of MOTORS."""
    speed, current, _ = _MOTOR.unpack(data)
    return Motor(speed * SPEED_UNIT, current * CURRENT_UNIT)


def encode_motor(joint: int, motor: Motor) -> CanFrame:
    """Return the frame of a motor, `joint` from 0; its position is left out."""
    speed = steps(motor.speed, SPEED_UNIT, MAX_INT16)
    current = steps(motor.current, CURRENT_UNIT, MAX_INT16)
    return CanFrame(MOTORS + joint, _MOTOR.pack(speed, current, 0))


def decode_drive(data: bytes) -> Drive:
    """Decode a frame of DRIVES."""
    volts, drive, motor, status, current = _DRIVE.unpack(data)
    return Drive(volts * VOLT_UNIT, drive, motor, status, current * CURRENT_UNIT)


def encode_drive(joint: int, drive: Drive) -> CanFrame:
    """Return the frame of a drive, `joint` from 0."""
    raw = (
        round(drive.voltage / VOLT_UNIT), round(drive.drive_celsius), round(drive.motor_celsius),
        drive.status, round(drive.bus_current / CURRENT_UNIT),
    )  # fmt: skip
    return CanFrame(DRIVES + joint, _DRIVE.pack(*raw))


def decode_gripper(data: bytes) -> Gripper:
    """Decode a frame of GRIPPER."""
    width, torque, status = _GRIPPER.unpack_from(data)
    return Gripper(width * WIDTH_UNIT, torque * TORQUE_UNIT, status)


def encode_gripper(gripper: Gripper) -> CanFrame:
    """Return the frame of a gripper."""
    raw = steps(gripper.width, WIDTH_UNIT), steps(gripper.torque, TORQUE_UNIT, MAX_INT16)
    return CanFrame(GRIPPER, _GRIPPER.pack(*raw, gripper.status) + b"\0")


def decode_gripper_command(data: bytes) -> tuple[float, float, int, int]:
    """Return (width [m], torque [N m], state, 0xAE to set zero) of a frame of MOVE_GRIPPER."""
    width, torque, state, zero = _GRIPPER_COMMAND.unpack(data)
    return width * WIDTH_UNIT, torque * TORQUE_UNIT, state, zero


def decode_mit(data: bytes) -> MitCommand | None:
    """Decode a frame of MIT; None if its check is wrong."""
    check = 0
    for byte in data[:7]:
        check ^= byte
    if len(data) != 8 or (check ^ data[7]) & 0x0F:
        return None
    bits, values = int.from_bytes(data, "big") >> 4, []
    for width, least, greatest in reversed(MIT_RANGES):
        values.append(least + (bits & (1 << width) - 1) * (greatest - least) / ((1 << width) - 1))
        bits >>= width
    return MitCommand(*reversed(values))


def fault_text(name: str, status: int, texts: dict[int, str]) -> str:
    """Return the first fault in a status, in words; empty for none."""
    return next((f"{name} {text}" for bit, text in texts.items() if status & bit), "")


def describe(frame: CanFrame) -> str:
    """Describe a frame for the log."""
    id_, data = frame
    if len(data) < 8:
        return f"{len(data)} bytes"
    if id_ == STATUS:
        return str(decode_status(data))
    if id_ == GRIPPER:
        return str(decode_gripper(data))
    if id_ == MOVE_GRIPPER:
        width, torque, state, _ = decode_gripper_command(data)
        return f"gripper to {width:.4f} m, {torque:.2f} N m, state {state}"
    for first, count, text in NAMES:
        if first <= id_ < first + count:
            return text(id_ - first, data)
    return "unknown"


def _angles(what: str, at: int, data: bytes) -> str:
    one, two = decode_pair(data)
    return f"{what} {2 * at + 1} at {one:.4f} rad, {2 * at + 2} at {two:.4f} rad"


NAMES: tuple[tuple[int, int, Callable[[int, bytes], str]], ...] = (
    # first identifier, their number, and their description
    (POSITIONS, 3, lambda at, data: _angles("joints", at, data)),
    (MOVE, 3, lambda at, data: _angles("targets", at, data)),
    (MOTORS, JOINTS, lambda at, data: f"motor {at + 1}: {decode_motor(data)}"),
    (DRIVES, JOINTS, lambda at, data: f"drive {at + 1}: {decode_drive(data)}"),
    (MIT, JOINTS, lambda at, data: f"joint {at + 1}: {decode_mit(data)}"),
    (POSE, 3, lambda at, data: "pose of the tool"),
    (MODE, 1, lambda at, data: f"control {data[0]}, move {data[1]}, {data[2]} % of its speed"),
    (ENABLE, 1, lambda at, data: f"motor {data[0]} {'on' if data[1] == 2 else 'off'}"),
    (STOP, 1, lambda at, data: f"stop {data[0]}"),
)
