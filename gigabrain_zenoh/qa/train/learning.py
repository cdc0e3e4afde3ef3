"""Training: losses, the optimiser's step, and the loop over pictures."""

import logging
import pickle
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from gigabrain_zenoh.qa.train import net
from gigabrain_zenoh.qa.train.pictures import Labelled
from gigabrain_zenoh.qa.train.targets import augment, targets
from gigabrain_zenoh.vision.labels import CLASSES
from gigabrain_zenoh.vision.recognizer import (
    HEIGHT_PX,
    RAW_LIMITS,
    STRIDE_PX,
    UNIT_PX,
    WIDTH_PX,
)


class Stage(NamedTuple):
    """A part of training: it ends after this share of steps."""

    end: float
    width: int  # of pictures [px], a multiple of 16
    height: int  # a multiple of 16
    batch: int


# Small pictures cost less: first learn what things look like.
STAGES = (
    Stage(0.4, 192, 144, 24),
    Stage(0.75, 256, 192, 16),
    Stage(1.0, WIDTH_PX, HEIGHT_PX, 16),
)
PEAK_RATE, WEIGHT_DECAY, WARM_UP_STEPS = 2.5e-3, 2e-2, 200
BOX_WEIGHT = 4.0
AVERAGED = 0.998  # of the weights that are exported, a step
SAVE_EVERY_STEPS = 100
log = logging.getLogger(__name__)


class State(NamedTuple):
    """All that a step changes."""

    params: net.Params
    moments: net.Params
    averaged: net.Params
    optimiser: Any


Batch = tuple[Any, ...]


def heat_loss(logits: Any, heat: Any, mask: Any) -> Any:
    """Penalty-reduced focal loss of CenterNet, for one thing in the mean."""
    p, peak = jax.nn.sigmoid(logits), heat > 0.999
    surprise = jax.nn.softplus(-logits)  # -log p; with the logit it is -log(1 - p)
    right = jnp.where(peak, (1 - p) ** 2 * surprise, 0.0)
    wrong = jnp.where(peak, 0.0, (1 - heat) ** 4 * p**2 * (surprise + logits))
    return ((right + wrong) * mask).sum() / jnp.maximum(peak.sum(), 1)


def corners(raw: Any) -> Any:
    """Return boxes (n, h, w, 4) [px] from raw distances to left, top, right, bottom."""
    d = UNIT_PX * jnp.exp(jnp.clip(raw, *RAW_LIMITS))
    x = (jnp.arange(raw.shape[2]) + 0.5) * STRIDE_PX
    y = (jnp.arange(raw.shape[1]) + 0.5)[:, None] * STRIDE_PX
    return jnp.stack([x - d[..., 0], y - d[..., 1], x + d[..., 2], y + d[..., 3]], -1)


def box_loss(found: Any, wanted: Any, weights: Any) -> Any:
    """Generalised IoU loss, weighted."""
    low, high = (
        jnp.maximum(found[..., :2], wanted[..., :2]),
        jnp.minimum(found[..., 2:], wanted[..., 2:]),
    )
    both = jnp.prod(jnp.maximum(high - low, 0), -1)
    area = [jnp.prod(jnp.maximum(b[..., 2:] - b[..., :2], 0), -1) for b in (found, wanted)]
    union = area[0] + area[1] - both
    hull = jnp.prod(
        jnp.maximum(found[..., 2:], wanted[..., 2:]) - jnp.minimum(found[..., :2], wanted[..., :2]),
        -1,
    )
    overlap = both / jnp.maximum(union, 1e-3) - (hull - union) / jnp.maximum(hull, 1e-3)
    return ((1 - overlap) * weights).sum() / jnp.maximum(weights.sum(), 1e-3)


def loss(params: net.Params, moments: net.Params, batch: Batch) -> tuple[Any, tuple[Any, Any, Any]]:
    """Return the loss of a batch, and the new moments and both parts of the loss."""
    pictures, heat, mask, boxes, weights = batch
    out, new = net.apply(params, moments, pictures.astype(jnp.float32) / 255, True)
    first = heat_loss(out[..., : len(CLASSES)], heat, mask)
    second = box_loss(corners(out[..., len(CLASSES) :]), boxes, weights)
    return first + BOX_WEIGHT * second, (new, first, second)


