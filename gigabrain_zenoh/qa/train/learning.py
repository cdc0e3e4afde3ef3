"""Training: losses, the optimiser's step, and the loop over pictures."""

import logging
import pickle
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import keras
import numpy as np
import tensorflow as tf

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
    """A part of training with pictures of one size."""

    end: float  # share of all steps at its end
    width: int  # of pictures [px], a multiple of 16
    height: int  # a multiple of 16
    batch: int


# Small pictures take less time, and suffice to learn the looks first.
STAGES = (
    Stage(0.4, 192, 144, 24),
    Stage(0.75, 256, 192, 16),
    Stage(1.0, WIDTH_PX, HEIGHT_PX, 16),
)
PEAK_RATE, WEIGHT_DECAY, WARM_UP_STEPS = 2.5e-3, 2e-2, 200
BOX_WEIGHT = 4.0
AVERAGE_DECAY = 0.998  # per step, of the averaged weights, which are exported
LOG_EVERY_STEPS, SAVE_EVERY_STEPS = 100, 500
log = logging.getLogger(__name__)


Batch = tuple[Any, ...]


def heat_loss(logits: Any, heat: Any, mask: Any) -> Any:
    """Penalty-reduced focal loss of CenterNet, as the mean over things."""
    p, peak = tf.sigmoid(logits), heat > 0.999
    surprise = tf.nn.softplus(-logits)  # -log p; plus the logit, it is -log(1 - p)
    right = (1 - p) ** 2 * surprise
    wrong = (1 - heat) ** 4 * p**2 * (surprise + logits)
    found = tf.reduce_sum(tf.cast(peak, tf.float32))
    return tf.reduce_sum(tf.where(peak, right, wrong) * mask) / tf.maximum(found, 1)


def corners(raw: Any) -> Any:
    """Return boxes (n, h, w, 4) [px] from raw distances to left, top, right, bottom."""
    d = UNIT_PX * tf.exp(tf.clip_by_value(raw, *RAW_LIMITS))
    x = (np.arange(raw.shape[2], dtype=np.float32) + 0.5) * STRIDE_PX
    y = (np.arange(raw.shape[1], dtype=np.float32)[:, None] + 0.5) * STRIDE_PX
    return tf.stack([x - d[..., 0], y - d[..., 1], x + d[..., 2], y + d[..., 3]], -1)


def box_loss(found: Any, wanted: Any, weights: Any) -> Any:
    """Weighted generalised IoU loss."""

    def area(low: Any, high: Any) -> Any:
        return tf.reduce_prod(tf.maximum(high - low, 0), -1)

    (a, b), (c, d) = ((box[..., :2], box[..., 2:]) for box in (found, wanted))
    both = area(tf.maximum(a, c), tf.minimum(b, d))
    union = area(a, b) + area(c, d) - both
    hull = area(tf.minimum(a, c), tf.maximum(b, d))
    overlap = both / tf.maximum(union, 1e-3) - (hull - union) / tf.maximum(hull, 1e-3)
    return tf.reduce_sum((1 - overlap) * weights) / tf.maximum(tf.reduce_sum(weights), 1e-3)


def computing_type() -> Any:
    """Return bfloat16 if the processor multiplies its matrices, else float32."""
    info = Path("/proc/cpuinfo")
    return tf.bfloat16 if info.exists() and "amx_bf16" in info.read_text() else tf.float32


