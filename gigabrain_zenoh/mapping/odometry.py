"""Fuses odometry and gyro: distances come from the wheels, turns from the gyro.

Wheels slip and their track is known roughly, which affects the heading first. A gyro's bias drifts
slowly and is measured at rest. Where the two disagree, a wheel slips. A gyro measures rates, so
where states are missing the turn comes from the wheels.
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

KEPT = 250  # states, so 5 s
GAP_TICKS = 25  # no pose is made up between states that lie farther apart,
GYRO_TICKS = 5  # and no turn from the gyro

REST_TICKS = 25  # without a turn of a wheel, then what the gyro says is its bias
REST_RATE = 0.02  # [rad/s], faster is no bias: the robot is being turned
FIRST_RATE = 0.1  # [rad/s], the bias of a gyro that was never at rest before
BIAS_SHARE = 0.02  # of a new reading at 50 Hz: over about a second; the first ones are averaged

SLIP_RATE = 0.15  # [rad/s] between wheels and gyro, smoothed
SLIP_SHARE = 0.1  # of a new difference: over about 0.2 s
GYRO = 0.3  # of the yaw's deviation by wheels alone
SLIPPING = 5.0  # so much more uncertain is what the wheels say then
LAG_S = 0.02  # standard deviation of the time between odometry and a scan of its tick

JUMP_FACTOR, JUMP_M, JUMP_RAD = 2.0, 0.2, 0.5  # more than the body can do is no motion
GLITCH_RATE = 5.0  # [rad/s], of a gyro beyond what the body can do, even if it is turned by hand


class OdometrySample(NamedTuple):
    """Dead reckoning at one tick."""

    tick: int
    odometry: Floats  # (3,), as the body says it
    fused: Floats  # (3,), with the gyro's heading
    slipping: bool
    jumps: int  # how often the odometry has jumped since the start
    unaided: int = 0  # how many of the steps since then turned by what the wheels say alone
    rate: float = 0.0  # [rad/s], of the turn


class OdometryFusion:
    """Dead reckoning over the states of one start of the driver."""

    def __init__(self) -> None:
        self._moments: deque[OdometrySample] = deque(maxlen=KEPT)
        self.bias = 0.0  # [rad/s], of the gyro
        self._readings = 0  # that it is the mean of; 0: it is not known
        self._rate: float | None = None  # [rad/s], the gyro's last reading without its bias
        self._rest = 0  # ticks
        self._quiet, self._mean = 0, 0.0  # readings at this rest, and their mean [rad/s]
        self._slip = 0.0  # [rad/s], smoothed

    @property
    def newest(self) -> OdometrySample | None:
        """The last sample."""
        return self._moments[-1] if self._moments else None

    def add(self, state: RobotState, body: BodyDescription) -> None:
        """Take one state; one that is not newer than the last is left out."""
        pose = from_pose(state.pose)
        last = self.newest
        if last is None:
            self._rate = self._turn_rate(state, body)
            self._moments.append(OdometrySample(state.tick, pose, pose, slipping=False, jumps=0))
            return
        if state.tick <= last.tick:
            return
        ticks = state.tick - last.tick
        step = between(last.odometry, pose).tolist()
        fused, jumps, unaided, rate = last.fused, last.jumps, last.unaided, 0.0
        if jumped(step, ticks * TICK_NS / 1e9, body):
            self._rate, self._rest = self._turn_rate(state, body), 0
            jumps += 1
        else:
            turn = self._turn(self._turn_rate(state, body), step, ticks)
            unaided += turn is None
            turn = step[2] if turn is None else turn
            fused, rate = advanced(fused, step, turn), turn / (ticks * TICK_NS / 1e9)
        self._moments.append(
            OdometrySample(state.tick, pose, fused, self.slipping, jumps, unaided, rate)
        )

    @property
    def slipping(self) -> bool:
        """Return whether wheels and gyro disagree."""
        return abs(self._slip) > SLIP_RATE

    def at(self, tick: int) -> OdometrySample | None:
        """Return the sample of `tick`, interpolated between two states.

        None if it is not known yet, or if too many states are missing.
        """
        moments = self._moments
        place = bisect_left(moments, tick, key=lambda moment: moment.tick)
        if place == len(moments):
            return None
        after = moments[place]
        if after.tick == tick:
            return after
        before = moments[place - 1] if place else after
        if not 0 < after.tick - before.tick <= GAP_TICKS:
            return None
        share = (tick - before.tick) / (after.tick - before.tick)
        return OdometrySample(
            tick,
            _along(before.odometry, after.odometry, share),
            _along(before.fused, after.fused, share),
            after.slipping,
            after.jumps,
            after.unaided,
            after.rate,
        )

    def _turn_rate(self, state: RobotState, body: BodyDescription) -> float | None:
        """Return the gyro's reading without its bias [rad/s]; None for none, or for a glitch."""
        if state.imu is None:
            return None
        rate = state.imu.angular_velocity[2] - self.bias
        glitch = abs(rate) > JUMP_FACTOR * body.max_angular_speed + GLITCH_RATE
        return None if glitch else rate

    def _turn(self, rate: float | None, step: list[float], ticks: int) -> float | None:
        """Return the turn since the last state by the gyro [rad]."""
        before, self._rate = self._rate, rate
        if before is None or self._rate is None or ticks > GYRO_TICKS:
            return None
        if self._learn_bias(step, self._rate):
            return 0.0
        seconds = ticks * TICK_NS / 1e9
        turn = (before + self._rate) / 2 * seconds
        self._slip += SLIP_SHARE * ((step[2] - turn) / seconds - self._slip)
        return turn

    def _learn_bias(self, step: list[float], rate: float) -> bool:
        """Learn the gyro's bias at rest; return whether the body is at rest."""
        if any(step):
            self._rest = self._quiet = 0
            return False
        self._rest += 1
        if abs(rate) > (REST_RATE if self._readings else FIRST_RATE):
            return False
        self._quiet += 1
        self._mean += (rate - self._mean) / self._quiet
        if self._rest < REST_TICKS:
            return False
        if self._readings:
            self._readings += 1
            self.bias += max(BIAS_SHARE, 1 / self._readings) * rate
        else:
            self.bias, self._readings = self._mean, self._quiet
        self._slip = 0.0
        return True


