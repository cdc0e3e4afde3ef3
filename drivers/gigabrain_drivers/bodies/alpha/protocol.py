"""Protocol of alpha: gaits to the body, and states from it, in frames with a CRC-32.

docs/reference/firmware_alpha.md describes it for firmware authors. Numbers are little-endian:

    0   2  magic a5 5a          4   1  type                  6   4  sequence, counts up, wraps
    2   2  bytes of payload     5   1  version, 1           10   n  payload, then 4 of CRC-32

A frame is valid if its CRC, type and length are right, and no value is NaN or infinite. Encoders
and decoders for both ends, pure.
"""

import math
import struct
import zlib
from typing import NamedTuple

from gigabrain_drivers.kinematics.legs import Gait, Senses, by_joint, by_leg
from gigabrain_drivers.links.frames import FrameDecoder

PORT = 8080
SILENCE_NS = 100_000_000  # the body stops after this time without a valid command
STALE_MS = 150  # a command that is based on an older state is refused
STATE_HZ = 100
MAGIC, VERSION = b"\xa5\x5a", 1
WALK, STOP, PARK, STATE = 0x01, 0x02, 0x03, 0x81
SEQUENCES = 1 << 32

WALKING, SILENT, FALLEN, PARKED = 1, 2, 4, 8  # flags; SILENT: stopped after silence

_HEADER = struct.Struct("<2sHBBI")
_CRC = struct.Struct("<I")
_GAIT = struct.Struct("<I10f")
_STATE = struct.Struct("<III B B 3f 4f3f3f 36f 12h")
_LENGTHS = {WALK: _GAIT.size, STOP: 0, PARK: 0, STATE: _STATE.size}
_MAX_VALUE = 1e4  # larger absolute values in a state are invalid


class AlphaFrame(NamedTuple):
    """One frame. Its type determines the content of its payload."""

    type: int
    sequence: int
    payload: bytes = b""


class Walk(NamedTuple):
    """A command to walk."""

    seen: int  # [ms], `milliseconds` of the newest state that the sender received
    gait: Gait


class State(NamedTuple):
    """The body's report, 100 times a second."""

    milliseconds: int  # since the start of the firmware, wraps
    echo: int  # sequence of the newest obeyed command; 0 for none
    refused: int  # number of frames without a valid command
    flags: int  # WALKING, SILENT, FALLEN, PARKED
    voltage: float  # [V]
    current: float  # [A], positive while it drains
    percentage: float  # [%]
    senses: Senses
    torques: tuple[float, ...]  # [N m], of the twelve joints, leg by leg
    temperatures: tuple[float, ...]  # [deg C], of their motors


def encode(frame: AlphaFrame) -> bytes:
    """Return the bytes of a frame on the wire."""
    length, sequence = len(frame.payload), frame.sequence % SEQUENCES
    head = _HEADER.pack(MAGIC, length, frame.type, VERSION, sequence)
    body = head + frame.payload
    return body + _CRC.pack(zlib.crc32(body))


def encode_walk(command: Walk, sequence: int) -> bytes:
    """Return a command to walk."""
    seen, gait = command
    values = (gait.stride_x, gait.stride_y, gait.turn, gait.frequency, gait.duty)
    return encode(AlphaFrame(WALK, sequence, _GAIT.pack(seen, *values, *gait.phases, gait.height)))


def encode_stop(sequence: int) -> bytes:
    """Return a command to come to rest and stand."""
    return encode(AlphaFrame(STOP, sequence))


def encode_park(sequence: int) -> bytes:
    """Return a command to come to rest and lie down, until the next command to walk."""
    return encode(AlphaFrame(PARK, sequence))


def decode_walk(frame: AlphaFrame) -> Walk | None:
    """Return the command in a frame, or None if a value is NaN or infinite."""
    seen, x, y, turn, frequency, duty, a, b, c, d, height = _GAIT.unpack(frame.payload)
    if not all(map(math.isfinite, (x, y, turn, frequency, duty, a, b, c, d, height))):
        return None
    return Walk(seen, Gait(x, y, turn, frequency, duty, (a, b, c, d), height))


def is_stale(seen: int, now: int) -> bool:
    """Return whether a command's `seen` [ms] is too old at `now` [ms]; handles the wrap."""
    return (now - seen) % SEQUENCES > STALE_MS


