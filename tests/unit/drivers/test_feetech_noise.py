"""A servo bus on a disturbed line: what is believed of what it answers, and what it obeys.

A byte is hit with a chance of 1 in 1000: replaced by another, or with one bit flipped.
"""

import math
import random
from collections import deque
from collections.abc import Callable

import pytest

from gigabrain_drivers.bodies.feetech import protocol as feetech
from gigabrain_drivers.bodies.feetech.calibration import ServoCalibration
from gigabrain_drivers.bodies.feetech.joint import ServoJoint
from gigabrain_drivers.bodies.feetech.protocol import FeetechDecoder
from gigabrain_drivers.bodies.feetech.servo import ServoBus, ServoModel
from gigabrain_schemas.body import JointDescription

BYTE_ERRORS = 0.001
SHORT = 10_000
FULL = pytest.param(1_000_000, marks=pytest.mark.slow)
LATE_FRAMES = 12  # that a servo may wait for the rest of a frame whose length was hit
PERIOD_NS = 10_000_000
CALIBRATION = ServoCalibration(
    id=1, zero=2048, lower=500, upper=3500, offset=0, min_position=500, max_position=3500
)
JOINT = JointDescription(name="lift", lower=-2.0, upper=2.0, max_speed=3.0)
Hit = Callable[[int, random.Random], int]


def replaced(value: int, chance: random.Random) -> int:
    return (value + chance.randrange(1, 256)) % 256


def flipped(value: int, chance: random.Random) -> int:
    return value ^ 1 << chance.randrange(8)


class Line:
    """Hits bytes of what goes over it, the same ones in each run."""

    def __init__(self, hit: Hit) -> None:
        self._chance, self._hit = random.Random(20), hit
        self.hits = 0
        self._left = self._gap()

    def _gap(self) -> int:
        return int(math.log(1.0 - self._chance.random()) / math.log(1.0 - BYTE_ERRORS))

    def carry(self, data: bytes) -> bytes:
        if self._left >= len(data):
            self._left -= len(data)
            return data
        noisy, at = bytearray(data), self._left
        while at < len(noisy):
            noisy[at] = self._hit(noisy[at], self._chance)
            self.hits += 1
            at += 1 + self._gap()
        self._left = at - len(noisy)
        return bytes(noisy)


@pytest.mark.long
@pytest.mark.parametrize("frames", [SHORT, FULL])
@pytest.mark.parametrize("hit", [replaced, flipped])
def test_no_wrong_position_is_believed(hit: Hit, frames: int) -> None:
    line, decoder = Line(hit), FeetechDecoder()
    decoder.expected = feetech.LENGTH
    servo = ServoModel(1)
    joint = ServoJoint(JOINT, CALIBRATION, stall_torque=1.91, torque_limit=1.0, grip_torque=0.4)
    servo.step(0.0, 0.0, 0.0, 0.0)
    rest = servo.read(feetech.FIRST, feetech.LENGTH)
    joint.begin(feetech.decode_readings(rest), 0)
    at = feetech.POSITION.address - feetech.FIRST
    believed = 0
    for frame in range(1, frames + 1):
        ticks = 2048 + round(1200 * math.sin(frame * 0.01))  # up to 1.8 rad/s
        place = feetech.POSITION.encode(ticks)
        answer = feetech.status(1, rest[:at] + place + rest[at + 2 :])
        decoder.clear()
        now_ns = frame * PERIOD_NS
        for packet in decoder.feed(line.carry(answer)):
            if packet.id == 1:
                joint.take(feetech.decode_readings(packet.params), now_ns)
        if joint.received_ns == now_ns:
            believed += 1
            assert joint.newest
            assert joint.newest.position == ticks
    assert line.hits > frames * 0.03
    assert 0.9 * frames < believed < frames


@pytest.mark.long
@pytest.mark.parametrize("frames", [SHORT, FULL])
def test_few_wrong_goals_pass_the_sum_and_each_is_within_limits_and_short(frames: int) -> None:
    line, decoder = Line(replaced), FeetechDecoder()
    servos = [ServoModel(servo) for servo in range(1, 7)]
    for servo in servos:
        servo.keep(feetech.MIN_POSITION, CALIBRATION.min_position)
        servo.keep(feetech.MAX_POSITION, CALIBRATION.max_position)
        servo.write(feetech.TORQUE.address, b"\1")
    bus, lower, upper = ServoBus(servos), CALIBRATION.to_radians(500), CALIBRATION.to_radians(3500)
    sent: deque[bytes] = deque(maxlen=LATE_FRAMES)
    wrong = in_a_row = longest = 0
    for frame in range(frames):
        goal = feetech.GOAL.encode(2048 + frame % 400)
        sent.append(goal)
        goals = dict.fromkeys(range(1, 7), goal)
        for packet in decoder.feed(line.carry(feetech.sync_write(feetech.GOAL.address, goals))):
            bus.execute(packet)
        off = [s for s in servos if s.read(feetech.GOAL.address, 2) not in sent]
        wrong, in_a_row = wrong + bool(off and not in_a_row), in_a_row + 1 if off else 0
        longest = max(longest, in_a_row)
        assert all(lower <= servo.goal <= upper for servo in off)
    assert wrong <= 5
    assert longest <= 1
    assert line.hits > frames * 0.02
