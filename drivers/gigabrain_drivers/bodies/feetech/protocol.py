"""Feetech's servo bus: packets, the control table of the STS3215, and the units of its values.

A packet is `FF FF | id | length | instruction or error | parameters | sum`; the sum has 8 bits.
Words are little-endian; signed ones have a sign bit (sign and magnitude). Source: the vendor's
`ftservo-python-sdk` 2.0.1 and its memory table of the STS3215.
"""

import math
import struct
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from gigabrain_drivers.links.frames import FrameDecoder

HEADER = b"\xff\xff"
PING, READ, WRITE, REG_WRITE, ACTION, SYNC_READ, SYNC_WRITE = 1, 2, 3, 4, 5, 0x82, 0x83
BROADCAST = 0xFE
MAX_ID = 0xFD
MAX_LENGTH = 250  # of the length field, as in the vendor's SDK

MODEL = 777  # of an STS3215
USB_ID = "1a86:55d3"  # of the CH343 on the usual adapters
BAUD = 1_000_000
TICKS = 4096  # of a turn
RADIANS_PER_TICK = math.tau / TICKS
VOLTAGE_UNIT = 0.1  # [V]
LOAD_UNIT = 0.001  # of the stall torque
CURRENT_UNIT = 0.0065  # [A]
ACCELERATION_UNIT = 100  # ticks/s2
MAX_ACCELERATION = 254
STALL_TORQUE = {7.4: 1.91, 12.0: 2.94}  # [N m], by the variant's voltage


class Register(NamedTuple):
    """An item of the control table."""

    address: int
    size: int = 1  # bytes
    sign: int | None = None  # number of its sign bit

    def encode(self, value: int) -> bytes:
        """Return the bytes of a value. Raises OverflowError if it does not fit."""
        if self.sign is None:
            return value.to_bytes(self.size, "little")
        if abs(value) >= 1 << self.sign:
            raise OverflowError(f"{value} does not fit into {self.sign} bits")
        return (abs(value) | (value < 0) << self.sign).to_bytes(self.size, "little")

    def decode(self, data: bytes) -> int:
        """Return the value in these bytes, with its sign."""
        return signed(int.from_bytes(data, "little"), self.sign)


def signed(raw: int, sign: int | None) -> int:
    """Return the value of a word with a sign bit."""
    if sign is None:
        return raw
    magnitude = raw & (1 << sign) - 1
    return -magnitude if raw >> sign & 1 else magnitude


# EEPROM: only the calibration writes it, and only if the person agrees
MODEL_NUMBER = Register(3, 2)
ID = Register(5)
MIN_POSITION, MAX_POSITION = Register(9, 2), Register(11, 2)
MAX_TEMPERATURE, MAX_VOLTAGE, MIN_VOLTAGE = Register(13), Register(14), Register(15)
MAX_TORQUE = Register(16, 2)
P_GAIN = Register(21)
OFFSET = Register(31, 2, 11)  # homing offset: position = encoder - offset
MODE = Register(33)  # 0 position, 1 velocity, 2 PWM, 3 steps
PROTECTIVE_TORQUE, PROTECTION_TIME, OVERLOAD_TORQUE = Register(34), Register(35), Register(36)
EEPROM_SIZE = 40
# RAM
TORQUE, ACCELERATION = Register(40), Register(41)
GOAL, GOAL_VELOCITY, TORQUE_LIMIT = Register(42, 2, 15), Register(46, 2, 15), Register(48, 2)
LOCK = Register(55)  # 1: values written to the EEPROM are lost at power-off
POSITION, VELOCITY, LOAD = Register(56, 2, 15), Register(58, 2, 15), Register(60, 2, 10)
VOLTAGE, TEMPERATURE, STATUS, MOVING = Register(62), Register(63), Register(65), Register(66)
CURRENT = Register(69, 2, 15)

FAULTS = {  # bits of the status, and of an answer's error
    0x01: "voltage",
    0x02: "position sensor",
    0x04: "temperature",
    0x08: "current",
    0x20: "overload",
}
OVERLOAD = 0x20