def way(last: OdometrySample, moment: OdometrySample) -> tuple[Floats, Floats]:
    """Return the motion (3,) between two scans, and its covariance (3, 3) in its own frame.

    While the body turns faster and faster, scans that are a little newer show a larger turn.
    """
    step = between(last.fused, moment.fused)
    aided = moment.unaided == last.unaided
    noise = uncertainty(step, slipping=moment.slipping, gyro=aided)
    noise[2, 2] += (LAG_S * (moment.rate - last.rate)) ** 2
    return step, noise


def jumped(step: list[float], seconds: float, body: BodyDescription) -> bool:
    """Return whether `step` (x, y, yaw) within `seconds` is more than this body can do."""
    fastest = max(body.max_linear_speed, body.max_lateral_speed)
    far = math.hypot(step[0], step[1]) > JUMP_FACTOR * fastest * seconds + JUMP_M
    return far or abs(step[2]) > JUMP_FACTOR * body.max_angular_speed * seconds + JUMP_RAD


def advanced(pose: Floats, step: list[float], turn: float) -> Floats:
    """Return `pose` after a small `step` of the wheels while the body turned by `turn` [rad].

    The step's direction is that at the middle of the turn.
    """
    x, y, _ = composed(0.0, 0.0, (turn - step[2]) / 2, *step)
    return compose(pose, np.array((x, y, turn)))


def uncertainty(step: Floats, *, slipping: bool, gyro: bool = False) -> Floats:
    """Return the covariance (3, 3) of `step` in its own frame: about 5 % of its length and turn.

    With a gyro the deviation of the turn is multiplied by GYRO.
    """
    factor = SLIPPING if slipping else 1.0
    way, turn = math.hypot(float(step[0]), float(step[1])), abs(float(step[2]))
    xy = factor * (0.002 + 0.05 * way + 0.02 * turn)
    yaw = factor * (0.002 + 0.02 * turn + 0.01 * way) * (GYRO if gyro else 1.0)
    return np.diag((xy, xy, yaw)) ** 2


def _along(first: Floats, second: Floats, share: float) -> Floats:
    return compose(first, share * between(first, second))
