"""Fuses odometry and gyro: distances come from the wheels, turns from the gyro.

Wheels slip, and their track is not exactly known; both affect the heading first. A gyro's bias
drifts slowly and is measured at rest. If the two disagree, a wheel slips. A gyro measures rates:
over missing states the turn comes from the wheels.
"""

import math
from bisect import bisect_left
from collections import deque
from typing import NamedTuple

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import TICK_NS
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_zenoh.geometry.se2 import between, compose, composed, from_pose

MAX_SAMPLES = 250  # 5 s
MAX_GAP_TICKS = 25  # between states, to interpolate poses
MAX_GYRO_GAP_TICKS = 5  # between states, to use the gyro

REST_TICKS = 25  # without a turn of a wheel, before the gyro's readings count as bias
MAX_BIAS_CHANGE = 0.02  # [rad/s], at rest; a faster robot is turned by hand
MAX_BIAS = 0.1  # [rad/s], before any bias is known
BIAS_GAIN = 0.02  # of a reading at 50 Hz: over about 1 s; the first readings are averaged

SLIP_RATE = 0.15  # [rad/s], smoothed difference of wheels and gyro
SLIP_GAIN = 0.1  # of a new difference: over about 0.2 s
GYRO_FACTOR = 0.3  # on the deviation of yaw, compared with wheels alone
SLIP_FACTOR = 5.0  # on the deviations of odometry while a wheel slips
LAG_S = 0.02  # standard deviation of the time between odometry and a scan of the same tick

MAX_MOTION_FACTOR, JUMP_M, JUMP_RAD = 2.0, 0.2, 0.5  # a larger step is no motion of the body
GLITCH_RATE = 5.0  # [rad/s], beyond the body's own turns: it may be turned by hand


class OdometrySample(NamedTuple):
    """Dead reckoning at one tick."""

    tick: int
    odometry: Floats  # (3,), of the body
    fused: Floats  # (3,), with the gyro's heading
    slipping: bool
    jumps: int  # number of jumps of the odometry since the start
    unaided: int = 0  # number of steps since the start whose turn is from the wheels
    rate: float = 0.0  # [rad/s], of turning


class OdometryFusion:
    """Dead reckoning over the states of one start of the driver."""

    def __init__(self) -> None:
        self._samples: deque[OdometrySample] = deque(maxlen=MAX_SAMPLES)
        self.bias = 0.0  # [rad/s], of the gyro
        self._bias_readings = 0  # averaged in the bias; 0: unknown
        self._last_rate: float | None = None  # [rad/s], the gyro's last reading without its bias
        self._rest_ticks = 0
        self._rest_readings, self._rest_mean = 0, 0.0  # at this rest; [rad/s]
        self._slip = 0.0  # [rad/s], smoothed

    @property
    def newest(self) -> OdometrySample | None:
        """The last sample."""
        return self._samples[-1] if self._samples else None

    def add(self, state: RobotState, body: BodyDescription) -> None:
        """Add a state; drop it if it is not newer than the last."""
        pose = from_pose(state.pose)
        last = self.newest
        if last is None:
            self._last_rate = self._turn_rate(state, body)
            self._samples.append(OdometrySample(state.tick, pose, pose, slipping=False, jumps=0))
            return
        if state.tick <= last.tick:
            return
        ticks = state.tick - last.tick
        step = between(last.odometry, pose).tolist()
        fused, jumps, unaided, rate = last.fused, last.jumps, last.unaided, 0.0
        if is_jump(step, ticks * TICK_NS / 1e9, body):
            self._last_rate, self._rest_ticks = self._turn_rate(state, body), 0
            jumps += 1
        else:
            turn = self._turn(self._turn_rate(state, body), step, ticks)
            unaided += turn is None
            turn = step[2] if turn is None else turn
            fused, rate = advanced(fused, step, turn), turn / (ticks * TICK_NS / 1e9)
        self._samples.append(
            OdometrySample(state.tick, pose, fused, self.slipping, jumps, unaided, rate)
        )

    @property
    def slipping(self) -> bool:
        """Return whether wheels and gyro disagree."""
        return abs(self._slip) > SLIP_RATE

    def at(self, tick: int) -> OdometrySample | None:
        """Return the sample of `tick`, interpolated between two states.

        None if there is no state from then on yet, or if too many states are missing.
        """
        samples = self._samples
        index = bisect_left(samples, tick, key=lambda sample: sample.tick)
        if index == len(samples):
            return None
        after = samples[index]
        if after.tick == tick:
            return after
        before = samples[index - 1] if index else after
        if not 0 < after.tick - before.tick <= MAX_GAP_TICKS:
            return None
        share = (tick - before.tick) / (after.tick - before.tick)
        return OdometrySample(
            tick,
            _interpolated(before.odometry, after.odometry, share),
            _interpolated(before.fused, after.fused, share),
            after.slipping,
            after.jumps,
            after.unaided,
            after.rate,
        )

    def _turn_rate(self, state: RobotState, body: BodyDescription) -> float | None:
        """Return the gyro's reading without bias [rad/s]; None without a gyro, or for a glitch."""
        if state.imu is None:
            return None
        rate = state.imu.angular_velocity[2] - self.bias
        glitch = abs(rate) > MAX_MOTION_FACTOR * body.max_angular_speed + GLITCH_RATE
        return None if glitch else rate

    def _turn(self, rate: float | None, step: list[float], ticks: int) -> float | None:
        """Return the turn since the last state by the gyro [rad]; None if unknown."""
        before, self._last_rate = self._last_rate, rate
        if before is None or self._last_rate is None or ticks > MAX_GYRO_GAP_TICKS:
            return None
        if self._learn_bias(step, self._last_rate):
            return 0.0
        seconds = ticks * TICK_NS / 1e9
        turn = (before + self._last_rate) / 2 * seconds
        self._slip += SLIP_GAIN * ((step[2] - turn) / seconds - self._slip)
        return turn

    def _learn_bias(self, step: list[float], rate: float) -> bool:
        """Learn the gyro's bias at rest; return whether the body is at rest."""
        if any(step):
            self._rest_ticks = self._rest_readings = 0
            return False
        self._rest_ticks += 1
        if abs(rate) > (MAX_BIAS_CHANGE if self._bias_readings else MAX_BIAS):
            return False
        self._rest_readings += 1
        self._rest_mean += (rate - self._rest_mean) / self._rest_readings
        if self._rest_ticks < REST_TICKS:
            return False
        if self._bias_readings:
            self._bias_readings += 1
            self.bias += max(BIAS_GAIN, 1 / self._bias_readings) * rate
        else:
            self.bias, self._bias_readings = self._rest_mean, self._rest_readings
        self._slip = 0.0
        return True


