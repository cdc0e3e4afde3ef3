"""Data of cameras: depth pictures, models and mounting poses. Pictures are `sensors.Image`."""

import zlib
from typing import TYPE_CHECKING, Annotated

from msgspec import Meta

from gigabrain_schemas.base import Message, Name, Text
from gigabrain_schemas.body import Camera, CameraName, Side

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

MAX_PLANE_BYTES = 256 * 1024
Plane = Annotated[bytes, Meta(max_length=MAX_PLANE_BYTES)]


class DepthImage(Message, frozen=True, kw_only=True):
    """The depth of each pixel along the camera's axis [mm]; 0 is unknown. Compressed without loss.

    It has four planes, each with one pixel of every block of two by two pixels, in the order of
    rows. So the first plane is the picture at half its width and height, and is quicker to decode.
    A plane is uint16 by row, compressed by zlib.
    """

    frame_id: Name
    height: Side  # [px]
    width: Side  # [px]
    planes: tuple[Plane, Plane, Plane, Plane]

    def quarter(self) -> "NDArray[np.uint16]":
        """Return the first plane [mm], (height / 2, width / 2). Raises ValueError if broken."""
        return _unpacked(self.planes[0], self.height // 2, self.width // 2)

    def array(self) -> "NDArray[np.uint16]":
        """Return all pixels [mm], (height, width). Raises ValueError if a plane is broken."""
        import numpy as np

        pixels = np.empty((self.height, self.width), np.uint16)
        for number, plane in enumerate(self.planes):
            row, column = divmod(number, 2)
            pixels[row::2, column::2] = _unpacked(plane, self.height // 2, self.width // 2)
        return pixels


def pack_depth(depth: "NDArray[np.uint16]") -> tuple[bytes, bytes, bytes, bytes]:
    """Return the planes of a DepthImage for `depth` [mm], (height, width), both even."""
    one, two, three, four = (
        zlib.compress(depth[row::2, column::2].astype("<u2").tobytes(), 1)
        for row in (0, 1)
        for column in (0, 1)
    )
    return one, two, three, four


def _unpacked(data: bytes, height: int, width: int) -> "NDArray[np.uint16]":
    import numpy as np

    size = 2 * height * width
    unpacker = zlib.decompressobj()
    try:
        plain = unpacker.decompress(data, size + 1)  # limited, against zip bombs
    except zlib.error as error:
        raise ValueError(f"a plane of depth cannot be unpacked: {error}") from None
    if len(plain) != size or not unpacker.eof:
        raise ValueError(f"a plane of depth needs {size} bytes, got {len(plain)}")
    return np.frombuffer(plain, "<u2").reshape(height, width)


class CameraInfo(Message, frozen=True, kw_only=True):
    """The model and mounting pose of a camera. The last value is kept for late joiners."""

    camera: Camera
    source: CameraName = "mujoco"  # source of its pictures
    problem: Text = ""  # why it has no pictures now: covered, frozen, no picture
