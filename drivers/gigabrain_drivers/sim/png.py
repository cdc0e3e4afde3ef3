"""PNG images: encodes pixels, and decodes files with MuJoCo after a check of their size."""

import struct
import zlib

import mujoco
import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.errors import ConfigError

SIGNATURE = b"\x89PNG\r\n\x1a\n"
SAMPLES = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # of a pixel, by the header's colour type


def png(pixels: NDArray[np.uint8]) -> bytes:
    """Return an image (height, width, 3) as a PNG file, with rows as differences."""
    height, width, _ = pixels.shape
    rows = pixels.reshape(height, width * 3)
    above = np.vstack([np.zeros_like(rows[:1]), rows[:-1]])
    filtered = np.hstack([np.full((height, 1), 2, np.uint8), rows - above])  # 2: the filter "up"
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)  # 8 bits of red, green, blue
    chunks = (
        (b"IHDR", header),
        (b"IDAT", zlib.compress(filtered.tobytes(), 9)),
        (b"IEND", b""),
    )
    return SIGNATURE + b"".join(_chunk(kind, content) for kind, content in chunks)


def _chunk(kind: bytes, content: bytes) -> bytes:
    check = struct.pack(">I", zlib.crc32(kind + content))
    return struct.pack(">I", len(content)) + kind + content + check


def read_png(data: bytes, source: str, max_pixels: int) -> NDArray[np.uint8]:
    """Return the grey values (height, width) of a PNG, the top row first.

    Colours are averaged, transparency is ignored. Raises ConfigError, which names `source`.
    """
    try:
        _check_size(data, max_pixels)
        spec = mujoco.MjSpec()
        spec.add_texture(name="map", type=mujoco.mjtTexture.mjTEXTURE_2D, file="map.png")
        spec.assets = {"map.png": data}
        model = spec.compile()
    except (ValueError, struct.error, zlib.error) as error:
        text = " ".join(str(error).split())[:120]
        raise ConfigError(f"{source}: not a PNG image that can be read: {text}") from None
    shape = int(model.tex_height[0]), int(model.tex_width[0]), int(model.tex_nchannel[0])
    return np.asarray(model.tex_data.reshape(shape).mean(axis=2).round(), np.uint8)


def _check_size(data: bytes, max_pixels: int) -> None:
    """Raise ValueError for too many pixels, in the header or in the compressed data."""
    chunks: dict[bytes, list[bytes]] = {b"IHDR": [], b"IDAT": []}
    at = len(SIGNATURE)
    while at + 8 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        if kind in chunks:
            chunks[kind].append(data[at + 8 : at + 8 + length])
        at += length + 12
    width, height, bits, colour = struct.unpack_from(">IIBB", b"".join(chunks[b"IHDR"]))
    if not 0 < width * height <= max_pixels:
        raise ValueError(f"{width} x {height} pixels; expected 1 to {max_pixels} in all")
    row = (width * SAMPLES.get(colour, 4) * bits + 7) // 8 + 1
    max_bytes = 2 * height * row + 64  # interlaced images have more, shorter rows
    stream = zlib.decompressobj()
    if len(stream.decompress(b"".join(chunks[b"IDAT"]), max_bytes + 1)) > max_bytes:
        raise ValueError(f"it unpacks to more than its {width} x {height} pixels")
