"""Every field of every message has bounds."""

from collections.abc import Iterator
from typing import Any

import msgspec
import pytest
from msgspec import inspect

from gigabrain_schemas.body import Body, RobotState
from gigabrain_schemas.brain import CmdVel, JointCommand, OccupancyGrid
from gigabrain_schemas.topics import messages
from gigabrain_zenoh.qa.faults.hostile import as_map, replaced


def fields(of: Any, where: str) -> Iterator[tuple[str, Any]]:
    """Yield the path and the type of every value that a message may contain."""
    if isinstance(of, inspect.StructType):
        for one in of.fields:
            yield from fields(one.type, f"{where}.{one.name}")
        return
    if isinstance(of, inspect.UnionType):
        for one in of.types:
            yield from fields(one, where)
        return
    yield where, of
    if isinstance(of, inspect.VarTupleType):
        yield from fields(of.item_type, where)
    if isinstance(of, inspect.TupleType):
        for one in of.item_types:
            yield from fields(one, where)
    if isinstance(of, inspect.DictType):
        yield from fields(of.key_type, where)
        yield from fields(of.value_type, where)


ALL = [
    pytest.param(where, of, id=f"{where}-{type(of).__name__}")
    for message in messages()
    for where, of in fields(inspect.type_info(message), message.__name__)
]


@pytest.mark.parametrize(("where", "of"), ALL)
def test_every_field_is_bounded(where: str, of: Any) -> None:
    if isinstance(of, inspect.IntType | inspect.FloatType):
        assert of.le is not None
        assert of.ge is not None or of.gt is not None
    if isinstance(of, inspect.StrType | inspect.BytesType | inspect.VarTupleType):
        assert of.max_length is not None
    if isinstance(of, inspect.DictType):
        assert of.max_length is not None


@pytest.mark.parametrize(
    ("message", "path", "good", "bad"),
    [
        (OccupancyGrid, ("resolution",), (0.001, 1.0), (1e-9, 0.0009, 1.01, 1e9)),
        (OccupancyGrid, ("origin_x",), (-1e5, 1e5), (-1e9, 1e6)),
        (CmdVel, ("linear_x",), (-100.0, 100.0), (-1e9, 100.1, 1e9)),
        (CmdVel, ("angular_z",), (-100.0, 100.0), (-101.0, 1e9)),
        (CmdVel, ("tick",), (0, 2**38), (-1, 2**38 + 1, 2**62)),
        (Body, ("description", "footprint", 0, 0), (0.1, 10.0), (10.1, 1e9)),
        (Body, ("description", "max_linear_deceleration"), (2.5, 1000.0), (1e-9, 1e9)),
        (Body, ("description", "lidar", "rate_hz"), (0.1, 1000.0), (1e-9, 1e9)),
        (Body, ("description", "max_angular_speed"), (0.3, 100.0), (1e-9, 101.0)),
        (RobotState, ("joints", 0, "name"), ("a", "x" * 64), ("", "x" * 65)),
        (JointCommand, ("name", 0), ("a", "x" * 64), ("", "x" * 65)),
    ],
)
def test_lengths_speeds_ticks_and_names_have_the_bounds_of_their_kind(
    message: Any, path: tuple[str | int, ...], good: tuple[Any, ...], bad: tuple[Any, ...]
) -> None:
    whole = as_map(message)
    for value in good:
        msgspec.msgpack.decode(msgspec.msgpack.encode(replaced(whole, path, value)), type=message)
    for value in bad:
        payload = msgspec.msgpack.encode(replaced(whole, path, value))
        with pytest.raises(msgspec.ValidationError):
            msgspec.msgpack.decode(payload, type=message)
