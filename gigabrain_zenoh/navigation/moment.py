"""What the local planner is asked, and what it answers."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from gigabrain_schemas.base import Pose, Positive, Velocity
from gigabrain_schemas.brain import ActuationModel, Obstacle, TrajectoryPoint

Floats = NDArray[np.float64]
Kind = Literal["going", "going round", "waiting", "backing out", "turning in place", "arrived"]


class LocalSettings(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How the local planner works."""

    samples: Annotated[int, Meta(ge=64, le=20_000)] = 1000  # plans per cycle
    steps: Annotated[int, Meta(ge=10, le=60)] = 30  # of 0.05 s for quick bodies, 0.1 s for slow
    window: Annotated[float, Meta(ge=2.0, le=20.0)] = 8.0  # [m], side of what is looked at
    memory: Positive = 10.0  # [s], how long what no beam can check is believed
    linear_speed: Positive | None = None  # [m/s], no faster; the body's own limit holds as well
    position_tolerance: Positive = 0.1  # [m]
    yaw_tolerance: Positive = 0.1  # [rad]
    stuck_after: Positive = 5.0  # [s] in one place, then another way is wanted
    seed: Annotated[int, Meta(ge=0, le=2**32)] = 0


class Goal(Struct, frozen=True, kw_only=True):
    """Where to go, in the frame that is planned in."""

    x: float  # [m]
    y: float  # [m]
    yaw: float | None = None  # [rad]; None where any will do


class Sent(Struct, frozen=True):
    """A command that the body has been given."""

    tick: int  # from which on it holds
    velocity: Velocity


def no_points() -> Floats:
    """(0, 2)."""
    return np.empty((0, 2))


@dataclass(frozen=True, kw_only=True)
class Moment:
    """All that the local planner goes by, in one frame that does not jump: that of the odometry."""

    tick: int  # of the scan
    pose: Pose  # of that tick
    velocity: Velocity  # measured at that tick
    goal: Goal
    hits: Floats  # (n, 2) [m], in the body's frame
    path: Floats | None = None  # (k, 2) [m], to the goal; without one it looks for its own
    known: Floats = field(default_factory=no_points)  # (m, 2) [m], obstacles of the map near by
    obstacles: tuple[Obstacle, ...] = ()
    response: ActuationModel = field(default_factory=ActuationModel)
    sent: tuple[Sent, ...] = ()  # oldest first; those of the last 0.5 s are enough
    delayed: float = 0.0  # [s], how much later than usual what is planned will be obeyed
    may_back: bool = True  # else something is behind it, or it cannot see there


@dataclass(frozen=True, kw_only=True)
class LocalPlan:
    """What to do now, what will come of it, and why."""

    twist: Velocity  # to command now
    trajectory: tuple[TrajectoryPoint, ...]  # expected, in the body's frame of the moment
    kind: Kind
    reason: str  # in words, for people
    blocked: bool = False  # nothing has come of it for a while: another way is wanted
    arrived: bool = False
    remaining: float = 0.0  # [m of free way], cost to go from here
