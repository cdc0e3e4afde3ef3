"""ROS maps (map_server): a YAML file and a greyscale image, read into a grid of cells."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from gigabrain_schemas.base import Finite, Fraction
from gigabrain_zenoh.config import loading as config
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import file_problem, read_bounded

MAX_PIXELS, MAX_SIDE = 8_000_000, 100_000  # limits of a message [pixels]
MAX_COORDINATE_M = 100_000.0  # limit of a message
MAX_HEADER_BYTES = 100_000  # with comments
PGM_GAP = rb"(?:\s|#[^\n]*\n)+"  # white space and comments
PGM_HEADER = re.compile(rb"P5" + (PGM_GAP + rb"(\d{1,9})") * 3 + rb"\s")

Cells = NDArray[np.int8]


class MapYaml(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """ROS's description of a map image."""

    image: Annotated[str, Meta(pattern=r"^[^\0]+$")]
    resolution: Annotated[float, Meta(ge=0.001, le=1.0)]  # [m] per pixel
    origin: tuple[Finite, Finite, Finite]  # x, y [m] of the lower left corner, yaw [rad]
    negate: Annotated[int, Meta(ge=0, le=1)] = 0  # 1: white is occupied
    occupied_thresh: Fraction = 0.65
    free_thresh: Fraction = 0.196
    mode: Literal["trinary", "scale"] = "trinary"  # both are read as trinary


@dataclass(frozen=True, slots=True)
class SavedMap:
    """A grid read from disk."""

    cells: Cells  # (height, width), the lowest row first: 0 free, 100 occupied, -1 unknown
    resolution: float  # [m]
    origin_x: float  # [m], of the corner of cell (0, 0)
    origin_y: float  # [m]


def read_pgm(file: Path) -> NDArray[np.uint8]:
    """Read the grey values of a file (height, width), the top row first. Raises ConfigError."""
    try:
        data = read_bounded(file, MAX_PIXELS + MAX_HEADER_BYTES)
    except OSError as error:
        raise ConfigError(f"{file}: the map's image: {file_problem(error)}") from None
    header = PGM_HEADER.match(data)
    if header is None:
        raise ConfigError(f"{file}: no binary PGM; expected a header such as 'P5 640 480 255'")
    width, height, maxval = (int(number) for number in header.groups())
    if maxval != 255:
        raise ConfigError(f"{file}: a maxval of {maxval}; expected 255")
    if not 0 < width * height <= MAX_PIXELS:
        raise ConfigError(f"{file}: {width} x {height} pixels; expected 1 to {MAX_PIXELS} in all")
    pixels = len(data) - header.end()
    if pixels != width * height:
        problem = "cut" if pixels < width * height else "of another size"
        raise ConfigError(f"{file}: {problem}: {pixels} of {width} x {height} pixels are there")
    return np.frombuffer(data, np.uint8, offset=header.end()).reshape(height, width)


def load(path: Path, read_image: Callable[[Path], NDArray[np.uint8]] = read_pgm) -> SavedMap:
    """Load the grid that a YAML file describes. Raises ConfigError, in one line.

    `read_image` returns the grey values of the image, the top row first.
    """
    about = config.load(path, MapYaml)
    if about.origin[2] != 0:
        raise ConfigError(f"{path}: origin: turned by {about.origin[2]:g} rad; expected yaw 0")
    if about.free_thresh >= about.occupied_thresh:
        raise ConfigError(f"{path}: free_thresh must be below occupied_thresh")
    grey = read_image(path.parent / about.image)
    _check_bounds(path, about, grey.shape)
    share = grey / 255 if about.negate else (255 - grey.astype(np.float64)) / 255
    cells = np.full(grey.shape, -1, np.int8)
    cells[share > about.occupied_thresh] = 100
    cells[share < about.free_thresh] = 0
    upwards = np.ascontiguousarray(cells[::-1])
    return SavedMap(upwards, about.resolution, about.origin[0], about.origin[1])


def _check_bounds(path: Path, about: MapYaml, shape: tuple[int, ...]) -> None:
    """Raise ConfigError for a map beyond the limits of a message."""
    height, width = shape
    if max(shape) > MAX_SIDE:
        raise ConfigError(
            f"{path}: image: {width} x {height} pixels; expected at most {MAX_SIDE} a side"
        )
    low = np.array(about.origin[:2])
    high = low + about.resolution * np.array((width, height))
    x, y = np.where(np.abs(low) > np.abs(high), low, high).tolist()
    if max(abs(x), abs(y)) > MAX_COORDINATE_M:
        raise ConfigError(
            f"{path}: origin: the map reaches to ({x:.0f}, {y:.0f}) m; expected within 100 km of "
            "(0, 0); shift a map in UTM, such as to 'origin: [0, 0, 0]'"
        )