def encode_state(now: State, sequence: int) -> bytes:
    """Return the body's report."""
    senses = now.senses
    feet = sum(1 << foot for foot, touches in enumerate(senses.contacts) if touches)
    joints, rates = by_joint(senses.joints), by_joint(senses.rates)
    by_motor = zip(joints, rates, now.torques, strict=True)
    payload = _STATE.pack(
        now.milliseconds % SEQUENCES,
        now.echo,
        now.refused % SEQUENCES,
        now.flags,
        feet,
        now.voltage,
        now.current,
        now.percentage,
        *senses.orientation,
        *senses.angular_velocity,
        *senses.linear_acceleration,
        *(value for motor in by_motor for value in motor),
        *(max(-32768, min(32767, round(10 * value))) for value in now.temperatures),
    )
    return encode(AlphaFrame(STATE, sequence, payload))


def decode_state(frame: AlphaFrame) -> State | None:
    """Return the report in a frame, or None if a value is impossible."""
    milliseconds, echo, refused, flags, feet, *rest = _STATE.unpack(frame.payload)
    numbers, temperatures = rest[:49], rest[49:]
    if not all(abs(value) < _MAX_VALUE for value in numbers):
        return None
    voltage, current, percentage, *rest = numbers
    (x, y, z, w), rate, acceleration, joints = rest[:4], rest[4:7], rest[7:10], rest[10:]
    norm = math.hypot(x, y, z, w)
    if not 0.9 < norm < 1.1 or voltage < 0 or not 0 <= percentage <= 100:
        return None
    senses = Senses(
        joints=by_leg(joints[0::3]),
        rates=by_leg(joints[1::3]),
        contacts=tuple(bool(feet >> foot & 1) for foot in range(4)),
        orientation=(x / norm, y / norm, z / norm, w / norm),
        angular_velocity=(rate[0], rate[1], rate[2]),
        linear_acceleration=(acceleration[0], acceleration[1], acceleration[2]),
    )
    return State(
        milliseconds=milliseconds,
        echo=echo,
        refused=refused,
        flags=flags,
        voltage=voltage,
        current=current,
        percentage=percentage,
        senses=senses,
        torques=tuple(joints[2::3]),
        temperatures=tuple(value / 10 for value in temperatures),
    )


def is_newer(sequence: int, than: int) -> bool:
    """Return whether `sequence` comes after `than`; handles the wrap."""
    return 0 < (sequence - than) % SEQUENCES < SEQUENCES // 2


def describe(frame: AlphaFrame) -> str:
    """Describe a frame for the log."""
    if frame.type == WALK and (command := decode_walk(frame)):
        gait = command.gait
        return (
            f"{frame.sequence} walk: stride {gait.stride_x:.4f} {gait.stride_y:.4f} m, "
            f"turn {gait.turn:.4f} rad, frequency {gait.frequency:.2f} Hz, duty {gait.duty:.2f}, "
            f"height {gait.height:.3f} m; seen {command.seen} ms"
        )
    if frame.type == PARK:
        return f"{frame.sequence} park"
    if frame.type == STOP:
        return f"{frame.sequence} stop"
    if frame.type == STATE and (now := decode_state(frame)):
        feet = "".join("x" if touches else "." for touches in now.senses.contacts)
        return (
            f"{frame.sequence} state: {now.milliseconds} ms, echo {now.echo}, refused "
            f"{now.refused}, flags {now.flags}, {now.voltage:.2f} V, feet {feet}"
        )
    return f"{frame.sequence} unsound frame of type {frame.type:#04x}"


class AlphaDecoder(FrameDecoder[AlphaFrame]):
    """Finds frames in a stream of bytes."""

    HEADER = MAGIC

    def _size(self, buffer: bytearray) -> int | None:
        if len(buffer) < _HEADER.size:
            return None
        _, length, kind, version, _ = _HEADER.unpack_from(buffer)
        valid = version == VERSION and _LENGTHS.get(kind) == length
        return _HEADER.size + int(length) + _CRC.size if valid else 0

    def _frame(self, data: bytes) -> AlphaFrame | None:
        body, (crc,) = data[: -_CRC.size], _CRC.unpack(data[-_CRC.size :])
        if zlib.crc32(body) != crc:
            return None
        _, _, kind, _, sequence = _HEADER.unpack_from(body)
        return AlphaFrame(kind, sequence, body[_HEADER.size :])
