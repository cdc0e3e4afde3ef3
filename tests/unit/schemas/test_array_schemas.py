"""Another language reads an array by its exported JSON Schema alone."""

import base64
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from gigabrain_schemas.base import Message
from gigabrain_schemas.examples import EXAMPLES, export
from gigabrain_schemas.sensors import PIXEL_BYTES, Image

OURS: dict[str, Callable[[Any], Any]] = {
    "LaserScan": lambda scan: scan.ranges_m,
    "WorldModel": lambda world: world.points(),
    "ArmPlan": lambda plan: plan.points(),
    "OccupancyGrid": lambda grid: grid.array(),
    "Image": lambda image: image.array(),
}
PIXELS = [
    Image(frame_id="c", encoding=one, height=2, width=3, data=bytes(range(6 * size)))  # type: ignore[arg-type]
    for one, size in PIXEL_BYTES.items()
]


@pytest.fixture(scope="module")
def arrays(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """Return the properties that hold bytes, by message."""
    folder: Path = tmp_path_factory.mktemp("schemas")
    export(folder)
    found = {}
    for name in EXAMPLES:
        properties = json.loads((folder / f"{name}.json").read_bytes())["$defs"][name]["properties"]
        found[name] = {key: one for key, one in properties.items() if "contentEncoding" in one}
    return {name: properties for name, properties in found.items() if properties}


def test_every_array_has_its_type_byte_order_and_shape_in_its_schema(
    arrays: dict[str, dict[str, Any]],
) -> None:
    assert set(arrays) == {*OURS, "SimScene", "SimPoses"}
    notes = {"x-dtype", "x-byte-order", "x-shape"}
    assert all(notes <= one.keys() for each in arrays.values() for one in each.values())


@pytest.mark.parametrize(
    "message",
    [*(EXAMPLES[name] for name in OURS if name != "Image"), *PIXELS],
    ids=lambda one: f"{type(one).__name__} {getattr(one, 'encoding', '')}",
)
def test_an_array_is_read_by_its_schema(
    message: Message, arrays: dict[str, dict[str, Any]]
) -> None:
    name, plain = type(message).__name__, json.loads(msgspec.json.encode(message))
    ((key, notes),) = arrays[name].items()
    dtype, shape = notes["x-dtype"], notes["x-shape"]
    if name == "Image":
        dtype, shape = dtype[plain["encoding"]], shape[plain["encoding"]]
    order = {"little": "<"}[notes["x-byte-order"]]
    values = np.frombuffer(base64.b64decode(plain[key]), np.dtype(dtype).newbyteorder(order))
    sizes = [plain.get(size, -1) if isinstance(size, str) else size for size in shape]
    values = values.reshape(sizes)
    expected = OURS[name](message)
    assert values.size > 0
    np.testing.assert_array_equal(values, expected)
    assert (values.dtype, values.shape) == (expected.dtype, expected.shape)


def test_a_compressed_picture_has_no_array_type(arrays: dict[str, dict[str, Any]]) -> None:
    assert arrays["Image"]["data"]["x-dtype"]["jpeg"] is None
