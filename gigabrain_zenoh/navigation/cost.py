"""Cost of a plan; one second of driving costs 8.

Clearances of the whole outline take most of the time. Lower bounds without them are computed
first, for all lanes at once, and show which plans need them.
"""

import math

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.kernels.jit import NONE, lean_kernel
from gigabrain_zenoh.navigation.car_track import remaining_track
from gigabrain_zenoh.navigation.footprint import (
    MAX_CLEARANCE_M,
    MAX_SLOPE,
    NEAREST_CELL_ERROR,
    DistanceGrid,
    Outline,
    clearance_of,
    distance_at,
    free_ahead,
    free_along,
    interpolate,
)
from gigabrain_zenoh.navigation.motion_model import (
    COSINE,
    DISC_COST,
    DISC_DISTANCE,
    LANES,
    MIDDLE_DISTANCE,
    MIN_COST,
    MOVED,
    SINE,
    VX,
    VY,
    YAW,
    MotionModel,
    W,
    X,
    Y,
)
from gigabrain_zenoh.navigation.planning_problem import (
    MotionState,
    Problem,
    Scene,
    Weights,
    motion_of,
)

COST_PER_S = 8.0  # of driving
LOOK_AHEAD_M = 0.25  # distance over which the slope of the cost to go is measured
NEAR_GOAL_M = 0.2  # nearer, the field of the cost to go is too coarse
NEXT_WAY_M = 0.5  # of the way in its present direction
MAX_FAR_WAY_M = 3.0  # of the way after that, taken as straight to the goal
SLOW_SPEED = 0.05  # [m/s], below this the body always stops in time
NO_DISC_M = 1e3  # distance without moving obstacles
MAX_DISC_DISTANCE_M = 1.5  # a moving obstacle farther away costs nothing
BRAKING_COST = 16.0  # per second, of full speed with an obstacle ahead; by the square of the excess

DISC_GROWTH_S = 0.5  # afterwards, discs of predictions that fade do not grow
DISC_CONTACT_COST = 200.0  # of a contact with a moving obstacle
DISC_DECAYS = 4.0  # a disc costs nothing beyond this many decay lengths

CONTACT_COST = 300.0
IMPACT_COST = 50.0  # per m/s at a contact
BRAKING_CHECK_STEPS = 3  # braking is checked each third step
AMPLE_ROOM_M = 0.25  # clearance is not checked again before the excess over this is driven
START_TOLERANCE_M = 0.003  # a body that starts in contact has another with this much less clearance


@lean_kernel
def place_cost(
    weights: Weights, scene: Scene, room: float, away: float, motion: MotionState
) -> float:
    """Return the cost of a second at a pose, `room` [m] from obstacles, `away` [m] from discs."""
    cost = 0.0
    if room < MAX_CLEARANCE_M:
        cost += weights.near * exponential((weights.margin - room) / weights.near_over)
    if away < NO_DISC_M and weights.trust == 0.0:
        cost += weights.disc * math.exp(-away / weights.disc_over)
    return cost + time_cost(scene, motion.at.x, motion.at.y, motion.yaw)


@lean_kernel
def exponential(x: float) -> float:
    """Return exp(x), to eight digits from -5 to 5; math.exp takes longer."""
    y = x * (1.0 / 32.0)
    square = y * y
    power = (
        1.0
        + y
        + square * (0.5 + y * (1.0 / 6.0))
        + square * square * (1.0 / 24.0 + y * (1.0 / 120.0) + square * (1.0 / 720.0))
    )
    for _ in range(5):
        power *= power
    return power


@lean_kernel
def time_cost(scene: Scene, x: float, y: float, yaw: float) -> float:
    """Return the cost of a second before arrival, so that the last turn is not put off."""
    return 0.0 if _arrived(scene, x, y, yaw) else 0.5 * COST_PER_S


