"""Cost of a plan; one second of driving costs 8.

Looking at the whole outline in each pose takes most of the time. Bounds that need no outline come
first, for all lanes at once, and decide whether to look.
"""

import math

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.kernels.jit import NONE, lean_kernel
from gigabrain_zenoh.navigation.car_track import way_left
from gigabrain_zenoh.navigation.footprint import (
    MAX_CLEARANCE_M,
    STRETCH,
    UNSURE,
    DistanceGrid,
    Outline,
    between,
    clearance_of,
    distance_at,
    free_ahead,
    free_along,
)
from gigabrain_zenoh.navigation.motion_model import (
    AWAY,
    CLOSE,
    COSINE,
    LANES,
    MIDDLE,
    MOVED,
    SINE,
    SURE,
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

SECOND = 8.0  # what a second costs
LOOK_AHEAD = 0.25  # [m], from where the last pose's heading is judged
NEAR_GOAL = 0.2  # [m], nearer the field is too coarse
NEXT_WAY, FAR_WAY = 0.5, 3.0  # [m], of the way as it goes from here, and of the rest, straight on
SLOW = 0.05  # [m/s], slower than this it always stops in time
NO_DISC = 1e3  # [m], where nothing moves
DISC_ROOM = 1.5  # [m], what moves farther away makes no difference
TOO_FAST = 16.0  # per second at full speed where it cannot stop in time, by the square of the share

GROWS_S = 0.5  # how long what is known of a thing fades
TOUCHED_DISC = 200.0  # what a contact with a moving thing costs
DECAYS = 4.0  # times the way over which the cost of being near decays; farther off is nothing

TOUCHED = 300.0  # what a contact costs
IMPACT = 50.0  # per m/s of a contact
BRAKE_EVERY = 3  # steps
AT_EASE = 0.25  # [m], more room is checked again only once it may be used up
SPARE = 0.003  # [m], less room than at the start is a contact only from here on


@lean_kernel
def place_cost(
    weights: Weights, scene: Scene, room: float, away: float, motion: MotionState
) -> float:
    """Return the cost of a second here, `room` [m] from obstacles and `away` [m] from discs."""
    cost = 0.0
    if room < MAX_CLEARANCE_M:
        cost += weights.near * exponential((weights.margin - room) / weights.near_over)
    if away < NO_DISC and weights.trust == 0.0:
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
    """Return the cost of a second away from the goal, so that the last turn is not put off."""
    return 0.0 if _arrived(scene, x, y, yaw) else 0.5 * SECOND


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
    over = math.sqrt(vx * vx + vy * vy) - (
        weights.tight_speed + weights.tight_rate * (room - weights.margin)
    )
    if over > 0.0:
        cost += weights.tight * over * over
    if vx < 0.0:
        cost -= weights.backwards * vx
    return cost


@lean_kernel
def braking_cost(problem: Problem, room: float, motion: MotionState) -> float:
    """Return the cost of a second faster than the free way ahead allows; safety would intervene."""
    model, vx, vy = problem.model, motion.vx, motion.vy
    speed = math.sqrt(vx * vx + vy * vy)
    brake, t = model.deceleration, model.reaction_time
    needs = speed * t + speed * speed / (2.0 * brake) + model.margin
    if speed < SLOW or room >= needs:
        return 0.0
    sign = 1.0 if vx >= 0.0 else -1.0
    grid, side = problem.scene.grid, model.side_margin
    if model.strafes:
        free = free_along(grid, problem.outline, motion.at, (vx / speed, vy / speed), side, needs)
    else:
        free = free_ahead(grid, problem.outline, motion.at, sign, side, needs)
    allowed = math.sqrt((brake * t) ** 2 + 2.0 * brake * max(0.0, free - model.margin)) - brake * t
    over = max(0.0, speed - allowed) / model.forward
    return TOO_FAST * over * over


@lean_kernel
def rest(model: MotionModel, scene: Scene, x: float, y: float, yaw: float) -> float:
    """Return the cost of the way from a pose to the goal; the yaw counts for a car alone."""
    if len(scene.track) > 0:
        return SECOND * way_left(scene.track, model.radius, x, y, yaw) / model.forward
    away = math.hypot(x - scene.goal_x, y - scene.goal_y)
    way = away if away < NEAR_GOAL else cost_to_go_at(scene.field, x, y)
    return SECOND * way / model.forward


@lean_kernel
def cost_to_go_at(field: DistanceGrid, x: float, y: float) -> float:
    """Return the cost to go from (x, y) [m]; beyond the rim that of the rim."""
    rows, columns = field.distance.shape
    cell = field.cell
    inner_x = min(max(x, field.x + cell), field.x + (columns - 1) * cell)
    inner_y = min(max(y, field.y + cell), field.y + (rows - 1) * cell)
    return distance_at(field, inner_x, inner_y)


@lean_kernel
def terminal_cost(problem: Problem, motion: MotionState) -> float:
    """Return the cost to go after the last step: turn to the way, drive it, turn at its end.

    A body that has nearly arrived only has to stop, with the right yaw.
    """
    model, weights, scene = problem.model, problem.weights, problem.scene
    (x, y, cosine, sine), yaw, vx, vy = motion.at, motion.yaw, motion.vx, motion.vy
    cost = rest(model, scene, x, y, yaw)
    dx, dy = scene.goal_x - x, scene.goal_y - y
    near = math.hypot(dx, dy) < NEAR_GOAL
    if len(scene.track) > 0:
        return cost + (0.5 * SECOND * abs(vx) / model.forward if near else 0.0)
    last_turn, any_yaw = 0.0, math.isnan(scene.goal_yaw)
    if not any_yaw:
        arrives = yaw if near else math.atan2(dy, dx)
        last_turn = SECOND * _turn_between(arrives, scene.goal_yaw) / model.turning
    if near:
        return cost + last_turn + 0.5 * SECOND * math.hypot(vx, vy) / model.forward
    here = cost_to_go_at(scene.field, x, y)
    ahead = cost_to_go_at(scene.field, x + LOOK_AHEAD * cosine, y + LOOK_AHEAD * sine)
    rise = max(-1.0, min(1.0, (ahead - here) / LOOK_AHEAD))
    turn = 0.5 * math.pi * (1.0 + rise)
    facing = SECOND * weights.heading * turn / model.turning
    if model.strafes and not any_yaw:
        direct = SECOND * _turn_between(yaw, scene.goal_yaw) / model.turning
        after = _turn_between(math.atan2(dy, dx), scene.goal_yaw)
        aside = _strafing_cost(model, turn, min(here, NEXT_WAY))
        aside += _strafing_cost(model, after, min(here - NEXT_WAY, FAR_WAY))
        return cost + min(max(facing + last_turn, direct), direct + aside)
    return cost + last_turn + facing


@lean_kernel
def _strafing_cost(model: MotionModel, turn: float, way: float) -> float:
    """Return what it costs to go `way` [m] turned away from it by `turn` [rad]."""
    ahead, aside = math.cos(turn), abs(math.sin(turn))
    along = model.forward if ahead >= 0.0 else model.backward
    slowness = math.hypot(ahead / max(along, SLOW), aside / max(model.lateral, SLOW))
    return SECOND * max(0.0, way) * max(0.0, slowness - 1.0 / model.forward)


@lean_kernel
def _turn_between(one: float, other: float) -> float:
    """Return the angle between two directions [rad], 0 to pi."""
    turn = one - other
    return abs(turn - math.tau * math.floor(turn / math.tau + 0.5))


@lean_kernel
def disc_contact_cost(weights: Weights, seconds: float, share: float) -> float:
    """Return the cost of a contact with a disc after `seconds` and that `share` of the plan."""
    if weights.trust > 0.0:
        return TOUCHED_DISC * math.exp(-seconds / weights.trust)
    return TOUCHED_DISC * (1.0 - 0.6 * share)


@lean_kernel
def fill_disc_distances(
    weights: Weights, discs: Floats, outline: Outline, seconds: float, state: Floats
) -> None:
    """Fill in the distances of the bodies of a `state` to `discs` (m, 6) after `seconds`.

    AWAY becomes the distance from each body's box to the nearest [m]. CLOSE, where it counts,
    becomes the cost of a second that near to all of them.
    """
    for lane in range(LANES):
        state[AWAY + lane], state[CLOSE + lane] = NO_DISC, 0.0
    fades = weights.trust > 0.0
    for disc in discs:
        vx, vy = disc[2], disc[3]
        x, y = disc[0] + vx * seconds, disc[1] + vy * seconds
        radius = disc[4] + disc[5] * (min(seconds, GROWS_S) if fades else seconds)
        over = weights.disc_over + weights.disc_lead * math.sqrt(vx * vx + vy * vy)
        room = DECAYS * over if fades else DISC_ROOM
        if _any_near(state, x, y, outline.far + radius + room):
            _add_disc(outline, (x, y, radius), room, 1.0 / over if fades else 0.0, state)
    if fades:
        for lane in range(LANES):
            state[CLOSE + lane] *= weights.disc


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
    """Add a `disc` (x, y, radius) [m] to AWAY and CLOSE of the bodies within `room` [m] of it."""
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
        state[AWAY + lane] = min(state[AWAY + lane], away if near else NO_DISC)
        state[CLOSE + lane] += cost


@lean_kernel
def evaluate_surroundings(problem: Problem, states: Floats) -> None:
    """Fill in the surroundings of the bodies in `states` (T + 1, STATE), and their least cost.

    MIDDLE becomes the distance of the body's middle to an obstacle [m], SURE the cost of a second
    there without discs, AWAY and CLOSE the results of `fill_disc_distances`.
    """
    _, outline, weights, scene, dt = problem
    grid, per_cell = scene.grid, 1.0 / scene.grid.cell
    for t in range(states.shape[0]):
        state = states[t]
        for lane in range(LANES):  # where the middle is, in cells
            x, y = state[X + lane] - grid.x, state[Y + lane] - grid.y
            cosine, sine = state[COSINE + lane], state[SINE + lane]
            x += cosine * outline.center_x - sine * outline.center_y
            y += sine * outline.center_x + cosine * outline.center_y
            state[MIDDLE + lane], state[SURE + lane] = x * per_cell - 0.5, y * per_cell - 0.5
        for lane in range(LANES):
            column, row = state[MIDDLE + lane], state[SURE + lane]
            state[MIDDLE + lane] = between(grid.distance, column, row)
        for lane in range(LANES):
            room = state[MIDDLE + lane] - outline.inner  # it is no more than that
            room = room if room < AT_EASE else MAX_CLEARANCE_M
            near = weights.near * exponential((weights.margin - room) / weights.near_over)
            motion = motion_cost(weights, room, state[VX + lane], state[VY + lane], state[W + lane])
            time = time_cost(scene, state[X + lane], state[Y + lane], state[YAW + lane])
            state[SURE + lane] = time + motion + (near if room < AT_EASE else 0.0)
        fill_disc_distances(weights, scene.discs, outline, t * dt, state)


@lean_kernel
def fill_clearances(scene: Scene, outline: Outline, states: Floats, rooms: Floats) -> None:
    """Fill `rooms` (n,) with the clearances [m] in the first `states`, which all lanes share."""
    for t in range(len(rooms)):
        one = states[t]
        found = clearance_of(
            scene.grid, outline, motion_of(one, int(NONE)).at, one[MIDDLE], int(NONE)
        )
        rooms[t] = found[0]


@lean_kernel
def price(problem: Problem, rooms: Floats, states: Floats, lane: int, limit: float) -> float:
    """Return the cost of a lane's `states`, or inf as soon as it must reach `limit`.

    `rooms` are the result of `fill_clearances`.
    """
    model, outline, weights, scene, dt = problem
    least = min(weights.margin, rooms[0] - SPARE)
    least_disc = min(weights.disc_margin, states[0, AWAY + lane] - SPARE)
    end = terminal_cost(problem, motion_of(states[-1], lane))
    to_come = -math.inf
    if limit < math.inf:
        touching, passing = _lower_bounds(problem, states, lane, (least, least_disc))
        to_come = passing + end if touching >= limit else -math.inf
        if min(touching, passing + end) >= limit:
            return math.inf
    cost: float = 0.0
    room, slack, touches, looked = MAX_CLEARANCE_M, 0.0, int(NONE), False
    steps = states.shape[0] - 1
    for t in range(1, steps + 1):
        if cost + to_come >= limit:
            return math.inf
        one = states[t]
        motion = motion_of(one, lane)
        x, y, vx, vy = motion.at.x, motion.at.y, motion.vx, motion.vy
        slack -= one[MOVED + lane]
        looked = slack < 0.0 and not (looked and room - one[MOVED + lane] > least)
        if looked:
            if t < len(rooms):
                room = rooms[t]
            else:
                room, touches = clearance_of(
                    scene.grid, outline, motion.at, one[MIDDLE + lane], touches
                )
            slack = room - AT_EASE
        away = one[AWAY + lane]
        if room < least:
            cost += contact_cost(t / steps) + rest(model, scene, x, y, motion.yaw)
            return cost + IMPACT * math.hypot(vx, vy)
        if away < least_disc:
            left = rest(model, scene, x, y, motion.yaw)
            return cost + disc_contact_cost(weights, t * dt, t / steps) + left
        cost += dt * one[CLOSE + lane]
        cost += dt * place_cost(weights, scene, room, away, motion)
        cost += dt * motion_cost(weights, room, vx, vy, motion.w)
        to_come -= dt * (one[SURE + lane] + one[CLOSE + lane])
        if t % BRAKE_EVERY == 1:
            cost += dt * BRAKE_EVERY * braking_cost(problem, room, motion)
    return cost + end


@lean_kernel
def contact_cost(share: float) -> float:
    """Return the cost of a contact after that share of the plan."""
    return TOUCHED * (1.0 - 0.7 * share)


@lean_kernel
def _lower_bounds(
    problem: Problem, states: Floats, lane: int, least: tuple[float, float]
) -> tuple[float, float]:
    """Return lower bounds of a lane's cost with a contact, and without one nor its end.

    They are inf where that is impossible. A contact may come where the middle of the body is near
    an obstacle, and must have come where it is well inside one: the plan beyond does not count.
    """
    model, outline, weights, scene, dt = problem
    may = least[0] + STRETCH * outline.outer + UNSURE * scene.grid.cell
    must = outline.inner + min(0.0, least[0])
    steps = states.shape[0] - 1
    touching, spent = math.inf, 0.0
    for t in range(1, steps + 1):
        one = states[t]
        middle, struck = one[MIDDLE + lane], one[AWAY + lane] < least[1]
        if middle < may or struck:
            left = spent + rest(model, scene, one[X + lane], one[Y + lane], one[YAW + lane])
            if middle < may:
                touching = min(touching, left + contact_cost(t / steps))
            if struck:
                touching = min(touching, left + disc_contact_cost(weights, t * dt, t / steps))
        if middle < must or struck:
            return touching, math.inf
        spent += dt * (one[SURE + lane] + one[CLOSE + lane])
    return touching, spent
