"""Writes small ONNX files with known answers, in protobuf's wire format (onnx/onnx.proto3)."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Dims = Sequence[int | str]


def varint(value: int) -> bytes:
    found = b""
    while value > 127:
        found += bytes((value & 127 | 128,))
        value >>= 7
    return found + bytes((value,))


def number(field: int, value: int) -> bytes:
    return varint(field << 3) + varint(value)


def part(field: int, data: bytes | str) -> bytes:
    data = data.encode() if isinstance(data, str) else data
    return varint(field << 3 | 2) + varint(len(data)) + data


def value_info(name: str, dims: Dims) -> bytes:
    sizes = [number(1, one) if isinstance(one, int) else part(2, one) for one in dims]
    shape = b"".join(part(1, one) for one in sizes)
    return part(1, name) + part(2, part(1, number(1, 1) + part(2, shape)))


def tensor(name: str, values: NDArray[np.float32] | NDArray[np.int64]) -> bytes:
    kind = 7 if values.dtype == np.int64 else 1
    dims = b"".join(number(1, size) for size in values.shape)
    return dims + number(2, kind) + part(8, name) + part(9, values.tobytes())


def node(kind: str, inputs: Sequence[str], output: str, attributes: bytes = b"") -> bytes:
    named = b"".join(part(1, one) for one in inputs)
    return named + part(2, output) + part(4, kind) + attributes


def write_net(
    path: Path, dims: Dims, answer: NDArray[np.float32], red: NDArray[np.float32] | None = None
) -> Path:
    """Write a net that gives `answer` plus `red` times the mean red of the picture, of 0 to 1."""
    red = np.zeros_like(answer) if red is None else red
    only_red = np.array((1.0, 0.0, 0.0), np.float32).reshape(1, 3, 1, 1)
    to_scalar = np.array([1] * answer.ndim, np.int64)
    nodes = (
        node("GlobalAveragePool", ("images",), "means"),
        node("Conv", ("means", "only_red"), "red_mean"),
        node("Reshape", ("red_mean", "to_scalar"), "scalar"),
        node("Mul", ("scalar", "red"), "more"),
        node("Add", ("more", "answer"), "output0"),
    )
    weights = {"only_red": only_red, "to_scalar": to_scalar, "red": red, "answer": answer}
    graph = b"".join(part(1, one) for one in nodes) + part(2, "net")
    graph += b"".join(part(5, tensor(name, one)) for name, one in weights.items())
    graph += part(11, value_info("only_red", only_red.shape))  # as old exports list weights, too
    graph += part(11, value_info("images", dims)) + part(12, value_info("output0", answer.shape))
    opset = part(8, part(1, "") + number(2, 13))
    path.write_bytes(number(1, 8) + opset + part(7, graph))
    return path
