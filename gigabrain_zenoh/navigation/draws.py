"""Which plans are tried: the last one, disturbed, and simple ones; and one that brakes."""

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.kernels.kernel import lean_kernel
from gigabrain_zenoh.navigation.models import Model
from gigabrain_zenoh.navigation.rollout import LANES

Floats = NDArray[np.float64]

KEPT, FRESH = 0.85, 0.53  # of the noise from step to step
SPREAD, TURNING_SPREAD = 0.175, 0.3  # of the noise, as a share of the largest speeds
SIMPLE_EVERY = 4  # every so manieth plan is one twist and then another, and no noise
STANDING = 2  # the plan that brakes
SHARP = 0.3  # how much of the yaw rate simple plans take at high speed


def noise_of(
    random: np.random.Generator, shape: tuple[int, ...], model: Model
) -> NDArray[np.float32]:
    """Autoregressive noise: neighbouring commands go together."""
    noise = random.standard_normal(shape, dtype=np.float32)
    for t in range(1, shape[2]):
        noise[:, :, t] = KEPT * noise[:, :, t - 1] + FRESH * noise[:, :, t]
    spread = (SPREAD * model.forward, SPREAD * model.lateral, TURNING_SPREAD * model.turning)
    scaled: NDArray[np.float32] = noise * np.array(spread, dtype=np.float32)
    return scaled


def simple_of(
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


@lean_kernel
def propose(plans: Floats, last: Floats, noise: NDArray[np.float32], simple: Floats) -> None:
    """Fill `plans` (blocks, T, 3, LANES)."""
    blocks, steps, axes, _ = plans.shape
    for block in range(blocks):
        for t in range(steps):
            for axis in range(axes):
                plan, disturbed = plans[block, t, axis], noise[block, t, axis]
                for lane in range(LANES):
                    plan[lane] = last[t, axis] + disturbed[lane]
                for lane in range(0, LANES, SIMPLE_EVERY):
                    one = simple[block * LANES + lane]
                    plan[lane] = one[axis] if t < one[6] else one[axes + axis]
    for t in range(steps):
        for axis in range(axes):
            plans[0, t, axis, 0], plans[0, t, axis, STANDING] = last[t, axis], 0.0
