"""TurtleBot3's OpenCR board: Dynamixel Protocol 2.0 packets, and the board's control table.

Packets have byte stuffing and CRC-16: https://emanual.robotis.com/docs/en/dxl/protocol2/
The table is that of the firmware, OpenCR `libraries/turtlebot3_ros2`. Address 14 switches off the
firmware's watchdog; this module never writes it.
"""

import math
import struct
from typing import NamedTuple

from gigabrain_drivers.kinematics import Quaternion, Vector
from gigabrain_drivers.links.frames import FrameDecoder, crc_table

HEADER = b"\xff\xff\xfd\x00"
PING, READ, WRITE, STATUS = 0x01, 0x02, 0x03, 0x55
MAX_PACKET_LENGTH = 1024  # of the length field; larger values are noise

_PREFIX = len(HEADER) + 3  # header, id and length, which the length does not include
_CRC = 2
_MARK, _STUFFED = b"\xff\xff\xfd", b"\xff\xff\xfd\xfd"

ID = 200
MODEL = 0x5000  # of the board; the TurtleBot3's model is at MODEL_INFO
USB_ID = "0483:5740"
BAUD = 1_000_000  # any value works over USB
FIRST, LENGTH = 10, 172  # block that a cycle reads
HEARTBEAT, TORQUE, VELOCITY = 19, 149, 150
RUNNING, MOTORS_SILENT = 0, -1  # device status; silent mostly means that their switch is off
TICKS = 4096  # of a wheel's encoder per turn
RADIANS_PER_TICK = math.tau / TICKS
VELOCITY_UNIT = 0.229 * math.tau / 60  # [rad/s]
MAX_WHEEL_SPEED = 337 * VELOCITY_UNIT  # [rad/s], limit of the firmware
CURRENT_UNIT = 0.00269  # [A]
SPEED_UNIT = 0.01  # [m/s] and [rad/s], of a command
EMPTY_VOLTAGE = 10.5  # [V]; below it the percentage no longer changes
_TABLE = struct.Struct(
    "<I??"  # 10 milliseconds; debug mode, host connected
    "?xbB"  # 16 manipulator, device status, heartbeat
    "4?2x2?2?H2x"  # 20 LEDs, buttons, bumpers, illumination
    "IfII"  # 34 cliff, sonar, battery voltage and percentage
    "B8x?3f3f3f4f8x"  # 50 sound; 59 calibration, gyro, acceleration, magnetic, orientation w x y z
    "2i2i2i4x"  # 120 current, velocity, position
    "??6i2I"  # 148 motors connected, torque; 150 command; 174 profile acceleration
)
Pair = tuple[int, int]


class DynamixelPacket(NamedTuple):
    """An instruction, or with STATUS an answer, whose first parameter is its error."""

    id: int
    instruction: int
    params: bytes = b""


_CRC_TABLE = crc_table(0x8005, bits=16)


def crc16(data: bytes) -> int:
    """Return the CRC of `data`: polynomial 0x8005, initial value 0, not reflected."""
    crc = 0
    for byte in data:
        crc = ((crc << 8) & 0xFFFF) ^ _CRC_TABLE[(crc >> 8) ^ byte]
    return crc


def encode(packet: DynamixelPacket) -> bytes:
    """The bytes of a packet on the wire."""
    body = bytes([packet.instruction]) + packet.params
    body = body.replace(_MARK, _STUFFED)
    frame = HEADER + struct.pack("<BH", packet.id, len(body) + _CRC) + body
    return frame + struct.pack("<H", crc16(frame))


def ping(device: int) -> bytes:
    """Return a ping; the answer is model number u16 and firmware version u8."""
    return encode(DynamixelPacket(device, PING))


def read(device: int, address: int, length: int) -> bytes:
    """Ask for `length` bytes of the control table."""
    return encode(DynamixelPacket(device, READ, struct.pack("<HH", address, length)))


def write(device: int, address: int, data: bytes) -> bytes:
    """Write `data` into the control table."""
    return encode(DynamixelPacket(device, WRITE, struct.pack("<H", address) + data))


def status(device: int, data: bytes = b"", error: int = 0) -> bytes:
    """A device's answer."""
    return encode(DynamixelPacket(device, STATUS, bytes([error]) + data))


class DynamixelDecoder(FrameDecoder[DynamixelPacket]):
    """Finds packets in a stream of bytes."""

    HEADER = HEADER

    def __init__(self, longest: int = MAX_PACKET_LENGTH) -> None:
        super().__init__()
        self._longest = longest

    def _size(self, buffer: bytearray) -> int | None:
        if len(buffer) < _PREFIX:
            return None
        length = int.from_bytes(buffer[_PREFIX - 2 : _PREFIX], "little")
        size = _PREFIX + length
        if not 1 + _CRC <= length <= self._longest:
            return 0
        inside = buffer.find(HEADER, len(HEADER), size - _CRC)
        return 0 if inside > 0 else size  # stuffing leaves no header inside a packet

    def _frame(self, data: bytes) -> DynamixelPacket | None:
        right = crc16(data[:-_CRC]) == int.from_bytes(data[-_CRC:], "little")
        return _packet(data) if right else None


def _packet(frame: bytes) -> DynamixelPacket:
    body = frame[_PREFIX:-_CRC].replace(_STUFFED, _MARK)
    return DynamixelPacket(frame[4], body[0], body[1:])


