"""Keeps what a body reports within the bounds of its messages, so that nobody has to refuse it.

A faulty body may say that it drives at 1e6 m/s. Clipped, that is 100 m/s, which safety stops;
refused, the whole state would be missing.
"""

import functools
import math
from typing import Any, TypeVar

import msgspec
from msgspec import Struct, inspect

R = TypeVar("R", bound=Struct)
Bounds = tuple[float, float]


def clipped(record: R) -> R:
    """Return `record` with each bounded float within its bounds, in nested records as well."""
    changes: dict[str, Any] = {}
    for name, bounds in _fields(type(record)).items():
        value = getattr(record, name)
        within = _within(value, bounds)
        if within is not value:
            changes[name] = within
    return msgspec.structs.replace(record, **changes) if changes else record


def _within(value: Any, bounds: Bounds | None) -> Any:
    """Return what is to stand in place of `value`: itself, unless it is out of bounds."""
    if isinstance(value, Struct):
        return clipped(value)
    if isinstance(value, tuple):
        parts = tuple(_within(part, bounds) for part in value)
        return value if all(a is b for a, b in zip(value, parts, strict=True)) else parts
    if bounds is None or not isinstance(value, float) or bounds[0] <= value <= bounds[1]:
        return value
    return value if math.isnan(value) else min(max(value, bounds[0]), bounds[1])


@functools.cache
def _fields(of: type[Struct]) -> dict[str, Bounds | None]:
    """Return the fields that may have to be clipped, with the bounds of their floats."""
    told = inspect.type_info(of)
    assert isinstance(told, inspect.StructType)
    fields = {field.name: _bounds(field.type) for field in told.fields}
    return {name: bounds for name, bounds in fields.items() if bounds != ()}  # type: ignore[misc]


def _bounds(told: inspect.Type) -> Bounds | tuple[()] | None:
    """Return the bounds of a float or of a tuple's floats; None for records, () for all else."""
    if isinstance(told, inspect.FloatType):
        low, high = told.ge, told.le
        return (-math.inf if low is None else low, math.inf if high is None else high)
    if isinstance(told, inspect.StructType):
        return None
    if isinstance(told, inspect.VarTupleType):
        return _bounds(told.item_type)
    if isinstance(told, inspect.TupleType):
        return _bounds(told.item_types[0])
    if isinstance(told, inspect.UnionType):
        found = [one for one in map(_bounds, told.types) if one != ()]
        return found[0] if found else ()
    return ()