# the block that a cycle reads: received commands, and measurements
FIRST, LENGTH = TORQUE.address, 31
_BLOCK = struct.Struct("<BBHHHH5xBHHHBBxBBxxH")
assert _BLOCK.size == LENGTH

_PREFIX = 4  # header, id and length, which the length does not include


class FeetechPacket(NamedTuple):
    """An instruction, or an answer with an error in its place."""

    id: int
    instruction: int
    params: bytes = b""


def encode(packet: FeetechPacket) -> bytes:
    """Return the bytes of a packet on the wire."""
    body = bytes([packet.id, len(packet.params) + 2, packet.instruction]) + packet.params
    return HEADER + body + bytes([checksum(body)])


def checksum(body: bytes) -> int:
    """Return the checksum of all bytes between header and checksum."""
    return ~sum(body) & 0xFF


def ping(servo: int) -> bytes:
    """Return a ping; its answer has no parameters."""
    return encode(FeetechPacket(servo, PING))


def read(servo: int, address: int, length: int) -> bytes:
    """Ask for `length` bytes of a control table."""
    return encode(FeetechPacket(servo, READ, bytes([address, length])))


def write(servo: int, address: int, data: bytes) -> bytes:
    """Write bytes into a control table; the servo answers."""
    return encode(FeetechPacket(servo, WRITE, bytes([address]) + data))


def sync_read(servos: Sequence[int], address: int, length: int) -> bytes:
    """Ask several servos for the same bytes; they answer in turn."""
    return encode(FeetechPacket(BROADCAST, SYNC_READ, bytes([address, length, *servos])))


def sync_write(address: int, data: Mapping[int, bytes]) -> bytes:
    """Write bytes of one length into several control tables; no servo answers."""
    length = len(next(iter(data.values())))
    body = b"".join(bytes([servo]) + its for servo, its in data.items())
    return encode(FeetechPacket(BROADCAST, SYNC_WRITE, bytes([address, length]) + body))


def status(servo: int, data: bytes = b"", error: int = 0) -> bytes:
    """Return the bytes of a servo's answer."""
    return encode(FeetechPacket(servo, error, data))


class FeetechDecoder(FrameDecoder[FeetechPacket]):
    """Finds packets in a stream of bytes."""

    HEADER = HEADER

    def __init__(self) -> None:
        super().__init__()
        self.expected: int | None = None  # valid number of parameters; None: any

    def _size(self, buffer: bytearray) -> int | None:
        if len(buffer) < _PREFIX:
            return None
        servo, length = buffer[2], buffer[3]
        if servo > BROADCAST or not 2 <= length <= MAX_LENGTH:
            return 0
        if self.expected is not None and length != self.expected + 2:
            return 0
        return _PREFIX + length

    def _frame(self, data: bytes) -> FeetechPacket | None:
        if checksum(data[2:-1]) != data[-1]:
            return None
        return FeetechPacket(data[2], data[4], data[5:-1])


class ServoReadings(NamedTuple):
    """The block that a cycle reads, in the servo's own units."""

    torque: bool
    acceleration: int
    goal: int  # ticks
    goal_time: int
    goal_velocity: int  # ticks/s
    torque_limit: int  # 0.001
    lock: int
    position: int  # ticks
    velocity: int  # ticks/s
    load: int  # 0.001 of the stall torque
    voltage: int  # 0.1 V
    temperature: int  # [deg C]
    status: int  # bits of FAULTS
    moving: bool
    current: int  # 6.5 mA

    def seldom(self) -> tuple[int, ...]:
        """Return the values that seldom change."""
        settings = self.acceleration, self.goal_time, self.goal_velocity, self.torque_limit
        return (self.torque, *settings, self.lock, self.status)


