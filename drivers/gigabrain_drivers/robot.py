"""A robot's YAML file: what the body is, and by which links it can be reached."""

from pathlib import Path
from typing import Any

from msgspec import Struct

from gigabrain_schemas.base import Finite, Name, NonNegative, Positive
from gigabrain_schemas.body import BodyDescription
from gigabrain_zenoh.settings import LinkName

LINKS: tuple[LinkName, ...] = ("sim", "emulated", "real")


class JointLimits(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How far and how fast one joint may go."""

    name: Name
    lower: Finite  # [rad] or [m]
    upper: Finite  # [rad] or [m]
    max_speed: Positive  # [rad/s] or [m/s]


class RobotFile(BodyDescription, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole robot.yaml. Each link names its driver; the rest of it is the driver's own."""

    summary: str  # one line, for `gigabrain robots`
    wheel_separation: NonNegative = 0.0  # [m], of a differential base
    wheel_radius: NonNegative = 0.0  # [m]
    joints: tuple[JointLimits, ...] = ()
    sim: dict[str, Any] | None = None
    emulated: dict[str, Any] | None = None
    real: dict[str, Any] | None = None

    def description(self) -> BodyDescription:
        """The part that the brain goes by."""
        names = BodyDescription.__struct_fields__
        return BodyDescription(**{name: getattr(self, name) for name in names})


class LinkOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What every link has; drivers add their own fields."""

    driver: str


class Run(Struct, frozen=True, kw_only=True):
    """How a driver is run this time."""

    folder: Path  # where the robot's file and its models are
    link: LinkName = "sim"
    world: str = "arena"
    seed: int = 0
    speed: float = 1.0  # of real time; other than 1 means lock-step
    seconds: float | None = None  # of simulated time, then it holds still
