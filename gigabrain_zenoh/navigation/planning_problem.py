"""Inputs of a plan's cost: the body, its surroundings, the goal, and the weights."""

from typing import NamedTuple

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.kernels.jit import lean_kernel
from gigabrain_zenoh.navigation.car_track import no_track
from gigabrain_zenoh.navigation.footprint import DistanceGrid, Outline, Placement
from gigabrain_zenoh.navigation.motion_model import COSINE, SINE, VX, VY, YAW, MotionModel, W, X, Y


class Scene(NamedTuple):
    """Everything around the body, and the goal."""

    grid: DistanceGrid  # distances to what stands still
    field: DistanceGrid  # cost to go [m]
    discs: Floats  # (m, 6): x, y [m], velocity x, y [m/s], radius [m] and its growth [m/s]
    goal_x: float  # [m]
    goal_y: float
    goal_yaw: float  # [rad]; nan where any will do
    tolerance: float  # [m]
    yaw_tolerance: float  # [rad]
    track: Floats = no_track()  # (n, 4), that a car follows, see car_track


class Weights(NamedTuple):
    """Weights of the cost terms."""

    margin: float = 0.03  # [m], nearer than this is a contact
    near: float = 3.0  # of having obstacles near, per second
    near_over: float = 0.08  # [m], over which that decays
    tight: float = 1.5  # of speed in tight places, per second
    tight_speed: float = 0.45  # [m/s], always allowed
    tight_rate: float = 4.0  # [1/s], more speed per metre of room
    turning: float = 0.02  # per (rad/s)2 and second
    backwards: float = 1.0  # per m
    heading: float = 0.8  # of facing away from the goal, in units of the time it takes to turn
    disc: float = 3.0  # of having moving things near, per second
    disc_over: float = 0.3  # [m]
    disc_margin: float = 0.02  # [m]
    disc_lead: float = 0.0  # [s], so much farther per m/s of a thing's speed
    trust: float = 0.0  # [s], over which what is foreseen of them fades; 0 where it does not


class Problem(NamedTuple):
    """Everything that the cost of a plan depends on."""

    model: MotionModel
    outline: Outline
    weights: Weights
    scene: Scene
    dt: float  # [s], of a step


class MotionState(NamedTuple):
    """Pose and velocity of a body at one step."""

    at: Placement
    yaw: float  # [rad]
    vx: float  # [m/s]
    vy: float
    w: float  # [rad/s]


@lean_kernel
def motion_of(state: Floats, lane: int) -> MotionState:
    """Return one lane of a `state` (STATE,)."""
    at = Placement(state[X + lane], state[Y + lane], state[COSINE + lane], state[SINE + lane])
    return MotionState(at, state[YAW + lane], state[VX + lane], state[VY + lane], state[W + lane])
