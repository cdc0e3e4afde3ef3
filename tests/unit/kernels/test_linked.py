"""Types of the arguments that a linked kernel accepts."""

from typing import Any, NamedTuple

import numpy as np
import pytest

from gigabrain_zenoh.kernels.linked import ArrayType, ScalarType, TupleType, matcher


class Point(NamedTuple):
    x: float
    y: float


GRID = ArrayType("float32", 2, contiguous=True)
ANY_GRID = ArrayType("float32", 2, contiguous=False)
NUMBER, COUNT, SWITCH = ScalarType("float64"), ScalarType("int64"), ScalarType("bool")
PAIR = TupleType((NUMBER, NUMBER))
CELLS = np.zeros((4, 6), np.float32)
READ_ONLY = np.frombuffer(bytes(96), np.float32).reshape(4, 6)


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        (NUMBER, 1.0),
        (NUMBER, np.float64(1.0)),
        (COUNT, 1),
        (COUNT, np.int64(1)),
        (SWITCH, True),
        (SWITCH, np.bool_(True)),
        (GRID, CELLS),
        (ANY_GRID, CELLS[::2, 1:3]),
        (PAIR, (1.0, 2.0)),
        (PAIR, Point(1.0, 2.0)),
        (TupleType((GRID, PAIR)), (CELLS, (1.0, 2.0))),
    ],
)
def test_a_value_of_the_type_is_accepted(kind: Any, value: object) -> None:
    assert matcher(kind)(value)


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        (NUMBER, 1),
        (NUMBER, np.float32(1.0)),
        (COUNT, True),
        (COUNT, 1.0),
        (SWITCH, 1),
        (GRID, None),
        (GRID, CELLS.astype(np.float64)),
        (GRID, CELLS[0]),
        (GRID, CELLS.T),
        (GRID, CELLS[:, ::2]),
        (GRID, READ_ONLY),
        (ANY_GRID, READ_ONLY),
        (GRID, np.ma.masked_array(CELLS)),
        (PAIR, [1.0, 2.0]),
        (PAIR, (1.0, 2.0, 3.0)),
        (PAIR, (1.0, 2)),
        (TupleType((GRID, PAIR)), (CELLS, (1.0, 2))),
    ],
)
def test_a_value_of_another_type_is_left_to_numba(kind: Any, value: object) -> None:
    assert not matcher(kind)(value)
