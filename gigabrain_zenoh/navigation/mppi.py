"""Model predictive path integral control: many plans, their costs, and the mean of the good ones.

Williams et al., "Information theoretic MPC for model-based reinforcement learning", ICRA 2017.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.kernels import kernel
from gigabrain_zenoh.navigation.footprint import Outline
from gigabrain_zenoh.navigation.models import Model
from gigabrain_zenoh.navigation.rating import Scene, Weights
from gigabrain_zenoh.navigation.rollout import STATE, Start, drive, first_rooms

Floats = NDArray[np.float64]

TEMPERATURE = 0.6  # how much worse than the best still counts
LEAST_SHARE = 1e-6  # in units of the best one's; what would have less has none
WORTHLESS = -TEMPERATURE * math.log(LEAST_SHARE) + 1e-3  # so much worse than the best has less
WORSE = 0.3  # a mean this much worse than the best has run into what its parts went round
SETS = 8  # of noise, drawn once and taken in turn
KEPT, FRESH = 0.85, 0.53  # of the noise from step to step
SPREAD, TURNING_SPREAD = 0.175, 0.3  # of the noise, as a share of the largest speeds
SIMPLE_EVERY = 4  # every so manieth plan is one twist and then another, and no noise
STANDING = 2  # the plan that brakes
SHARP = 0.3  # how much of the yaw rate simple plans take at high speed


class Planned(NamedTuple):
    """The plan that was chosen, and what it leads to."""

    commands: Floats  # (T, 3)
    track: Floats  # (T + 1, 6): x, y, yaw, vx, vy, w at the end of each step
    cost: float
    standing_cost: float  # of braking and staying


class Sampler:
    """Plans by sampling; the same seed and the same questions give the same plans."""

    def __init__(self, model: Model, samples: int, steps: int, dt: float, seed: int) -> None:
        self.dt, self._turn = dt, 0
        random = np.random.default_rng(seed)
        self._noise = _noise(random, (SETS, samples, steps, 3), model)
        self._simple = _simple(random, SETS, samples, steps, model)
        self._plans = np.empty((samples, steps, 3))
        self._states = np.empty((steps + 1, STATE))
        self._costs = np.empty(samples)
        self.last = np.zeros((steps, 3))

    def forget(self) -> None:
        """Begin anew, as if nothing had been planned."""
        self.last, self._turn = np.zeros_like(self.last), 0

    def shift(self, seconds: float) -> None:
        """Let time pass: the last plan begins so much later."""
        at = np.arange(len(self.last)) + seconds / self.dt
        whole = np.arange(len(self.last))
        self.last = np.stack([np.interp(at, whole, axis) for axis in self.last.T], axis=1)

    def step_by(self, dt: float) -> None:
        """Plan in as many steps of this length [s] from now on."""
        if dt != self.dt:
            at = (np.arange(len(self.last)) + 0.5) * dt / self.dt - 0.5
            whole = np.arange(len(self.last))
            self.last = np.stack([np.interp(at, whole, axis) for axis in self.last.T], axis=1)
            self.dt = dt

    def plan(
        self, model: Model, outline: Outline, weights: Weights, scene: Scene, start: Start
    ) -> Planned:
        """The best that was found for a body that can move like `model`."""
        dt, plans, costs = self.dt, self._plans, self._costs
        _propose(plans, self.last, self._noise[self._turn], self._simple[self._turn])
        self._turn = (self._turn + 1) % SETS
        states = self._states
        rooms = first_rooms(model, outline, scene, start, dt, states)
        _score(model, outline, weights, scene, start, dt, rooms, plans, states, costs)
        best = int(np.argmin(costs))
        share = np.exp((costs[best] - costs) / TEMPERATURE)
        share[share < LEAST_SHARE] = 0.0
        commands = np.tensordot(share, plans, axes=1) / share.sum()
        given = model, outline, weights, scene, start, dt, rooms
        cost = drive(*given, commands, states, math.inf)
        if cost > costs[best] + WORSE:
            commands = plans[best].copy()
            cost = drive(*given, commands, states, math.inf)
        self.last = commands
        return Planned(commands, states[:, :6].copy(), cost, float(costs[STANDING]))


def _noise(
    random: np.random.Generator, shape: tuple[int, ...], model: Model
) -> NDArray[np.float32]:
    """Autoregressive noise: neighbouring commands go together."""
    noise = random.standard_normal(shape, dtype=np.float32)
    for t in range(1, shape[2]):
        noise[:, :, t] = KEPT * noise[:, :, t - 1] + FRESH * noise[:, :, t]
    spread = (SPREAD * model.forward, SPREAD * model.lateral, TURNING_SPREAD * model.turning)
    scaled: NDArray[np.float32] = noise * np.array(spread, dtype=np.float32)
    return scaled


def _simple(
    random: np.random.Generator, sets: int, samples: int, steps: int, model: Model
) -> Floats:
    """Plans of two twists, (sets, samples, 7): both, and the step in which the second begins.

    Of every three, one keeps its first twist, and one turns on the spot before it drives on.
    """
    first, second = (_twists(random, (sets, samples, 3), model) for _ in range(2))
    turning = np.arange(samples) // SIMPLE_EVERY % 3
    if model.radius == 0.0:
        first[:, turning == 1, :2] = 0.0
        second[:, turning == 1, 0] = model.forward * random.random(
            (sets, int((turning == 1).sum()))
        )
        second[:, turning == 1, 2] = 0.0
    when = random.uniform(1.0, steps, (sets, samples, 1))
    when[:, turning == 0] = steps
    return np.concatenate([first, second, when], axis=2)


def _twists(random: np.random.Generator, shape: tuple[int, ...], model: Model) -> Floats:
    """Any twists that the body can have; the faster, the less they turn."""
    share = random.random(shape)
    twists = np.empty(shape)
    twists[..., 0] = -model.backward + (model.forward + model.backward) * share[..., 0]
    twists[..., 1] = model.lateral * (2.0 * share[..., 1] - 1.0)
    most = np.where(twists[..., 0] > 0.5 * model.forward, SHARP, 0.9)
    twists[..., 2] = model.turning * most * (2.0 * share[..., 2] - 1.0)
    return twists


@kernel
def _propose(plans: Floats, last: Floats, noise: NDArray[np.float32], simple: Floats) -> None:
    samples, steps, axes = plans.shape
    for k in range(samples):
        simply = k > 0 and k % SIMPLE_EVERY == 0
        for t in range(steps):
            second = 0 if t < simple[k, 6] else axes
            for a in range(axes):
                if simply:
                    plans[k, t, a] = simple[k, second + a]
                else:
                    plans[k, t, a] = last[t, a] + (noise[k, t, a] if k > 0 else 0.0)
    plans[STANDING] = 0.0


@kernel
def _score(
    model: Model,
    outline: Outline,
    weights: Weights,
    scene: Scene,
    start: Start,
    dt: float,
    rooms: Floats,
    plans: Floats,
    states: Floats,
    costs: Floats,
) -> None:
    """The `costs` of all plans, inf for those that are worthless beside one before them."""
    best = math.inf
    for k in range(plans.shape[0]):
        limit = math.inf if k == STANDING else best + WORTHLESS
        cost = drive(model, outline, weights, scene, start, dt, rooms, plans[k], states, limit)
        costs[k], best = cost, min(best, cost)


def step_of(model: Model) -> float:
    """How long one step of a plan is [s]: slow bodies look farther ahead."""
    return max(0.05, min(0.1, 0.1 / model.forward))


def past_of(
    sent: Floats, before: tuple[float, float, float], delay: float, dt: float
) -> tuple[Floats, float]:
    """What was sent in each of the last steps, and how much of the next the oldest still rules.

    `sent` (n, 4) are commands with their times [s], 0 for now and earlier ones below, oldest first;
    each holds until the next, and `before` held before them all.
    """
    whole = math.floor(delay / dt + 1e-9)
    past = np.empty((whole + 1, 3))
    for i in range(whole + 1):
        end = (i - whole) * dt
        past[i] = _mean(sent, before, end - dt, end)
    return past, delay / dt - whole


def _mean(
    sent: Floats, before: tuple[float, float, float], begin: float, end: float
) -> tuple[float, float, float]:
    times = np.concatenate(([-np.inf], sent[:, 0], [np.inf]))
    values = np.concatenate(([before], sent[:, 1:]))
    held = np.clip(times[1:], begin, end) - np.clip(times[:-1], begin, end)
    vx, vy, w = (held @ values / (end - begin)).tolist()
    return vx, vy, w