def decode_readings(data: bytes) -> ServoReadings:
    """Decode the block of a cycle (31 bytes). Raises ValueError for another length."""
    if len(data) != LENGTH:
        raise ValueError(f"expected {LENGTH} bytes of the control table, got {len(data)}")
    v = _BLOCK.unpack(data)
    return ServoReadings(
        torque=v[0] == 1,
        acceleration=v[1],
        goal=signed(v[2], GOAL.sign),
        goal_time=v[3],
        goal_velocity=signed(v[4], GOAL_VELOCITY.sign),
        torque_limit=v[5],
        lock=v[6],
        position=signed(v[7], POSITION.sign),
        velocity=signed(v[8], VELOCITY.sign),
        load=signed(v[9], LOAD.sign),
        voltage=v[10],
        temperature=v[11],
        status=v[12],
        moving=bool(v[13]),
        current=signed(v[14], CURRENT.sign),
    )


class ServoMemory(NamedTuple):
    """The values in a servo's EEPROM that a driver uses."""

    model: int
    min_position: int  # ticks
    max_position: int
    max_voltage: int  # 0.1 V
    offset: int  # ticks
    mode: int


def decode_memory(data: bytes) -> ServoMemory:
    """Decode the first 40 bytes of the control table. Raises ValueError for another length."""
    if len(data) != EEPROM_SIZE:
        raise ValueError(f"expected {EEPROM_SIZE} bytes of the control table, got {len(data)}")

    def item(register: Register) -> int:
        return register.decode(data[register.address : register.address + register.size])

    return ServoMemory(
        model=item(MODEL_NUMBER),
        min_position=item(MIN_POSITION),
        max_position=item(MAX_POSITION),
        max_voltage=item(MAX_VOLTAGE),
        offset=item(OFFSET),
        mode=item(MODE),
    )


def faults_of(bits: int) -> str:
    """Describe the bits of a status or an error; empty for none."""
    return ", ".join(name for bit, name in FAULTS.items() if bits & bit)


def describe_sent(packet: FeetechPacket) -> str:
    """Describe an instruction."""
    kind, params = packet.instruction, packet.params
    if kind == PING:
        return f"ping {packet.id}"
    if kind == READ and len(params) == 2:
        return f"read {params[1]} bytes at {params[0]} of {packet.id}"
    if kind == WRITE and len(params) > 1:
        return f"write {params[1:].hex(' ')} at {params[0]} of {packet.id}"
    if kind == SYNC_READ and len(params) > 2:
        servos = ", ".join(map(str, params[2:]))
        return f"read {params[1]} bytes at {params[0]} of {servos}"
    if kind == SYNC_WRITE and len(params) > 2:
        items = _items(params)
        if params[:2] == bytes([GOAL.address, GOAL.size]):
            goals = ", ".join(f"{servo}: {GOAL.decode(data)}" for servo, data in items.items())
            return f"goals {goals} ticks"
        words = ", ".join(f"{servo}: {data.hex(' ')}" for servo, data in items.items())
        return f"write at {params[0]} of {words}"
    return f"instruction {kind:02x} to {packet.id}"


def _items(params: bytes) -> dict[int, bytes]:
    return dict(sync_items(params))


def sync_items(params: bytes) -> list[tuple[int, bytes]]:
    """Return the ids and data of a sync write; empty for a wrong length."""
    size = params[1] + 1
    if len(params) < 2 + size or (len(params) - 2) % size:
        return []
    return [(params[at], params[at + 1 : at + size]) for at in range(2, len(params), size)]


def describe_received(packet: FeetechPacket) -> str:
    """Describe an answer."""
    error = faults_of(packet.instruction)
    head = f"servo {packet.id}: " + (f"error: {error}" if error else "ok")
    if len(packet.params) != LENGTH:
        return head + (f", {packet.params.hex(' ')}" if packet.params else "")
    now = decode_readings(packet.params)
    return (
        f"{head}, at {now.position} of {now.goal} ticks, {now.velocity} ticks/s, "
        f"load {now.load * LOAD_UNIT:.1%}, {now.voltage * VOLTAGE_UNIT:.1f} V, "
        f"{now.temperature} deg C, torque {'on' if now.torque else 'off'}"
    )
