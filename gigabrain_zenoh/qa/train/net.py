"""The net: a small centre-based detector, described once for training and for export.

A picture of 240 x 320 gives 30 x 40 cells of 8 px. Each has a logit per class, with its maximum at
the middle of a thing, and the distances to the four sides of the thing's box. The path at stride 16
has a receptive field of 300 px. Training: TTFNet (Liu et al. 2020, arXiv 1909.00700).
"""

from collections.abc import Mapping
from typing import Any, Protocol, TypeVar

import numpy as np
import tensorflow as tf

from gigabrain_zenoh.vision.labels import CLASSES

T = TypeVar("T")
OUTPUTS = len(CLASSES) + 4
PRIOR = -4.0  # initial logit of a class: nearly all cells are empty
MOMENTUM, EPSILON = 0.98, 1e-3
Params = dict[str, dict[str, Any]]


class Ops(Protocol[T]):
    """The operations of the net on tensors of type T."""

    def conv(
        self,
        x: T,
        name: str,
        channels: int,
        *,
        size: int = 3,
        stride: int = 1,
        dilation: int = 1,
        normed: bool = True,
    ) -> T:
        """Convolve; keeps height and width at stride 1."""

    def relu(self, x: T) -> T:
        """Apply ReLU."""

    def add(self, a: T, b: T) -> T:
        """Add two tensors of one shape."""

    def double(self, x: T) -> T:
        """Repeat each cell twice in both directions."""


def network(ops: Ops[T], picture: T) -> T:
    """Build the net for a picture (n, 240, 320, 3), 0 to 1; returns (n, 30, 40, OUTPUTS)."""
    x = ops.relu(ops.conv(picture, "stem", 16, stride=2))
    x = ops.relu(ops.conv(x, "down4", 32, stride=2))
    middle = _block(ops, ops.relu(ops.conv(x, "down8", 64, stride=2)), "middle", 64)
    deep = _block(ops, ops.relu(ops.conv(middle, "down16", 72, stride=2)), "deep", 72)
    deep = _block(ops, deep, "wide", 72, dilation=2)
    top = ops.double(ops.conv(deep, "deep_in", 64, size=1))
    middle = ops.relu(ops.add(top, ops.conv(middle, "middle_in", 64, size=1)))
    middle = ops.relu(ops.conv(middle, "merge8", 64))
    return ops.conv(middle, "out", OUTPUTS, size=1, normed=False)


def _block(ops: Ops[T], x: T, name: str, channels: int, dilation: int = 1) -> T:
    """Return a residual block: x plus two convolutions of x."""
    y = ops.relu(ops.conv(x, f"{name}1", channels, dilation=dilation))
    return ops.relu(ops.add(x, ops.conv(y, f"{name}2", channels, dilation=dilation)))


class TensorFlowOps:
    """The net's operations in TensorFlow.

    `training` uses the mean and variance of the batch; `moments` are their running averages.
    """

    def __init__(self, params: Params, moments: Params, training: bool) -> None:
        self._params, self._old, self._training = params, moments, training
        self.moments: Params = {}

    def conv(
        self,
        x: Any,
        name: str,
        channels: int,
        *,
        size: int = 3,
        stride: int = 1,
        dilation: int = 1,
        normed: bool = True,
    ) -> Any:
        """Convolve, then normalise over the batch unless not `normed`."""
        own = self._params[name]
        if stride > 1:  # "SAME" would pad on two sides only
            x = tf.pad(x, [[0, 0], [size // 2] * 2, [size // 2] * 2, [0, 0]])
        padding = "SAME" if stride == 1 else "VALID"
        y = tf.nn.conv2d(x, tf.cast(own["w"], x.dtype), stride, padding, dilations=dilation)
        if not normed:
            return tf.cast(y, tf.float32) + own["b"]
        old = self._old[name]
        y, mean, variance, *_ = tf.raw_ops.FusedBatchNormV3(
            x=y,
            scale=own["scale"],
            offset=own["b"],
            mean=[] if self._training else old["mean"],
            variance=[] if self._training else old["variance"],
            epsilon=EPSILON,
            is_training=self._training,
        )
        self.moments[name] = {
            key: MOMENTUM * old[key] + (1 - MOMENTUM) * new
            for key, new in (("mean", mean), ("variance", variance))
        }
        return y

    def relu(self, x: Any) -> Any:
        """Apply ReLU."""
        return tf.nn.relu(x)

    def add(self, a: Any, b: Any) -> Any:
        """Add two tensors."""
        return a + b

    def double(self, x: Any) -> Any:
        """Repeat each cell twice in both directions."""
        n, h, w, c = x.shape
        wide = tf.broadcast_to(x[:, :, None, :, None], (n, h, 2, w, 2, c))
        return tf.reshape(wide, (n, 2 * h, 2 * w, c))


class _WeightMaker:
    """Creates the weights of the net; a tensor is its number of channels."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self.params: Params = {}
        self.moments: Params = {}

    def conv(
        self,
        x: int,
        name: str,
        channels: int,
        *,
        size: int = 3,
        stride: int = 1,
        dilation: int = 1,
        normed: bool = True,
    ) -> int:
        spread = (2 / (size * size * x)) ** 0.5 if normed else 0.01
        own = {
            "w": self._rng.normal(0, spread, (size, size, x, channels)).astype(np.float32),
            "b": np.zeros(channels, np.float32),
        }
        if normed:
            own["scale"] = np.full(channels, 0.5 if name.endswith("2") else 1.0, np.float32)
            self.moments[name] = {
                "mean": np.zeros(channels, np.float32),
                "variance": np.ones(channels, np.float32),
            }
        else:
            own["b"][: len(CLASSES)] = PRIOR
        self.params[name] = own
        return channels

    def relu(self, x: int) -> int:
        return x

    def add(self, a: int, b: int) -> int:
        assert a == b, "sums need equal channels"
        return a

    def double(self, x: int) -> int:
        return x


def init(seed: int) -> tuple[Params, Params]:
    """Return the weights and moments of a new net."""
    sizes = _WeightMaker(np.random.default_rng(seed))
    network(sizes, 3)
    return sizes.params, sizes.moments


def parameters(params: Mapping[str, Mapping[str, Any]]) -> int:
    """Return the number of parameters of the exported net, without the folded scales."""
    return sum(own["w"].size + own["b"].size for own in params.values())


def apply(params: Params, moments: Params, picture: Any, training: bool) -> tuple[Any, Params]:
    """Run the net in the type of `picture`; return its outputs (float32) and the new moments."""
    ops = TensorFlowOps(params, moments, training)
    return network(ops, picture), ops.moments


def fold(params: Params, moments: Params) -> dict[str, tuple[Any, Any]]:
    """Return weights (h, w, in, out) and bias of each convolution, with folded normalisation."""
    folded = {}
    for name, own in params.items():
        w, b = np.asarray(own["w"]), np.asarray(own["b"])
        if "scale" in own:
            moment = {key: np.asarray(value) for key, value in moments[name].items()}
            scale = np.asarray(own["scale"]) / np.sqrt(moment["variance"] + EPSILON)
            w, b = w * scale, b - moment["mean"] * scale
        folded[name] = (w, b)
    return folded
