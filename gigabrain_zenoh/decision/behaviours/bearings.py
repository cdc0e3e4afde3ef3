"""What a behaviour that is sent to places goes by."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import BodyDescription
from gigabrain_schemas.brain import ActuationModel
from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.decision.tasks.orders import Order
from gigabrain_zenoh.navigation.moment import Sent

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Route:
    """A way through the map, to carry out an order."""

    number: int  # of the order
    version: int  # of the route: another place to go to is another version
    goal: Goal | None = None  # where it leads; None where there is none
    points: Floats | None = None  # (n, 2) [m], in the map, from about here to there
    state: Literal["running", "done", "failed"] = "running"
    reason: str = ""  # in words
    aside: bool = False  # it leads elsewhere for a while: to be there is not to have arrived


@dataclass(frozen=True, kw_only=True, eq=False)
class Bearings:
    """Where the body is, what it was told, and where it is wanted."""

    tick: int  # of the scan
    late_ticks: int  # how many have passed since
    delayed: float  # [s], how much longer than usual scans have waited for their answer of late
    velocity: Velocity
    may_back: bool  # whether safety lets it drive backwards at all
    body: BodyDescription | None
    map_from_odom: Pose | None  # None while it is not known where in the map the robot is
    lost: str  # why not, in words
    response: ActuationModel
    sent: tuple[Sent, ...]
    order: Order | None
    route: Route | None  # for that order, once there is one
    waits: str = ""  # what it waits for, where there is no order, in words
    held: str = ""  # why the body does not follow decision now, in words: the gate, an operator


@dataclass(frozen=True, kw_only=True)
class Driven:
    """What became of a route within one scan."""

    version: int
    arrived: bool = False
    blocked: bool = False  # another way is wanted
    reason: str = ""  # what the local planner did, in words