def way(last: OdometrySample, sample: OdometrySample) -> tuple[Floats, Floats]:
    """Return the motion (3,) between two scans, and its covariance (3, 3) in its own frame.

    While the turn rate grows, a scan that is slightly newer than odometry shows a larger turn.
    """
    step = between(last.fused, sample.fused)
    aided = sample.unaided == last.unaided
    noise = uncertainty(step, slipping=sample.slipping, gyro=aided)
    noise[2, 2] += (LAG_S * (sample.rate - last.rate)) ** 2
    return step, noise


def is_jump(step: list[float], seconds: float, body: BodyDescription) -> bool:
    """Return whether `step` (x, y, yaw) within `seconds` is larger than this body can move."""
    fastest = max(body.max_linear_speed, body.max_lateral_speed)
    far = math.hypot(step[0], step[1]) > MAX_MOTION_FACTOR * fastest * seconds + JUMP_M
    return far or abs(step[2]) > MAX_MOTION_FACTOR * body.max_angular_speed * seconds + JUMP_RAD


def advanced(pose: Floats, step: list[float], turn: float) -> Floats:
    """Return `pose` after a small `step` of the wheels while the body turned by `turn` [rad].

    The step's direction is that of the body in the middle of the turn.
    """
    x, y, _ = composed(0.0, 0.0, (turn - step[2]) / 2, *step)
    return compose(pose, np.array((x, y, turn)))


def uncertainty(step: Floats, *, slipping: bool, gyro: bool = False) -> Floats:
    """Return the covariance (3, 3) of `step` in its own frame: about 5 % of its length and turn.

    With a gyro the deviation of the turn is multiplied by GYRO_FACTOR.
    """
    factor = SLIP_FACTOR if slipping else 1.0
    way, turn = math.hypot(float(step[0]), float(step[1])), abs(float(step[2]))
    xy = factor * (0.002 + 0.05 * way + 0.02 * turn)
    yaw = factor * (0.002 + 0.02 * turn + 0.01 * way) * (GYRO_FACTOR if gyro else 1.0)
    return np.diag((xy, xy, yaw)) ** 2


def _interpolated(first: Floats, second: Floats, share: float) -> Floats:
    return compose(first, share * between(first, second))
