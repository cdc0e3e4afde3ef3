"""Decodes pictures of messages, within limits: a small JPEG may claim a billion pixels."""

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.sensors import Image

MAX_PIXELS = 16_000_000
FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}  # markers with the size of a JPEG


def jpeg_size(data: bytes) -> tuple[int, int]:
    """Return width and height [px] by the header of a JPEG. Raises ValueError."""
    at = 2
    while data[:2] == b"\xff\xd8" and at + 9 <= len(data) and data[at] == 0xFF:
        marker, length = data[at + 1], struct.unpack_from(">H", data, at + 2)[0]
        if marker in FRAMES:
            height, width = struct.unpack_from(">HH", data, at + 5)
            return width, height
        at += 1 if marker == 0xFF else 2 + length
    raise ValueError("not a JPEG, or one without a size")


def check_jpeg(image: Image) -> None:
    """Raise ValueError for a JPEG that is too large, or of another size than its message says."""
    width, height = jpeg_size(image.data)
    if (width, height) != (image.width, image.height):
        raise ValueError(
            f"a JPEG of {width} x {height} pixels; its message says {image.width} x {image.height}"
        )
    if width * height > MAX_PIXELS:
        raise ValueError(f"a JPEG of {width} x {height} pixels; at most {MAX_PIXELS} are read")


def decoded(image: Image) -> NDArray[np.uint8]:
    """Return blue, green, red of a picture, (height, width, 3), or (height, width) for mono8.

    Raises ValueError for a picture that is broken, too large, or of another size than it claims.
    """
    if image.encoding == "jpeg":
        return _decompressed(image)
    pixels = image.array()
    if pixels.dtype != np.uint8:
        raise ValueError(f"{image.encoding} is not a colour picture")
    return np.ascontiguousarray(pixels[..., ::-1] if image.encoding == "rgb8" else pixels, np.uint8)


def _decompressed(image: Image) -> NDArray[np.uint8]:
    import cv2

    check_jpeg(image)
    pixels: Any = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR)
    if pixels is None:
        raise ValueError("a broken JPEG")
    return np.asarray(pixels, np.uint8)
