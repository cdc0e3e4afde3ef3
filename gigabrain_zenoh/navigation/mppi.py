"""Model predictive path integral control: samples plans, and averages them by their cost.

Williams et al., Information theoretic MPC for model-based reinforcement learning, ICRA 2017.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.kernels.jit import NONE, kernel, lean_kernel
from gigabrain_zenoh.navigation.cost import (
    cost_to_go_at,
    evaluate_surroundings,
    fill_clearances,
    plan_cost,
)
from gigabrain_zenoh.navigation.footprint import Outline
from gigabrain_zenoh.navigation.motion_model import (
    LANES,
    STATE,
    InitialState,
    MotionModel,
    make_feasible,
    simulate,
)
from gigabrain_zenoh.navigation.plan_bounds import bounds_of, may_cost_less
from gigabrain_zenoh.navigation.planning_problem import Problem, Scene, Weights, motion_of

NOISE_KEPT, NOISE_FRESH = 0.85, 0.53  # autoregression of the noise from step to step
NOISE_SHARE, TURN_NOISE_SHARE = 0.175, 0.3  # of the maximum speeds, standard deviation of noise
SIMPLE_EVERY = 4  # every 4th plan is two constant twists without noise
BRAKING_LANE = 2  # of the first block: a plan that brakes
SHARP_TURN_SHARE = 0.3  # of the maximum yaw rate, in simple plans at high speed

TEMPERATURE = 0.6  # cost difference at which a plan's weight falls to 1/e
MIN_WEIGHT = 1e-3  # the best plan's is 1; smaller ones, below 1 % in total, are neglected
WORTHLESS_MARGIN = -TEMPERATURE * math.log(MIN_WEIGHT)  # cost above the best for MIN_WEIGHT
MEAN_MARGIN = 0.3  # a mean that costs this much more than the best plan is not used
NOISE_SETS = 8  # drawn once and used in turn


def correlated_noise(
    random: np.random.Generator, shape: tuple[int, ...], model: MotionModel
) -> NDArray[np.float32]:
    """Return noise of `shape` (sets, samples, T, 3) that is correlated from step to step."""
    noise = random.standard_normal(shape, dtype=np.float32)
    for t in range(1, shape[2]):
        noise[:, :, t] = NOISE_KEPT * noise[:, :, t - 1] + NOISE_FRESH * noise[:, :, t]
    linear, turn = NOISE_SHARE, TURN_NOISE_SHARE
    lateral = TURN_NOISE_SHARE if model.strafes else linear
    spread = linear * model.forward, lateral * model.lateral, turn * model.turning
    scaled: NDArray[np.float32] = noise * np.array(spread, dtype=np.float32)
    return scaled


def two_twist_plans(
    random: np.random.Generator, sets: int, samples: int, steps: int, model: MotionModel
) -> Floats:
    """Return plans (sets, samples, 7) of two twists and the step at which the second begins.

    One in three keeps its first twist, and one turns on the spot before it drives. For strafing
    bodies, the third does not turn.
    """
    first, second = (_twists(random, (sets, samples, 3), model) for _ in range(2))
    turning = np.arange(samples) // SIMPLE_EVERY % 3
    if model.radius == 0.0:
        first[:, turning == 1, :2] = 0.0
        count = int((turning == 1).sum())
        second[:, turning == 1, 0] = model.forward * random.random((sets, count))
        second[:, turning == 1, 2] = 0.0
    if model.strafes:
        first[:, turning == 2, 2] = second[:, turning == 2, 2] = 0.0
    when = random.uniform(1.0, steps, (sets, samples, 1))
    when[:, turning == 0] = steps
    return np.concatenate([first, second, when], axis=2)


def _twists(random: np.random.Generator, shape: tuple[int, ...], model: MotionModel) -> Floats:
    """Return random twists within the body's limits; fast ones turn less."""
    share = random.random(shape)
    twists = np.empty(shape)
    twists[..., 0] = -model.backward + (model.forward + model.backward) * share[..., 0]
    twists[..., 1] = model.lateral * (2.0 * share[..., 1] - 1.0)
    turn_share = np.where(twists[..., 0] > 0.5 * model.forward, SHARP_TURN_SHARE, 0.9)
    twists[..., 2] = model.turning * turn_share * (2.0 * share[..., 2] - 1.0)
    return twists


@lean_kernel
def fill_plans(
    plans: Floats, last: Floats, noise: NDArray[np.float32], simple: Floats, first: bool
) -> None:
    """Fill a block of `plans` (T, 3, LANES); the `first` holds the last plan and a braking one."""
    for t in range(plans.shape[0]):
        for axis in range(3):
            plan, disturbed = plans[t, axis], noise[t, axis]
            for lane in range(LANES):
                plan[lane] = last[t, axis] + disturbed[lane]
            for lane in range(0, LANES, SIMPLE_EVERY):
                twists = simple[lane]
                plan[lane] = twists[axis] if t < twists[6] else twists[3 + axis]
            if first:
                plan[0], plan[BRAKING_LANE] = last[t, axis], 0.0