@lean_kernel
def _arrived(scene: Scene, x: float, y: float, yaw: float) -> bool:
    dx, dy = x - scene.goal_x, y - scene.goal_y
    if dx * dx + dy * dy > scene.tolerance * scene.tolerance:
        return False
    any_yaw = math.isnan(scene.goal_yaw)
    return any_yaw or _turn_between(yaw, scene.goal_yaw) <= scene.yaw_tolerance


@lean_kernel
def motion_cost(weights: Weights, room: float, vx: float, vy: float, w: float) -> float:
    """Return the cost of a second at this velocity, `room` [m] from obstacles."""
    cost = weights.turning * w * w
    excess = math.sqrt(vx * vx + vy * vy) - (
        weights.tight_speed + weights.tight_rate * (room - weights.margin)
    )
    if excess > 0.0:
        cost += weights.tight * excess * excess
    if vx < 0.0:
        cost -= weights.backwards * vx
    return cost


@lean_kernel
def braking_cost(problem: Problem, room: float, motion: MotionState) -> float:
    """Return the cost of a second at a speed at which safety would intervene."""
    model, vx, vy = problem.model, motion.vx, motion.vy
    speed = math.sqrt(vx * vx + vy * vy)
    brake, t = model.deceleration, model.reaction_time
    stopping_distance = speed * t + speed * speed / (2.0 * brake) + model.margin
    if speed < SLOW_SPEED or room >= stopping_distance:
        return 0.0
    sign = 1.0 if vx >= 0.0 else -1.0
    grid, side = problem.scene.grid, model.side_margin
    if model.strafes:
        free = free_along(
            grid, problem.outline, motion.at, (vx / speed, vy / speed), side, stopping_distance
        )
    else:
        free = free_ahead(grid, problem.outline, motion.at, sign, side, stopping_distance)
    allowed = math.sqrt((brake * t) ** 2 + 2.0 * brake * max(0.0, free - model.margin)) - brake * t
    excess = max(0.0, speed - allowed) / model.forward
    return BRAKING_COST * excess * excess


@lean_kernel
def remaining_cost(model: MotionModel, scene: Scene, x: float, y: float, yaw: float) -> float:
    """Return the cost of the way from a pose to the goal. Only cars use the yaw."""
    if len(scene.track) > 0:
        return COST_PER_S * remaining_track(scene.track, model.radius, x, y, yaw) / model.forward
    away = math.hypot(x - scene.goal_x, y - scene.goal_y)
    way = away if away < NEAR_GOAL_M else cost_to_go_at(scene.field, x, y)
    return COST_PER_S * way / model.forward


@lean_kernel
def cost_to_go_at(field: DistanceGrid, x: float, y: float) -> float:
    """Return the cost to go from (x, y) [m]; outside the window, that from its rim."""
    rows, columns = field.distance.shape
    cell = field.cell
    inner_x = min(max(x, field.x + cell), field.x + (columns - 1) * cell)
    inner_y = min(max(y, field.y + cell), field.y + (rows - 1) * cell)
    return distance_at(field, inner_x, inner_y)


