"""Clips the values of a faulty body to the bounds of its messages."""

import contextlib
import functools
import math
from collections.abc import Callable
from typing import Any, TypeVar

import msgspec
from msgspec import Struct, inspect

from gigabrain_zenoh.codec import DECODE_ERRORS, encode

R = TypeVar("R", bound=Struct)
Bounds = tuple[float, float]


def clipped(record: R) -> R:
    """Return `record` with each bounded float within its bounds, in nested records as well.

    A faulty body may report 1e6 m/s. Clipped to 100 m/s, it makes safety stop the robot; unclipped,
    the whole state would be refused.
    """
    decode = _decoder(type(record))
    if decode:
        with contextlib.suppress(*DECODE_ERRORS):
            decode(encode(record))  # much faster than a check of each float
            return record
    changes: dict[str, Any] = {}
    for name, bounds in _fields(type(record)).items():
        value = getattr(record, name)
        within = _within(value, bounds)
        if within is not value:
            changes[name] = within
    return msgspec.structs.replace(record, **changes) if changes else record


def fault_of(record: Struct) -> str:
    """Return a text on the first value beyond its bounds; empty if there is none."""
    decode = _decoder(type(record))
    try:
        if decode:
            decode(encode(record))
    except DECODE_ERRORS as error:
        return str(error)
    return ""


def _within(value: Any, bounds: Bounds | None) -> Any:
    """Return `value` within its bounds; the same object if nothing changes."""
    if isinstance(value, Struct):
        return clipped(value)
    if isinstance(value, tuple):
        parts = tuple(_within(part, bounds) for part in value)
        return value if all(a is b for a, b in zip(value, parts, strict=True)) else parts
    if bounds is None or not isinstance(value, float) or bounds[0] <= value <= bounds[1]:
        return value
    return value if math.isnan(value) else min(max(value, bounds[0]), bounds[1])


@functools.cache
def _decoder(record: type[Struct]) -> Callable[[bytes], object] | None:
    """Return a decoder, which checks all bounds; None for records with arrays, as pictures."""
    info = inspect.type_info(record)
    assert isinstance(info, inspect.StructType)
    arrays = any(isinstance(field.type, inspect.BytesType) for field in info.fields)
    return None if arrays else msgspec.msgpack.Decoder(record).decode


@functools.cache
def _fields(record: type[Struct]) -> dict[str, Bounds | None]:
    """Return the fields that may need clipping, with the bounds of their floats."""
    info = inspect.type_info(record)
    assert isinstance(info, inspect.StructType)
    fields = {field.name: _bounds(field.type) for field in info.fields}
    return {name: bounds for name, bounds in fields.items() if bounds != ()}  # type: ignore[misc]


def _bounds(info: inspect.Type) -> Bounds | tuple[()] | None:
    """Return the bounds of a float or of a tuple's floats; None for records, () for all else."""
    if isinstance(info, inspect.FloatType):
        low, high = info.ge, info.le
        return (-math.inf if low is None else low, math.inf if high is None else high)
    if isinstance(info, inspect.StructType):
        return None
    if isinstance(info, inspect.VarTupleType):
        return _bounds(info.item_type)
    if isinstance(info, inspect.TupleType):
        return _bounds(info.item_types[0])
    if isinstance(info, inspect.UnionType):
        found = [bounds for bounds in map(_bounds, info.types) if bounds != ()]
        return found[0] if found else ()
    return ()