class SampledPlan(NamedTuple):
    """The chosen plan, and its result."""

    commands: Floats  # (T, 3)
    track: Floats  # (T + 1, 6): x, y, yaw, vx, vy, w at the end of each step
    room: float  # [m], clearance at the start, see `clearance_of`
    left: float  # [m of free way], cost to go from the start


class Samples(NamedTuple):
    """Sources of the sampled plans."""

    last: Floats  # (T, 3), the last plan
    noise: NDArray[np.float32]  # (blocks, T, 3, LANES), added to the last plan
    simple: Floats  # (samples, 7), see `two_twist_plans`


class SamplerBuffers(NamedTuple):
    """Reused arrays, with plans in lanes."""

    plans: Floats  # (blocks + 1, T, 3, LANES): kept plans; the last block is a draft
    states: Floats  # (T + 1, STATE), of one block
    costs: Floats  # (blocks, LANES), of the kept plans
    origins: NDArray[np.int64]  # (samples,), lanes of the draft that the kept plans come from


class Sampler:
    """Plans by sampling; the same seed and the same requests give the same plans.

    `samples` is rounded up to fill all lanes.
    """

    def __init__(self, model: MotionModel, samples: int, steps: int, dt: float, seed: int) -> None:
        self.dt, self._noise_set = dt, 0
        random = np.random.default_rng(seed)
        blocks = math.ceil(samples / LANES)
        noise = correlated_noise(random, (NOISE_SETS, blocks * LANES, steps, 3), model)
        lanes = noise.reshape(NOISE_SETS, blocks, LANES, steps, 3).transpose(0, 1, 3, 4, 2)
        self._noise = np.ascontiguousarray(lanes)
        self._simple = two_twist_plans(random, NOISE_SETS, blocks * LANES, steps, model)
        self._buffers = SamplerBuffers(
            np.zeros((blocks + 1, steps, 3, LANES)),
            np.empty((steps + 1, STATE)),
            np.empty((blocks, LANES)),
            np.empty(blocks * LANES, dtype=np.int64),
        )
        self.last = np.zeros((steps, 3))

    def forget(self) -> None:
        """Discard the last plan."""
        self.last, self._noise_set = np.zeros_like(self.last), 0

    def shift(self, seconds: float) -> None:
        """Remove the first `seconds` of the last plan, which are over."""
        self.last = _resampled(self.last, seconds / self.dt, 1.0)

    def step_by(self, dt: float) -> None:
        """Change the duration of the steps to `dt` [s], but not their number."""
        if dt != self.dt:
            step = dt / self.dt
            self.last, self.dt = _resampled(self.last, 0.5 * step - 0.5, step), dt

    def plan(
        self,
        model: MotionModel,
        outline: Outline,
        weights: Weights,
        scene: Scene,
        start: InitialState,
    ) -> SampledPlan:
        """Return the best plan found for a body that moves like `model`."""
        noise, simple = self._noise[self._noise_set], self._simple[self._noise_set]
        self._noise_set = (self._noise_set + 1) % NOISE_SETS
        problem = Problem(model, outline, weights, scene, self.dt)
        samples = Samples(self.last, noise, simple)
        found = SampledPlan(*_search(problem, start, samples, self._buffers))
        self.last = found.commands
        return found


@kernel
def _resampled(plan: Floats, begin: float, step: float) -> Floats:
    """Interpolate `plan` (T, 3) from `begin` by `step`; it is constant beyond its ends."""
    found = np.empty_like(plan)
    for n in range(len(plan)):
        inside = min(max(begin + n * step, 0.0), len(plan) - 1.0)
        before = min(int(inside), len(plan) - 2)
        for axis in range(plan.shape[1]):
            first, second = plan[before, axis], plan[before + 1, axis]
            found[n, axis] = first + (inside - before) * (second - first)
    return found


