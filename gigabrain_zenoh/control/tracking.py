"""Trajectory tracking, based on the body's predicted pose when a command takes effect.

Feed-forward compensates the body's lag. Feedback for bodies that cannot move sideways is that of De
Luca, Oriolo and Samson (1998, equation 4.73). For bodies that can, it is proportional on each axis.
"""

import math
from bisect import bisect_right

from gigabrain_schemas.base import TICK_S, Pose, Velocity
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.brain import ActuationModel, Intent, TrajectoryPoint
from gigabrain_zenoh.geometry.limits import ZERO
from gigabrain_zenoh.geometry.pose import compose, interpolate, relative

MAX_DELAY_TICKS = 15
MAX_ERROR_M, MAX_ERROR_RAD = 0.3, 0.8  # with larger errors the trajectory is given up
DAMPING, STIFFNESS = 0.7, 10.0  # of the feedback; [1], [1/m2]
MIN_BANDWIDTH, MAX_BANDWIDTH = 0.8, 2.5  # [1/s], of the feedback
LATERAL_GAIN = 1.5  # [1/s], feedback for bodies that can move sideways
MIN_LAG_S, MAX_LAG_S = 1e-3, 0.5
MAX_GAIN = 2.0  # turn rates are corrected by at most this factor, up or down


def track(
    body: BodyDescription,
    intent: Intent,
    state: RobotState,
    start: Pose,
    sent: tuple[Velocity, ...],
) -> Velocity | None:
    """Return the command that tracks the intent's trajectory; None if the body is too far off.

    `start` is the odometry pose at the intent's basis, `sent` the commands of the previous ticks,
    newest last. After the end of the trajectory the command is zero.
    """
    delay_ticks = min(round(intent.response.delay / TICK_S), MAX_DELAY_TICKS)
    t = (state.tick - intent.basis + delay_ticks) * TICK_S
    points = intent.trajectory
    i = bisect_right(points, t, key=lambda point: point.t)
    if i == len(points):
        return ZERO
    before, after = points[max(i - 1, 0)], points[i]
    target = interpolate(_pose(before), _pose(after), _fraction(before, after, t))
    here = predict(state.pose, state.velocity, sent, delay_ticks, intent.response)
    error = relative(here, compose(start, target))
    if math.hypot(error.x, error.y) > MAX_ERROR_M or abs(error.yaw) > MAX_ERROR_RAD:
        return None
    planned = _compensate_lag(before, after, intent.response)
    if body.max_lateral_speed > 0 and body.drive_type != "ackermann":
        return _holonomic(planned, error)
    return within_turning_circle(body, _unicycle(planned, error))


def turn_correction(turn_gain: float) -> float:
    """Return the factor for turn rates that compensates `turn_gain`, within MAX_GAIN."""
    return max(1.0 / MAX_GAIN, min(MAX_GAIN, 1.0 / turn_gain))


def predict(
    here: Pose, velocity: Velocity, sent: tuple[Velocity, ...], ticks: int, response: ActuationModel
) -> Pose:
    """Return the body's pose after `ticks` ticks of the commands already `sent`."""
    gain = 1.0 - math.exp(-TICK_S / _lag(response))
    vx, vy, w = velocity.linear_x, velocity.linear_y, velocity.angular_z
    pose = here
    for command in sent[-ticks:] if ticks else ():
        vx += gain * (command.linear_x - vx)
        vy += gain * (command.linear_y - vy)
        w += gain * (command.angular_z - w)
        middle = Pose(x=pose.x, y=pose.y, yaw=pose.yaw + w * TICK_S / 2)
        pose = compose(middle, Pose(x=vx * TICK_S, y=vy * TICK_S, yaw=w * TICK_S / 2))
    return pose


def _lag(response: ActuationModel) -> float:
    return max(MIN_LAG_S, min(MAX_LAG_S, response.lag))


def _pose(point: TrajectoryPoint) -> Pose:
    return Pose(x=point.x, y=point.y, yaw=point.yaw)


def _fraction(before: TrajectoryPoint, after: TrajectoryPoint, t: float) -> float:
    length = after.t - before.t
    return max(0.0, min(1.0, (t - before.t) / length)) if length > 0 else 1.0


def _compensate_lag(
    before: TrajectoryPoint, after: TrajectoryPoint, response: ActuationModel
) -> Velocity:
    """Return the constant command that takes a lagging body from one velocity to the next."""
    remaining = math.exp(-max(after.t - before.t, TICK_S) / _lag(response))
    return Velocity(
        linear_x=(after.linear_x - remaining * before.linear_x) / (1.0 - remaining),
        linear_y=(after.linear_y - remaining * before.linear_y) / (1.0 - remaining),
        angular_z=(after.angular_z - remaining * before.angular_z) / (1.0 - remaining),
    )


def _unicycle(planned: Velocity, error: Pose) -> Velocity:
    v, w = planned.linear_x, planned.angular_z
    bandwidth = min(max(math.sqrt(w * w + STIFFNESS * v * v), MIN_BANDWIDTH), MAX_BANDWIDTH)
    along = 2 * DAMPING * bandwidth
    across = min(STIFFNESS * abs(v), bandwidth * bandwidth / max(abs(v), 1e-6))
    sinc = math.sin(error.yaw) / error.yaw if abs(error.yaw) > 1e-6 else 1.0
    return Velocity(
        linear_x=v * math.cos(error.yaw) + along * error.x,
        angular_z=w + math.copysign(across, v) * sinc * error.y + along * error.yaw,
    )


def _holonomic(planned: Velocity, error: Pose) -> Velocity:
    cosine, sine = math.cos(error.yaw), math.sin(error.yaw)
    vx, vy = planned.linear_x, planned.linear_y
    return Velocity(
        linear_x=cosine * vx - sine * vy + LATERAL_GAIN * error.x,
        linear_y=sine * vx + cosine * vy + LATERAL_GAIN * error.y,
        angular_z=planned.angular_z + LATERAL_GAIN * error.yaw,
    )


def within_turning_circle(body: BodyDescription, wanted: Velocity) -> Velocity:
    """Limit the turn rate of an Ackermann base to its turning radius."""
    if body.drive_type != "ackermann":
        return wanted
    limit = abs(wanted.linear_x) / body.turning_radius
    return Velocity(linear_x=wanted.linear_x, angular_z=max(-limit, min(limit, wanted.angular_z)))