@partial(jax.jit, static_argnums=0, donate_argnums=1)
def step(optimiser: Any, state: State, batch: Batch, number: Any) -> tuple[State, Any]:
    """Do the step of this number; return the new state and (heat loss, box loss)."""
    grads, (moments, first, second) = jax.grad(loss, has_aux=True)(
        state.params, state.moments, batch
    )
    updates, inner = optimiser.update(grads, state.optimiser, state.params)
    params = optax.apply_updates(state.params, updates)
    kept = jnp.minimum(
        AVERAGED, (1 + number) / (10 + number)
    )  # the first weights soon count little
    averaged = jax.tree.map(lambda a, p: kept * a + (1 - kept) * p, state.averaged, params)
    return State(params, moments, averaged, inner), jnp.stack([first, second])


def stage(number: int, steps: int) -> Stage:
    """Return the stage of a step."""
    return next(one for one in STAGES if number < one.end * steps)


def batches(
    pictures: Sequence[Labelled], first: int, steps: int, seed: int, ahead: int = 2
) -> Iterator[Batch]:
    """Yield the batches of steps from `first` on; a thread makes them beside training."""

    def make(number: int) -> Batch:
        rng, now = np.random.default_rng([seed, number]), stage(number, steps)
        chosen = rng.integers(len(pictures), size=now.batch)
        made = [augment(rng, pictures[k], now.width, now.height) for k in chosen]
        parts = [targets(one, now.height, now.width) for _, one in made]
        stacked = (np.stack(part) for part in zip(*parts, strict=True))
        return (np.stack([picture for picture, _ in made]), *stacked)

    with ThreadPoolExecutor(1) as pool:
        jobs = {k: pool.submit(make, k) for k in range(first, min(first + ahead, steps))}
        for number in range(first, steps):
            done = jobs.pop(number).result()
            if number + ahead < steps:
                jobs[number + ahead] = pool.submit(make, number + ahead)
            yield done


def learn(pictures: Sequence[Labelled], steps: int, folder: Path, seed: int = 0) -> State:
    """Train for some steps; goes on from the folder's checkpoint where there is one."""
    folder.mkdir(parents=True, exist_ok=True)
    checkpoint = folder / "checkpoint.pickle"
    warm_up = min(WARM_UP_STEPS, steps // 8)
    rate = optax.warmup_cosine_decay_schedule(0.0, PEAK_RATE, warm_up, steps, PEAK_RATE / 100)
    optimiser = optax.chain(
        optax.clip_by_global_norm(10.0), optax.adamw(rate, weight_decay=WEIGHT_DECAY)
    )
    params, moments = net.init(seed)
    state, first = State(params, moments, params, optimiser.init(params)), 0
    if checkpoint.exists():
        first, leaves = pickle.loads(checkpoint.read_bytes())
        state = jax.tree.unflatten(jax.tree.structure(state), leaves)
    state = State(*jax.tree.map(jnp.array, tuple(state)))
    begun, sums = time.monotonic(), np.zeros(2)
    for number, batch in enumerate(batches(pictures, first, steps, seed), first):
        state, parts = step(optimiser, state, batch, jnp.float32(number))
        sums += np.asarray(parts)
        if (number + 1) % 50 == 0:
            pace = (time.monotonic() - begun) / (number + 1 - first)
            log.info("step %d: heat %.3f, box %.3f, %.2f s a step", number + 1, *sums / 50, pace)
            sums[:] = 0
        if (number + 1) % SAVE_EVERY_STEPS == 0 or number + 1 == steps:
            leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(state)]
            checkpoint.with_suffix(".part").write_bytes(pickle.dumps((number + 1, leaves)))
            checkpoint.with_suffix(".part").replace(checkpoint)
    return state