@kernel
def _search(
    problem: Problem, start: InitialState, samples: Samples, buffers: SamplerBuffers
) -> tuple[Floats, Floats, float, float]:
    """Return the fields of a SampledPlan.

    Plans whose last pose shows that they are worthless are dropped. The others are collected, and
    their costs are computed when they fill a block. In the end, the draft holds the weighted mean
    of all plans, and the best plan.
    """
    (plans, states, costs, origins), (last, noise, simple) = buffers, samples
    draft, blocks, mean, best = plans[-1], len(costs), 0, 1
    rooms, found = np.empty(min(len(states), len(start.past))), np.empty(LANES)
    bounds, least, kept, evaluated = bounds_of(problem, start, len(last)), math.inf, 0, 0
    for block in range(blocks):
        fill_plans(draft, last, noise[block], simple[block * LANES :], block == 0)
        make_feasible(problem.model, start, problem.dt, draft)
        simulate(problem.model, problem.outline.far, start, problem.dt, draft, states)
        limit = least + WORTHLESS_MARGIN
        for lane in range(LANES):
            if may_cost_less(problem, bounds, motion_of(states[-1], lane), limit):
                _copy_lane(draft, lane, plans[kept // LANES], kept % LANES)
                origins[kept], kept = lane, kept + 1
        while kept - evaluated >= (LANES if block < blocks - 1 else 1):
            now = costs[evaluated // LANES, : kept - evaluated]
            _evaluate(problem, start, plans[evaluated // LANES], limit, states, rooms, now)
            least, evaluated = min(least, now.min()), evaluated + LANES
    _combine(plans, costs, origins[:kept], mean, best)
    make_feasible(problem.model, start, problem.dt, draft)
    _evaluate(problem, start, draft, math.inf, states, rooms, found[:2])
    chosen = best if found[mean] > found[best] + MEAN_MARGIN else mean
    commands, track = _lane_result(draft, states, chosen)
    left = cost_to_go_at(problem.scene.field, start.x, start.y)
    return commands, track, rooms[0], left


@kernel
def _evaluate(
    problem: Problem, start: InitialState, plans: Floats, limit: float,
    states: Floats, rooms: Floats, costs: Floats,
) -> None:  # fmt: skip
    """Fill `states`, and `costs` (n,) of the first lanes of feasible `plans` (T, 3, LANES).

    A cost may be inf if it reaches `limit`, or is worthless compared with an earlier lane. With a
    limit of inf, all costs are exact, and `rooms` are filled as well.
    """
    simulate(problem.model, problem.outline.far, start, problem.dt, plans, states)
    evaluate_surroundings(problem, states)
    if limit == math.inf:
        fill_clearances(problem.scene, problem.outline, states, rooms)
    for lane in range(len(costs)):
        costs[lane] = plan_cost(problem, rooms, states, lane, limit)
        if limit < math.inf:
            limit = min(limit, costs[lane] + WORTHLESS_MARGIN)


@kernel
def _lane_result(plans: Floats, states: Floats, lane: int) -> tuple[Floats, Floats]:
    """Return the commands (T, 3) and the track (T + 1, 6) of one lane."""
    steps, axes, _ = plans.shape
    commands, track = np.empty((steps, axes)), np.empty((steps + 1, 2 * axes))
    for t in range(steps):
        for axis in range(axes):
            commands[t, axis] = plans[t, axis, lane]
    for t in range(steps + 1):
        for axis in range(2 * axes):
            track[t, axis] = states[t, axis * LANES + lane]
    return commands, track


@lean_kernel
def _copy_lane(plans: Floats, lane: int, to: Floats, to_lane: int) -> None:
    for t in range(plans.shape[0]):
        for axis in range(plans.shape[1]):
            to[t, axis, to_lane] = plans[t, axis, lane]


@lean_kernel
def _combine(
    plans: Floats, costs: Floats, origins: NDArray[np.int64], mean: int, best: int
) -> None:
    """Put the weighted mean of the `plans`, and the best plan, into lanes of the last block.

    Sums are formed by the lanes that the plans come from, `origins` (n,).
    """
    combined, best_plan, total = plans[-1], int(NONE), 0.0
    for n in range(len(origins)):
        if costs[n // LANES, n % LANES] < costs[best_plan // LANES, best_plan % LANES]:
            best_plan = n
    least_cost = costs[best_plan // LANES, best_plan % LANES]
    combined[:] = 0.0
    for n in range(len(origins)):
        excess = costs[n // LANES, n % LANES] - least_cost
        if excess < WORTHLESS_MARGIN:
            weight = math.exp(-excess / TEMPERATURE)
            total += weight
            for t in range(plans.shape[1]):
                for axis in range(plans.shape[2]):
                    command = plans[n // LANES, t, axis, n % LANES]
                    combined[t, axis, origins[n]] += weight * command
    for t in range(plans.shape[1]):
        for axis in range(plans.shape[2]):
            sums, amount = combined[t, axis], 0.0
            for lane in range(LANES):
                amount += sums[lane]
            sums[mean] = amount / total
            sums[best] = plans[best_plan // LANES, t, axis, best_plan % LANES]


def step_duration(model: MotionModel) -> float:
    """Return the duration of a plan's step [s]; slow bodies look farther ahead."""
    return max(0.05, min(0.1, 0.1 / model.forward))


def mean_past_commands(
    sent: Floats, before: tuple[float, float, float], delay: float, dt: float
) -> tuple[Floats, float]:
    """Return the mean command of each past step, and the oldest's share of the next step.

    `sent` (n, 4) are times [s] relative to now, and commands, oldest first. Each command holds
    until the next; `before` precedes all of them.
    """
    whole = math.floor(delay / dt + 1e-9)
    ends = np.arange(-whole, 1) * dt
    times = np.concatenate(([-np.inf], sent[:, 0], [np.inf]))
    cut = np.minimum(np.maximum(times, (ends - dt)[:, None]), ends[:, None])
    past = np.diff(cut, axis=1) @ np.concatenate(([before], sent[:, 1:])) / dt
    return past, delay / dt - whole