assert _TABLE.size == LENGTH


class Readings(NamedTuple):
    """The board's part of the table in SI units; pairs are left and right."""

    milliseconds: int  # since the board's start, renewed every 20 ms
    watchdog_off: bool  # debug mode: the firmware would not stop by itself
    device_status: int
    heartbeat: int  # as last written; tells answers to old questions from new ones
    buttons: tuple[bool, bool]
    bumpers: tuple[bool, bool]
    voltage: float  # [V]
    percentage: float  # 0-100
    angular_velocity: Vector  # [rad/s]
    linear_acceleration: Vector  # [m/s2]
    orientation: Quaternion  # x, y, z, w
    currents: tuple[float, float]  # [A]
    velocities: tuple[float, float]  # [rad/s]
    ticks: Pair  # of the encoders, 4096 a turn, signed 32 bit, wrap
    torque: bool


def ask() -> bytes:
    """Return the read request of a cycle."""
    return read(ID, FIRST, LENGTH)


def decode_model(answer: bytes) -> tuple[int, int] | None:
    """Return (model number, firmware version) in the answer to a ping; None for others."""
    return (answer[0] | answer[1] << 8, answer[2]) if len(answer) == 3 else None


def decode_readings(data: bytes) -> Readings:
    """Decode the answer's `data` (172 bytes). Raises ValueError for another length."""
    if len(data) != LENGTH:
        raise ValueError(f"expected {LENGTH} bytes of the control table, got {len(data)}")
    v = _TABLE.unpack(data)
    voltage = v[17] * 0.01
    return Readings(
        milliseconds=v[0],
        watchdog_off=v[1],
        device_status=v[4],
        heartbeat=v[5],
        buttons=(v[10], v[11]),
        bumpers=(v[12], v[13]),
        voltage=voltage,
        percentage=min(v[18] * 0.01, 100.0) if voltage >= EMPTY_VOLTAGE else 0.0,
        angular_velocity=v[21:24],
        linear_acceleration=v[24:27],
        orientation=(v[31], v[32], v[33], v[30]),
        currents=(v[34] * CURRENT_UNIT, v[35] * CURRENT_UNIT),
        velocities=(v[36] * VELOCITY_UNIT, v[37] * VELOCITY_UNIT),
        ticks=(v[38], v[39]),
        torque=v[41],
    )


class Sent(NamedTuple):
    """A command in the board's units."""

    frame: bytes
    linear_x: float  # [m/s], rounded to the board's units
    angular_z: float  # [rad/s]


def velocity(linear_x: float, angular_z: float) -> Sent:
    """Return the command to drive [m/s], [rad/s], both finite; the board uses steps of 0.01."""
    forward, turn = _hundredths(linear_x), _hundredths(angular_z)
    data = struct.pack("<6i", forward, 0, 0, 0, 0, turn)
    return Sent(write(ID, VELOCITY, data), forward * SPEED_UNIT, turn * SPEED_UNIT)


def heartbeat(count: int) -> bytes:
    """Return a heartbeat: the board stops 500 ms after the low 8 bits of `count` last changed."""
    return write(ID, HEARTBEAT, bytes([count & 0xFF]))


def torque(on: bool) -> bytes:
    """Return the command that switches the motors on or off."""
    return write(ID, TORQUE, bytes([on]))


def describe(packet: DynamixelPacket) -> str:
    """Describe a packet between a host and the board."""
    kind, params = packet.instruction, packet.params
    if kind == STATUS:
        return _answer_in_words(params)
    if kind == PING:
        return f"ping {packet.id}"
    if kind == READ and len(params) == 4:
        address, length = struct.unpack("<HH", params)
        return f"read {length} bytes at {address}"
    if kind != WRITE or len(params) < 3:
        return f"instruction {kind:02x}"
    address, data = params[0] | params[1] << 8, params[2:]
    if address == HEARTBEAT and len(data) == 1:
        return f"heartbeat {data[0]}"
    if address == TORQUE and len(data) == 1:
        return f"motors {'on' if data[0] else 'off'}"
    if address == VELOCITY and len(data) == 24:
        forward, _, _, _, _, turn = struct.unpack("<6i", data)
        return (
            f"velocity: linear x {forward} x 0.01 m/s = {forward * SPEED_UNIT:.2f} m/s, "
            f"angular z {turn} x 0.01 rad/s = {turn * SPEED_UNIT:.2f} rad/s"
        )
    return f"write {len(data)} bytes at {address}"


def _answer_in_words(params: bytes) -> str:
    if not params:
        return "status without an error byte"
    error, data = params[0] & 0x7F, params[1:]
    if error:
        return f"status: error {error}"
    if model := decode_model(data):
        return f"status: model {model[0]:#06x}, firmware {model[1]}"
    if len(data) != LENGTH:
        return f"status: ok, {len(data)} bytes" if data else "status: ok"
    now = decode_readings(data)
    left, right = now.velocities
    return (
        f"state: heartbeat {now.heartbeat}, {now.voltage:.2f} V, wheels {left:.3f} {right:.3f} "
        f"rad/s at {now.ticks[0]} {now.ticks[1]} ticks, device status {now.device_status}"
    )


def _hundredths(value: float) -> int:
    return max(-10_000, min(10_000, round(value / SPEED_UNIT)))
