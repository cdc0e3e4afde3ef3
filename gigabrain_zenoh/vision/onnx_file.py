"""Reads the input of an ONNX file, without a library, because cv2.dnn does not report it.

An ONNX file is a ModelProto in protobuf's wire format (onnx/onnx.proto3).
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import file_problem, read_bounded

MAX_BYTES = 1_000_000_000
GRAPH, INITIALIZER, INPUT = 7, 5, 11  # fields of ModelProto and GraphProto
TENSOR_NAME, VALUE_NAME, VALUE_TYPE = 8, 1, 2
TENSOR_TYPE, SHAPE, DIM, DIM_VALUE = 1, 2, 1, 1
VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5  # wire types


class OnnxInput(NamedTuple):
    """The first input of a net."""

    name: str
    shape: tuple[int | None, ...]  # None: of any size


def input_of(path: Path) -> OnnxInput:
    """Return the first input of a net. Raises ConfigError for an invalid or unreadable file."""
    try:
        data = memoryview(read_bounded(path, MAX_BYTES))
    except OSError as error:
        raise ConfigError(f"{path}: {file_problem(error)}") from None
    try:
        graphs = [value for number, value in _fields(data) if number == GRAPH]
        parts = list(_fields(_message(graphs[-1])))
        weights = {_text(part, TENSOR_NAME) for number, part in parts if number == INITIALIZER}
        inputs = [part for number, part in parts if number == INPUT]
        found = next(one for one in inputs if _text(one, VALUE_NAME) not in weights)
        return OnnxInput(_text(found, VALUE_NAME), _shape(found))
    except (ValueError, IndexError, StopIteration):
        raise ConfigError(f"{path}: not an ONNX file") from None


Value = memoryview | int


def _fields(data: memoryview) -> Iterator[tuple[int, Value]]:
    """Yield the fields of a message. Raises ValueError and IndexError."""
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        kind = key & 7
        if kind == VARINT:
            value, at = _varint(data, at)
            yield key >> 3, value
            continue
        size = {FIXED64: 8, FIXED32: 4}.get(kind)
        if kind == BYTES:
            size, at = _varint(data, at)
        if size is None or at + size > len(data):
            raise ValueError("not a message of protobuf")
        yield key >> 3, data[at : at + size]
        at += size


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    value = shift = 0
    while shift < 70:
        byte = data[at]
        value |= (byte & 127) << shift
        at, shift = at + 1, shift + 7
        if byte < 128:
            return value, at
    raise ValueError("a number without an end")


def _message(value: Value) -> memoryview:
    if isinstance(value, int):
        raise ValueError("expected a message")
    return value


def _first(value: Value, wanted: int) -> Value | None:
    return next((one for number, one in _fields(_message(value)) if number == wanted), None)


def _text(value: Value, wanted: int) -> str:
    found = _first(value, wanted)
    return "" if found is None else bytes(_message(found)).decode()


def _shape(value: Value) -> tuple[int | None, ...]:
    inner: Value = value
    for wanted in (VALUE_TYPE, TENSOR_TYPE, SHAPE):
        found = _first(inner, wanted)
        if found is None:
            return ()
        inner = found
    sizes = (_first(one, DIM_VALUE) for number, one in _fields(_message(inner)) if number == DIM)
    return tuple(size if isinstance(size, int) and size > 0 else None for size in sizes)
