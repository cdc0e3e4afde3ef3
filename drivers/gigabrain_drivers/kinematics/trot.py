"""Trot controller of a quadruped. It uses only what a real robot measures.

Each foot bears the body for part of the cycle, then swings to its next foothold (Raibert, "Legged
Robots That Balance", 1986). Standing feet change their height to keep the body level. Position
targets include the torque that bears the weight, so that servos do not sag. Standing feet also
lean against a velocity error, because servos alone oscillate like springs.
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

MAX_ACCELERATION = Twist(1.0, 1.0, 2.0)  # [m/s2], [rad/s2], of the commanded velocity
VELOCITY_FILTER_S = 0.1  # time constant of the measured velocity's low-pass filter
INTEGRAL_GAIN = 1.0  # [1/s], of the velocity error
MAX_INTEGRAL = Twist(0.2, 0.2, 0.6)  # [m/s], [rad/s]
BRACE_S = 0.12  # offset of a standing foot [m] per velocity error [m/s]
LIFT_M = 0.05  # of a swinging foot
TOUCHDOWN_DEPTH_M = 0.002  # target of a swinging foot, below the floor
CAPTURE_S = 0.12  # offset of a foothold [m] per velocity error [m/s]
MAX_FOOT_OFFSET_M = (0.15, 0.10)  # of a foothold from the foot's home, forward and sideways
TILT_GAIN, TILT_DAMPING_S = 0.45, 0.02  # of roll and pitch, by the height of standing feet
MAX_FOOT_SPEED = 2.0  # [m/s], vertical, of a standing foot
MAX_HEIGHT_SPEED = 0.1  # [m/s], vertical, of the body
AT_REST_COMMAND = 1e-3  # [m/s], [rad/s]; stepping ends if the command is below this,
AT_REST_SPEED = 0.15  # [m/s], and the measured speed below this
FALLEN_TILT_RAD = 0.8  # of roll or pitch


class Trot:
    """The controller. About every 10 ms, call `sense`, then `step`."""

    def __init__(self, geometry: LegGeometry, mass: float, stiffness: float, height: float) -> None:
        self._geometry, self._mass, self._stiffness = geometry, mass, stiffness
        self.odometry = LegOdometry(geometry)
        self.fallen = False
        self._height = height  # [m], of the hips above the feet
        self._feet = [leg.home(height) for leg in geometry.legs]
        self._lift_off: list[Vector | None] = [None] * 4  # where each swinging foot left the floor
        self._command = self._measured = self._integral = Twist(0.0, 0.0, 0.0)
        self._phase = 0.0
        self.stepping = False  # False while all feet stay on the floor

    def resume(self, joints: tuple[Vector, ...]) -> None:
        """Stand at rest with these joint angles [rad]."""
        legs = self._geometry.legs
        self._feet = [leg.foot(its) for leg, its in zip(legs, joints, strict=True)]
        self._height = -sum(z for _, _, z in self._feet) / len(self._feet)

    def sense(self, senses: Senses, passed_s: float) -> None:
        """Integrate a sample, `passed_s` after the last one."""
        self.odometry.update(senses, passed_s)
        self.fallen = self.fallen or max(map(abs, senses.tilt())) > FALLEN_TILT_RAD

    def step(self, gait: Gait, senses: Senses, passed_s: float) -> tuple[Vector, ...]:
        """Return each leg's joint targets [rad] for the next `passed_s`."""
        if self.fallen:
            return senses.joints  # limp, so that the legs do not thrash
        roll, pitch = senses.tilt()
        twist = self._target_velocity(gait, passed_s)
        roll_rate, pitch_rate, _ = senses.angular_velocity
        tilt = (
            TILT_GAIN * roll + TILT_DAMPING_S * roll_rate,
            TILT_GAIN * pitch + TILT_DAMPING_S * pitch_rate,
        )
        bearing = []
        for leg, phase in enumerate(gait.phases):
            foot_phase = (self._phase + phase) % 1.0
            swings = self.stepping and foot_phase >= gait.duty
            if swings:
                self._swing(leg, (foot_phase - gait.duty) / (1 - gait.duty), twist, gait)
            else:
                self._stand(leg, twist, tilt, passed_s)
            # at rest all feet bear weight; by contact alone, two could keep the others in the air
            bearing.append(not swings and (senses.contacts[leg] or not self.stepping))
        return self._servo_targets(senses, bearing)

    def _target_velocity(self, gait: Gait, passed_s: float) -> Twist:
        """Return the gait's velocity, with limited acceleration, plus the integral of the error."""
        parts = zip(self._command, Walker.to_body(gait), MAX_ACCELERATION, strict=True)
        self._command = Twist(*(now + _clamped(to - now, a * passed_s) for now, to, a in parts))
        pairs = zip(self._measured, self.odometry.velocity, strict=True)
        gain = passed_s / VELOCITY_FILTER_S
        self._measured = Twist(*(last + gain * (now - last) for last, now in pairs))
        self._height += _clamped(gait.height - self._height, MAX_HEIGHT_SPEED * passed_s)
        self._advance_phase(gait, passed_s)
        if not self.stepping:  # an integral that decays slowly would turn a standing body
            self._integral = Twist(0.0, 0.0, 0.0)
            return self._integral
        errors = zip(self._integral, self._command, self._measured, MAX_INTEGRAL, strict=True)
        self._integral = Twist(
            *(
                _clamped(integral + INTEGRAL_GAIN * passed_s * (to - now), limit)
                for integral, to, now, limit in errors
            )
        )
        return Twist(*(a + b for a, b in zip(self._command, self._integral, strict=True)))

    def _advance_phase(self, gait: Gait, passed_s: float) -> None:
        """Continue the cycle; at rest it ends as soon as no foot is in the air."""
        measured = self.odometry.velocity
        moving = (
            max(map(abs, self._command)) > AT_REST_COMMAND
            or max(map(abs, measured[:2])) > AT_REST_SPEED
        )
        in_air = any((self._phase + phase) % 1.0 >= gait.duty for phase in gait.phases)
        self.stepping = moving or (self.stepping and in_air)
        self._phase = (self._phase + passed_s * gait.frequency) % 1.0 if self.stepping else 0.0

    def _stand(self, leg: int, twist: Twist, tilt: tuple[float, float], passed_s: float) -> None:
        """Move a standing foot against the body's motion, and up or down to level the body."""
        x, y, z = self._feet[leg]
        self._lift_off[leg] = None
        home_x, home_y, home_z = self._geometry.legs[leg].home(self._height)
        level = home_z + home_y * tilt[0] - home_x * tilt[1]
        self._feet[leg] = (
            x + passed_s * (twist.angular_z * y - twist.linear_x),
            y - passed_s * (twist.angular_z * x + twist.linear_y),
            z + _clamped(level - z, MAX_FOOT_SPEED * passed_s),
        )

    def _swing(self, leg: int, progress: float, twist: Twist, gait: Gait) -> None:
        """Move a swinging foot to its next foothold: below its hip in the middle of the stance.

        At lift-off and touchdown it has the velocity of standing feet.
        """
        start = self._lift_off[leg] or self._feet[leg]
        self._lift_off[leg] = start
        home_x, home_y, home_z = self._geometry.legs[leg].home(self._height)
        speed_x = twist.linear_x - twist.angular_z * home_y
        speed_y = twist.linear_y + twist.angular_z * home_x
        half_stance_s = gait.duty / gait.frequency / 2
        error_x = self._measured.linear_x - self._command.linear_x
        error_y = self._measured.linear_y - self._command.linear_y
        x = home_x + _clamped(half_stance_s * speed_x + CAPTURE_S * error_x, MAX_FOOT_OFFSET_M[0])
        y = home_y + _clamped(half_stance_s * speed_y + CAPTURE_S * error_y, MAX_FOOT_OFFSET_M[1])
        swing_s = (1 - gait.duty) / gait.frequency
        self._feet[leg] = (
            _hermite(start[0], x, -speed_x * swing_s, progress),
            _hermite(start[1], y, -speed_y * swing_s, progress),
            _hermite(start[2], home_z - TOUCHDOWN_DEPTH_M, 0.0, progress)
            + LIFT_M * math.sin(math.pi * progress) ** 2,
        )

    def _servo_targets(self, senses: Senses, bearing: list[bool]) -> tuple[Vector, ...]:
        """Return the joint angles for the feet, with an offset against the sag under the weight."""
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
        """Return the target of a standing foot, with an offset against the velocity error."""
        pairs = zip(self.odometry.velocity, self._command, strict=True)
        forward, left, turn = (BRACE_S * (now - to) for now, to in pairs)
        x, y, z = foot
        return x + forward - turn * y, y + left + turn * x, z


def _hermite(start: float, end: float, speed: float, t: float) -> float:
    """Interpolate at `t` (0-1), with the same `speed` (per unit of t) at both ends."""
    eased = t * t * (3 - 2 * t)
    return start + (end - start) * eased + speed * t * (1 - t) * (1 - 2 * t)


def _clamped(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))