@lean_kernel
def terminal_cost(problem: Problem, motion: MotionState) -> float:
    """Return the cost to go after the last step: turn, drive to the goal, turn to its yaw.

    Near the goal, the body only has to stop and turn.
    """
    model, weights, scene = problem.model, problem.weights, problem.scene
    (x, y, cosine, sine), yaw, vx, vy = motion.at, motion.yaw, motion.vx, motion.vy
    cost = remaining_cost(model, scene, x, y, yaw)
    dx, dy = scene.goal_x - x, scene.goal_y - y
    near = math.hypot(dx, dy) < NEAR_GOAL_M
    if len(scene.track) > 0:
        return cost + (0.5 * COST_PER_S * abs(vx) / model.forward if near else 0.0)
    last_turn, any_yaw = 0.0, math.isnan(scene.goal_yaw)
    if not any_yaw:
        arrives = yaw if near else math.atan2(dy, dx)
        last_turn = COST_PER_S * _turn_between(arrives, scene.goal_yaw) / model.turning
    if near:
        return cost + last_turn + 0.5 * COST_PER_S * math.hypot(vx, vy) / model.forward
    here = cost_to_go_at(scene.field, x, y)
    ahead = cost_to_go_at(scene.field, x + LOOK_AHEAD_M * cosine, y + LOOK_AHEAD_M * sine)
    rise = max(-1.0, min(1.0, (ahead - here) / LOOK_AHEAD_M))
    turn = 0.5 * math.pi * (1.0 + rise)
    facing = COST_PER_S * weights.heading * turn / model.turning
    if model.strafes and not any_yaw:
        direct = COST_PER_S * _turn_between(yaw, scene.goal_yaw) / model.turning
        after = _turn_between(math.atan2(dy, dx), scene.goal_yaw)
        aside = _strafing_cost(model, turn, min(here, NEXT_WAY_M))
        aside += _strafing_cost(model, after, min(here - NEXT_WAY_M, MAX_FAR_WAY_M))
        return cost + min(max(facing + last_turn, direct), direct + aside)
    return cost + last_turn + facing


@lean_kernel
def _strafing_cost(model: MotionModel, turn: float, way: float) -> float:
    """Return the extra cost of driving `way` [m] at an angle of `turn` [rad] to the heading."""
    ahead, aside = math.cos(turn), abs(math.sin(turn))
    along = model.forward if ahead >= 0.0 else model.backward
    slowness = math.hypot(ahead / max(along, SLOW_SPEED), aside / max(model.lateral, SLOW_SPEED))
    return COST_PER_S * max(0.0, way) * max(0.0, slowness - 1.0 / model.forward)


@lean_kernel
def _turn_between(first: float, second: float) -> float:
    """Return the angle between two directions [rad], 0 to pi."""
    turn = first - second
    return abs(turn - math.tau * math.floor(turn / math.tau + 0.5))


@lean_kernel
def disc_contact_cost(weights: Weights, seconds: float, share: float) -> float:
    """Return the cost of a contact with a disc after `seconds` and `share` of the plan."""
    if weights.trust > 0.0:
        return DISC_CONTACT_COST * math.exp(-seconds / weights.trust)
    return DISC_CONTACT_COST * (1.0 - 0.6 * share)


@lean_kernel
def fill_disc_distances(
    weights: Weights, discs: Floats, outline: Outline, seconds: float, state: Floats
) -> None:
    """Fill in the distances of the bodies in `state` to `discs` (m, 6) after `seconds`.

    DISC_DISTANCE becomes the distance of each body's box to the nearest disc [m]. DISC_COST becomes
    the cost of a second near all discs if predictions fade, otherwise 0.
    """
    for lane in range(LANES):
        state[DISC_DISTANCE + lane], state[DISC_COST + lane] = NO_DISC_M, 0.0
    fades = weights.trust > 0.0
    for disc in discs:
        vx, vy = disc[2], disc[3]
        x, y = disc[0] + vx * seconds, disc[1] + vy * seconds
        radius = disc[4] + disc[5] * (min(seconds, DISC_GROWTH_S) if fades else seconds)
        over = weights.disc_over + weights.disc_lead * math.sqrt(vx * vx + vy * vy)
        room = DISC_DECAYS * over if fades else MAX_DISC_DISTANCE_M
        if _any_near(state, x, y, outline.far + radius + room):
            _add_disc(outline, (x, y, radius), room, 1.0 / over if fades else 0.0, state)
    if fades:
        for lane in range(LANES):
            state[DISC_COST + lane] *= weights.disc


@lean_kernel
def _any_near(state: Floats, x: float, y: float, reach: float) -> bool:
    near = False
    for lane in range(LANES):
        dx, dy = x - state[X + lane], y - state[Y + lane]
        near |= dx * dx + dy * dy < reach * reach
    return near


