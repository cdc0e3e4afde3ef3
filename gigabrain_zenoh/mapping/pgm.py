"""Images of maps: binary PGM files."""

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import read_bounded

MOST_CELLS = 8_000_000  # what a message may carry
MOST_HEADER = 100_000  # bytes, with all its comments
GAP = rb"(?:\s|#[^\n]*\n)+"  # white space and comments
HEADER = re.compile(rb"P5" + (GAP + rb"(\d{1,9})") * 3 + rb"\s")


def read(file: Path) -> NDArray[np.uint8]:
    """The grey values of a file (height, width), the top row first. Raises ConfigError."""
    try:
        data = read_bounded(file, MOST_CELLS + MOST_HEADER)
    except OSError as error:
        raise ConfigError(f"{file}: the map's image: {error.strerror}") from None
    header = HEADER.match(data)
    if header is None:
        raise ConfigError(f"{file}: no binary PGM; expected a header such as 'P5 640 480 255'")
    width, height, most = (int(number) for number in header.groups())
    if most != 255:
        raise ConfigError(f"{file}: a maxval of {most}; expected 255")
    if not 0 < width * height <= MOST_CELLS:
        raise ConfigError(f"{file}: {width} x {height} pixels; expected 1 to {MOST_CELLS} in all")
    there = len(data) - header.end()
    if there != width * height:
        what = "cut" if there < width * height else "of another size"
        raise ConfigError(f"{file}: {what}: {there} of {width} x {height} pixels are there")
    return np.frombuffer(data, np.uint8, offset=header.end()).reshape(height, width)
