"""Walking on four legs by a gait's parameters, on what a real robot measures.

Each foot bears the body for a part of the cycle and is then lifted to where it will be needed
(Raibert, "Legged Robots That Balance", 1986). The heights of standing feet keep the body level,
and the torques that bear its weight are added to the position targets, so that servos do not sag.
They also lean against what the body is too fast by: servos alone are springs, and swing on.
"""

import math

from gigabrain_drivers.kinematics import Vector
from gigabrain_drivers.kinematics.legs import (
    GRAVITY,
    Gait,
    LegGeometry,
    LegOdometry,
    Senses,
    Walker,
)
from gigabrain_drivers.kinematics.wheels import Twist

ACCELERATION = Twist(1.0, 1.0, 2.0)  # [m/s2], [rad/s2]
SMOOTH_S = 0.1  # over which the measured velocity is smoothed
INTEGRAL_GAIN = 1.0  # [1/s], of the velocity error
MAX_INTEGRAL = Twist(0.2, 0.2, 0.6)  # [m/s], [rad/s]
BRACE_S = 0.12  # how far, in time, a standing foot leans for each m/s too fast
LIFT = 0.05  # [m], of a swinging foot
PRESS = 0.002  # [m], below the floor, where a swinging foot is put down
CAPTURE_S = 0.12  # how far, in time, a foot is put ahead for each m/s too fast
MAX_FOOT_OFFSET = (0.15, 0.10)  # [m], of a foot from its home, ahead and sideways
LEVEL_GAIN, DAMP_S = 0.45, 0.02  # how firmly the standing feet hold the body level
FOOT_SPEED = 2.0  # [m/s], up or down, of a standing foot
HEIGHT_SPEED = 0.1  # [m/s], of the whole body
AT_REST_COMMAND = 1e-3  # [m/s] and [rad/s], below which stepping ends,
AT_REST_SPEED = 0.15  # [m/s], when the measured speed is below this too
FALLEN = 0.8  # [rad] of roll or pitch