@lean_kernel
def _add_disc(
    outline: Outline, disc: tuple[float, float, float], room: float, decay: float, state: Floats
) -> None:
    """Add a `disc` (x, y, radius) [m] to the distances and costs of bodies within `room` [m]."""
    x, y, radius = disc
    reach = outline.far + radius + room
    for lane in range(LANES):
        dx, dy = x - state[X + lane], y - state[Y + lane]
        cosine, sine = state[COSINE + lane], state[SINE + lane]
        ahead, aside = cosine * dx + sine * dy, cosine * dy - sine * dx
        out_x = max(outline.rear - ahead, 0.0, ahead - outline.front)
        out_y = max(outline.right - aside, 0.0, aside - outline.left)
        away = math.sqrt(out_x * out_x + out_y * out_y) - radius
        near = dx * dx + dy * dy < reach * reach
        cost = exponential(-decay * max(0.0, away)) if near and decay > 0.0 else 0.0
        state[DISC_DISTANCE + lane] = min(state[DISC_DISTANCE + lane], away if near else NO_DISC_M)
        state[DISC_COST + lane] += cost


@lean_kernel
def evaluate_surroundings(problem: Problem, states: Floats) -> None:
    """Fill in the surroundings of the bodies in `states` (T + 1, STATE).

    MIDDLE_DISTANCE becomes the distance of the body's middle to an obstacle [m], and MIN_COST a
    lower bound of a second's cost without discs. `fill_disc_distances` fills the others.
    """
    _, outline, weights, scene, dt = problem
    grid, per_cell = scene.grid, 1.0 / scene.grid.cell
    for t in range(states.shape[0]):
        state = states[t]
        for lane in range(LANES):  # column and row of the middle
            x, y = state[X + lane] - grid.x, state[Y + lane] - grid.y
            cosine, sine = state[COSINE + lane], state[SINE + lane]
            x += cosine * outline.center_x - sine * outline.center_y
            y += sine * outline.center_x + cosine * outline.center_y
            state[MIDDLE_DISTANCE + lane], state[MIN_COST + lane] = (
                x * per_cell - 0.5,
                y * per_cell - 0.5,
            )
        for lane in range(LANES):
            column, row = state[MIDDLE_DISTANCE + lane], state[MIN_COST + lane]
            state[MIDDLE_DISTANCE + lane] = interpolate(grid.distance, column, row)
        for lane in range(LANES):
            room = state[MIDDLE_DISTANCE + lane] - outline.inner  # upper bound
            room = room if room < AMPLE_ROOM_M else MAX_CLEARANCE_M
            near = weights.near * exponential((weights.margin - room) / weights.near_over)
            motion = motion_cost(weights, room, state[VX + lane], state[VY + lane], state[W + lane])
            time = time_cost(scene, state[X + lane], state[Y + lane], state[YAW + lane])
            state[MIN_COST + lane] = time + motion + (near if room < AMPLE_ROOM_M else 0.0)
        fill_disc_distances(weights, scene.discs, outline, t * dt, state)


@lean_kernel
def fill_clearances(scene: Scene, outline: Outline, states: Floats, rooms: Floats) -> None:
    """Fill `rooms` (n,) with the clearances [m] of the first `states`, equal in all lanes."""
    for t in range(len(rooms)):
        state = states[t]
        clearance = clearance_of(
            scene.grid, outline, motion_of(state, int(NONE)).at, state[MIDDLE_DISTANCE], int(NONE)
        )
        rooms[t] = clearance[0]


