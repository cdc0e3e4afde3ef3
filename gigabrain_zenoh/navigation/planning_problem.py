"""Inputs of a plan's cost: the body, its surroundings, the goal, and the weights."""

from typing import NamedTuple

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.kernels.jit import lean_kernel
from gigabrain_zenoh.navigation.car_track import no_track
from gigabrain_zenoh.navigation.footprint import DistanceGrid, Outline, Placement
from gigabrain_zenoh.navigation.motion_model import COSINE, SINE, VX, VY, YAW, MotionModel, W, X, Y


class Scene(NamedTuple):
    """Surroundings of the body, and the goal."""

    grid: DistanceGrid  # distances to static obstacles
    field: DistanceGrid  # cost to go [m]
    discs: Floats  # (m, 6): x, y [m], velocity x, y [m/s], radius [m] and its growth [m/s]
    goal_x: float  # [m]
    goal_y: float
    goal_yaw: float  # [rad]; nan for any
    tolerance: float  # [m], of the goal's position
    yaw_tolerance: float  # [rad]
    track: Floats = no_track()  # (n, 4), of a car, see `car_track.track_of`


class Weights(NamedTuple):
    """Weights of the cost terms."""

    margin: float = 0.03  # [m], a smaller clearance is a contact
    near: float = 3.0  # of nearby obstacles, per second
    near_over: float = 0.08  # [m], decay length of `near`
    tight: float = 1.5  # of excess speed in tight places, per (m/s)2 and second
    tight_speed: float = 0.45  # [m/s], allowed at a clearance of `margin`
    tight_rate: float = 4.0  # [1/s], additional speed per metre of clearance
    turning: float = 0.02  # per (rad/s)2 and second
    backwards: float = 1.0  # per metre in reverse
    heading: float = 0.8  # of facing away from the way to the goal, as a share of the turning time
    disc: float = 3.0  # of nearby moving obstacles, per second
    disc_over: float = 0.3  # [m], decay length of `disc`
    disc_margin: float = 0.02  # [m], a smaller distance to a moving obstacle is a contact
    disc_lead: float = 0.0  # [s], increase of `disc_over` per m/s of the obstacle's speed
    trust: float = 0.0  # [s], time constant of the trust in predictions; 0: constant trust


class Problem(NamedTuple):
    """Everything that the cost of a plan depends on."""

    model: MotionModel
    outline: Outline
    weights: Weights
    scene: Scene
    dt: float  # [s], duration of a step


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