class Learner:
    """The weights, their moments and averages, and the optimiser."""

    def __init__(self, steps: int, seed: int) -> None:
        params, moments = net.init(seed)
        self.params = tf.nest.map_structure(tf.Variable, params)
        self.moments = tf.nest.map_structure(tf.Variable, moments)
        self.averaged = tf.nest.map_structure(tf.Variable, params)
        warm_up = min(WARM_UP_STEPS, steps // 8)
        rate = keras.optimizers.schedules.CosineDecay(
            0.0, steps - warm_up, alpha=0.01, warmup_target=PEAK_RATE, warmup_steps=warm_up
        )
        self._optimiser = keras.optimizers.AdamW(
            rate, weight_decay=WEIGHT_DECAY, epsilon=1e-8, global_clipnorm=10.0
        )
        self._optimiser.build(tf.nest.flatten(self.params))
        self._type = computing_type()
        self.step = tf.function(self._step)

    def _step(self, batch: Batch, number: Any) -> Any:
        """Do one step; return (heat loss, box loss)."""
        pictures, heat, mask, boxes, weights = batch
        weights_of_net = tf.nest.flatten(self.params)
        with tf.GradientTape() as tape:
            shown = tf.cast(tf.cast(pictures, tf.float32) / 255, self._type)
            out, moments = net.apply(self.params, self.moments, shown, True)
            first = heat_loss(out[..., : len(CLASSES)], heat, mask)
            second = box_loss(corners(out[..., len(CLASSES) :]), boxes, weights)
            loss = first + BOX_WEIGHT * second
        self._optimiser.apply(tape.gradient(loss, weights_of_net), weights_of_net)
        tf.nest.map_structure(lambda old, new: old.assign(new), self.moments, moments)
        kept = tf.minimum(
            AVERAGE_DECAY, (1 + number) / (10 + number)
        )  # lower at the start, to forget the first weights
        for mean, new in zip(tf.nest.flatten(self.averaged), weights_of_net, strict=True):
            mean.assign(kept * mean + (1 - kept) * new)
        return tf.stack([first, second])

    def _variables(self) -> list[Any]:
        return [
            *tf.nest.flatten((self.params, self.moments, self.averaged)),
            *self._optimiser.variables,
        ]

    def save(self, path: Path, number: int) -> None:
        """Write a checkpoint after `number` steps."""
        values = [np.asarray(one) for one in self._variables()]
        path.with_suffix(".part").write_bytes(pickle.dumps((number, values)))
        path.with_suffix(".part").replace(path)

    def restore(self, path: Path) -> int:
        """Read a checkpoint; return its number of steps."""
        number, values = pickle.loads(path.read_bytes())
        for one, value in zip(self._variables(), values, strict=True):
            one.assign(value)
        return int(number)


def stage(number: int, steps: int) -> Stage:
    """Return the stage of a step."""
    return next(one for one in STAGES if number < one.end * steps)


def batches(
    pictures: Sequence[Labelled], first: int, steps: int, seed: int, ahead: int = 2
) -> Iterator[Batch]:
    """Yield the batches of the steps from `first` on; a thread prepares them during training."""

    def make(number: int) -> Batch:
        rng, current = np.random.default_rng([seed, number]), stage(number, steps)
        chosen = rng.integers(len(pictures), size=current.batch)
        augmented = [augment(rng, pictures[k], current.width, current.height) for k in chosen]
        parts = [targets(one, current.height, current.width) for _, one in augmented]
        stacked = (np.stack(part) for part in zip(*parts, strict=True))
        return (np.stack([picture for picture, _ in augmented]), *stacked)

    with ThreadPoolExecutor(1) as pool:
        jobs = {k: pool.submit(make, k) for k in range(first, min(first + ahead, steps))}
        for number in range(first, steps):
            done = jobs.pop(number).result()
            if number + ahead < steps:
                jobs[number + ahead] = pool.submit(make, number + ahead)
            yield done


def learn(pictures: Sequence[Labelled], steps: int, folder: Path, seed: int = 0) -> Learner:
    """Train up to `steps`; continue from the checkpoint in `folder`, if there is one."""
    folder.mkdir(parents=True, exist_ok=True)
    checkpoint = folder / "checkpoint.pickle"
    learner = Learner(steps, seed)
    first = learner.restore(checkpoint) if checkpoint.exists() else 0
    begin_s, sums = time.monotonic(), np.zeros(2)
    for number, batch in enumerate(batches(pictures, first, steps, seed), first):
        sums += learner.step(batch, tf.constant(number, tf.float32)).numpy()
        if (number + 1) % LOG_EVERY_STEPS == 0:
            pace = (time.monotonic() - begin_s) / (number + 1 - first)
            sums /= LOG_EVERY_STEPS
            log.info("step %d: heat %.3f, box %.3f, %.3f s a step", number + 1, *sums, pace)
            sums[:] = 0
        if (number + 1) % SAVE_EVERY_STEPS == 0 or number + 1 == steps:
            learner.save(checkpoint, number + 1)
    return learner
