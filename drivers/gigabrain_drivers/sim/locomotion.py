"""How a body gets about: on wheels or on legs, behind one interface."""

import abc
from typing import NamedTuple

from gigabrain_drivers.kinematics import Gait, Twist
from gigabrain_drivers.sim.imu import ImuSample
from gigabrain_zenoh.errors import Unsupported


class Motor(NamedTuple):
    """One driven joint as its motor reports it."""

    name: str  # of its joint
    position: float  # [rad]
    velocity: float  # [rad/s]
    effort: float  # [N m]
    temperature: float  # [deg C]


class Odometry(NamedTuple):
    """Where the body's own sensors say that it is, from (0, 0, 0) at the start."""

    x: float  # [m]
    y: float  # [m]
    yaw: float  # [rad], not wrapped
    linear_x: float  # [m/s]
    angular_z: float  # [rad/s]


class Locomotion(abc.ABC):
    """The body's own firmware: commands to motors, sensors to odometry. It never sees the truth.

    In each tick of 10 ms `act` comes before the physics, `sense` and `wear` after it.
    """

    fallen = False  # whether the body lies on the floor

    @abc.abstractmethod
    def command(self, twist: Twist) -> Twist:
        """Aim for a velocity; returns the one that the body can have."""

    def walk(self, gait: Gait) -> None:
        """Aim for a gait instead. Raises Unsupported for a body without legs."""
        raise Unsupported("this body has no legs to walk on")

    @abc.abstractmethod
    def act(self) -> None:
        """Tell the motors what to do in the next tick."""

    @abc.abstractmethod
    def sense(self, imu: ImuSample) -> None:
        """Take in what encoders and inertial unit measured in the tick."""

    @abc.abstractmethod
    def wear(self) -> float:
        """Warm the motors by the tick's work; returns the current [A] that it took."""

    @abc.abstractmethod
    def odometry(self) -> Odometry:
        """Pose and velocity."""

    @abc.abstractmethod
    def velocity(self) -> Twist:
        """As measured, sideways as well."""

    @abc.abstractmethod
    def motors(self) -> tuple[Motor, ...]:
        """All driven joints."""

    def contacts(self) -> tuple[bool, ...]:
        """Which feet bear weight; none for a body without feet."""
        return ()