class Trot:
    """Every 10 ms or so `sense`, then `step`: what it needs to know, it takes from the senses."""

    def __init__(self, geometry: LegGeometry, mass: float, stiffness: float, height: float) -> None:
        self._geometry, self._mass, self._stiffness = geometry, mass, stiffness
        self.odometry = LegOdometry(geometry)
        self.fallen = False
        self._height = height  # [m], of the hips above the feet
        self._feet = [leg.home(height) for leg in geometry.legs]
        self._lifted: list[Vector | None] = [None] * 4  # where a swinging foot left the floor
        self._command = self._measured = self._integral = Twist(0.0, 0.0, 0.0)
        self._phase = 0.0
        self.stepping = False  # whether feet are lifted at all

    def sense(self, senses: Senses, passed_s: float) -> None:
        """Integrate a sample, `passed_s` after the one before."""
        self.odometry.update(senses, passed_s)
        self.fallen = self.fallen or max(map(abs, senses.tilt())) > FALLEN

    def step(self, gait: Gait, senses: Senses, passed_s: float) -> tuple[Vector, ...]:
        """The position targets of each leg's joints [rad] for the next `passed_s`."""
        if self.fallen:
            return senses.joints  # limp: legs must not go on thrashing
        roll, pitch = senses.tilt()
        twist = self._follow(gait, passed_s)
        rolling, pitching, _ = senses.angular_velocity
        tilt = (LEVEL_GAIN * roll + DAMP_S * rolling, LEVEL_GAIN * pitch + DAMP_S * pitching)
        bearing = []
        for leg, phase in enumerate(gait.phases):
            share = (self._phase + phase) % 1.0
            swings = self.stepping and share >= gait.duty
            if swings:
                self._swing(leg, (share - gait.duty) / (1 - gait.duty), twist, gait)
            else:
                self._stand(leg, twist, tilt, passed_s)
            # at rest all bear: by touch, two feet would hold the body up and off the other two
            bearing.append(not swings and (senses.contacts[leg] or not self.stepping))
        return self._servo_targets(senses, bearing)

    def _follow(self, gait: Gait, passed_s: float) -> Twist:
        """The velocity to step for: the gait's, reached gradually, corrected by what came of it."""
        parts = zip(self._command, Walker.to_body(gait), ACCELERATION, strict=True)
        self._command = Twist(*(now + _within(to - now, a * passed_s) for now, to, a in parts))
        pairs = zip(self._measured, self.odometry.velocity, strict=True)
        share = passed_s / SMOOTH_S
        self._measured = Twist(*(before + share * (now - before) for before, now in pairs))
        self._height += _within(gait.height - self._height, HEIGHT_SPEED * passed_s)
        self._pace(gait, passed_s)
        if not self.stepping:  # an integral that faded would turn a standing body for a second
            self._integral = Twist(0.0, 0.0, 0.0)
            return self._integral
        errors = zip(self._integral, self._command, self._measured, MAX_INTEGRAL, strict=True)
        self._integral = Twist(
            *(
                _within(sum_ + INTEGRAL_GAIN * passed_s * (to - now), most)
                for sum_, to, now, most in errors
            )
        )
        return Twist(*(a + b for a, b in zip(self._command, self._integral, strict=True)))

    def _pace(self, gait: Gait, passed_s: float) -> None:
        """Go on with the cycle, which ends at rest as soon as no foot is in the air."""
        measured = self.odometry.velocity
        moving = (
            max(map(abs, self._command)) > AT_REST_COMMAND
            or max(map(abs, measured[:2])) > AT_REST_SPEED
        )
        lifted = any((self._phase + phase) % 1.0 >= gait.duty for phase in gait.phases)
        self.stepping = moving or (self.stepping and lifted)
        self._phase = (self._phase + passed_s * gait.frequency) % 1.0 if self.stepping else 0.0

    def _stand(self, leg: int, twist: Twist, tilt: tuple[float, float], passed_s: float) -> None:
        """Push the body on: a standing foot moves against it, and holds it level."""
        x, y, z = self._feet[leg]
        self._lifted[leg] = None
        home_x, home_y, home_z = self._geometry.legs[leg].home(self._height)
        level = home_z + home_y * tilt[0] - home_x * tilt[1]
        self._feet[leg] = (
            x + passed_s * (twist.angular_z * y - twist.linear_x),
            y - passed_s * (twist.angular_z * x + twist.linear_y),
            z + _within(level - z, FOOT_SPEED * passed_s),
        )

    def _swing(self, leg: int, done: float, twist: Twist, gait: Gait) -> None:
        """Carry a lifted foot to where the body will be over it in the middle of its stand.

        It leaves the floor and comes back to it as fast as standing feet move.
        """
        start = self._lifted[leg] or self._feet[leg]
        self._lifted[leg] = start
        home_x, home_y, home_z = self._geometry.legs[leg].home(self._height)
        speed_x = twist.linear_x - twist.angular_z * home_y
        speed_y = twist.linear_y + twist.angular_z * home_x
        half_s = gait.duty / gait.frequency / 2
        error_x = self._measured.linear_x - self._command.linear_x
        error_y = self._measured.linear_y - self._command.linear_y
        x = home_x + _within(half_s * speed_x + CAPTURE_S * error_x, MAX_FOOT_OFFSET[0])
        y = home_y + _within(half_s * speed_y + CAPTURE_S * error_y, MAX_FOOT_OFFSET[1])
        swing_s = (1 - gait.duty) / gait.frequency
        self._feet[leg] = (
            _hermite(start[0], x, -speed_x * swing_s, done),
            _hermite(start[1], y, -speed_y * swing_s, done),
            _hermite(start[2], home_z - PRESS, 0.0, done) + LIFT * math.sin(math.pi * done) ** 2,
        )

    def _servo_targets(self, senses: Senses, bearing: list[bool]) -> tuple[Vector, ...]:
        """Angles for the feet, and the weight that each bearing one carries, as an angle."""
        weight = self._mass * GRAVITY / max(2, sum(bearing))
        targets = []
        for leg, foot, joints, bears in zip(
            self._geometry.legs, self._feet, senses.joints, bearing, strict=True
        ):
            a, b, c = leg.joints(self._braced(foot) if bears else foot)
            if bears:
                sag = weight / self._stiffness
                (*_, za), (*_, zb), (*_, zc) = leg.jacobian(joints)
                a, b, c = a - sag * za, b - sag * zb, c - sag * zc
            targets.append((a, b, c))
        return tuple(targets)

    def _braced(self, foot: Vector) -> Vector:
        """Return the target of a standing foot that slows down a body that is too fast."""
        pairs = zip(self.odometry.velocity, self._command, strict=True)
        ahead, left, turning = (BRACE_S * (now - to) for now, to in pairs)
        x, y, z = foot
        return x + ahead - turning * y, y + left + turning * x, z


def _hermite(start: float, end: float, speed: float, done: float) -> float:
    """On the way from `start` to `end`, with the same `speed` (per whole way) at both."""
    eased = done * done * (3 - 2 * done)
    return start + (end - start) * eased + speed * done * (1 - done) * (1 - 2 * done)


def _within(value: float, most: float) -> float:
    return max(-most, min(most, value))