@lean_kernel
def plan_cost(problem: Problem, rooms: Floats, states: Floats, lane: int, limit: float) -> float:
    """Return the cost of a lane's `states`; inf once it is known to reach `limit`.

    `rooms` are the result of `fill_clearances`.
    """
    model, outline, weights, scene, dt = problem
    min_room = min(weights.margin, rooms[0] - START_TOLERANCE_M)
    min_disc_distance = min(
        weights.disc_margin, states[0, DISC_DISTANCE + lane] - START_TOLERANCE_M
    )
    end = terminal_cost(problem, motion_of(states[-1], lane))
    bound_to_come = -math.inf
    if limit < math.inf:
        with_contact, without_contact = _lower_bounds(
            problem, states, lane, (min_room, min_disc_distance)
        )
        bound_to_come = without_contact + end if with_contact >= limit else -math.inf
        if min(with_contact, without_contact + end) >= limit:
            return math.inf
    cost: float = 0.0
    room, slack, group, checked = MAX_CLEARANCE_M, 0.0, int(NONE), False
    steps = states.shape[0] - 1
    for t in range(1, steps + 1):
        if cost + bound_to_come >= limit:
            return math.inf
        state = states[t]
        motion = motion_of(state, lane)
        x, y, vx, vy = motion.at.x, motion.at.y, motion.vx, motion.vy
        slack -= state[MOVED + lane]
        checked = slack < 0.0 and not (checked and room - state[MOVED + lane] > min_room)
        if checked:
            if t < len(rooms):
                room = rooms[t]
            else:
                room, group = clearance_of(
                    scene.grid, outline, motion.at, state[MIDDLE_DISTANCE + lane], group
                )
            slack = room - AMPLE_ROOM_M
        away = state[DISC_DISTANCE + lane]
        if room < min_room:
            cost += contact_cost(t / steps) + remaining_cost(model, scene, x, y, motion.yaw)
            return cost + IMPACT_COST * math.hypot(vx, vy)
        if away < min_disc_distance:
            to_go = remaining_cost(model, scene, x, y, motion.yaw)
            return cost + disc_contact_cost(weights, t * dt, t / steps) + to_go
        cost += dt * state[DISC_COST + lane]
        cost += dt * place_cost(weights, scene, room, away, motion)
        cost += dt * motion_cost(weights, room, vx, vy, motion.w)
        bound_to_come -= dt * (state[MIN_COST + lane] + state[DISC_COST + lane])
        if t % BRAKING_CHECK_STEPS == 1:
            cost += dt * BRAKING_CHECK_STEPS * braking_cost(problem, room, motion)
    return cost + end


@lean_kernel
def contact_cost(share: float) -> float:
    """Return the cost of a contact after `share` of the plan."""
    return CONTACT_COST * (1.0 - 0.7 * share)


@lean_kernel
def _lower_bounds(
    problem: Problem, states: Floats, lane: int, least: tuple[float, float]
) -> tuple[float, float]:
    """Return lower bounds of a lane's cost with a contact, and of its steps without one.

    A bound is inf for an impossible case. A contact is possible where the body's middle is near an
    obstacle, and certain where it is well inside one. Steps after that do not count.
    """
    model, outline, weights, scene, dt = problem
    possible = least[0] + MAX_SLOPE * outline.outer + NEAREST_CELL_ERROR * scene.grid.cell
    certain = outline.inner + min(0.0, least[0])
    steps = states.shape[0] - 1
    with_contact, spent = math.inf, 0.0
    for t in range(1, steps + 1):
        state = states[t]
        middle, hits_disc = state[MIDDLE_DISTANCE + lane], state[DISC_DISTANCE + lane] < least[1]
        if middle < possible or hits_disc:
            cost_at_contact = spent + remaining_cost(
                model, scene, state[X + lane], state[Y + lane], state[YAW + lane]
            )
            if middle < possible:
                with_contact = min(with_contact, cost_at_contact + contact_cost(t / steps))
            if hits_disc:
                with_contact = min(
                    with_contact, cost_at_contact + disc_contact_cost(weights, t * dt, t / steps)
                )
        if middle < certain or hits_disc:
            return with_contact, math.inf
        spent += dt * (state[MIN_COST + lane] + state[DISC_COST + lane])
    return with_contact, spent
