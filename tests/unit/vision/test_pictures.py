import struct
from typing import Any

import cv2
import numpy as np
import pytest

from gigabrain_schemas.sensors import Image
from gigabrain_zenoh.vision.pictures import decoded, jpeg_size

GREY = np.random.default_rng(0).integers(0, 255, (3, 4, 3), np.uint8).repeat(16, 0).repeat(16, 1)
JPEG = bytes(cv2.imencode(".jpg", GREY)[1].tobytes())


def image(data: bytes, encoding: Any = "jpeg", width: int = 64, height: int = 48) -> Image:
    return Image(frame_id="front", encoding=encoding, width=width, height=height, data=data)


def claiming(width: int, height: int) -> bytes:
    """The JPEG with another size in its header."""
    at = JPEG.index(b"\xff\xc0") + 5
    return JPEG[:at] + struct.pack(">HH", height, width) + JPEG[at + 4 :]


def test_pictures_become_arrays_in_blue_green_and_red() -> None:
    assert jpeg_size(JPEG) == (64, 48)
    assert np.abs(decoded(image(JPEG)).astype(int) - GREY).mean() < 20
    assert (decoded(image(GREY.tobytes(), "bgr8")) == GREY).all()
    assert (decoded(image(GREY[..., ::-1].tobytes(), "rgb8")) == GREY).all()
    assert decoded(image(GREY[..., 0].tobytes(), "mono8")).shape == (48, 64)


@pytest.mark.parametrize(
    ("broken", "error"),
    [
        (image(b"\xff\xd8"), "not a JPEG"),
        (image(bytes(1000)), "not a JPEG"),
        (image(b"\xff\xd8" + b"\xff" * 1000), "not a JPEG"),
        (image(JPEG, width=66), "64 x 48 pixels; its message says 66 x 48"),
        (image(claiming(60000, 60000)), "its message says"),
        (image(claiming(16000, 16000), width=16000, height=16000), "at most 16000000 are read"),
        (image(bytes(2 * 64 * 48), "depth16"), "depth16 is not a colour picture"),
    ],
)
def test_a_broken_or_enormous_picture_is_refused_before_it_is_unpacked(
    broken: Image, error: str
) -> None:
    with pytest.raises(ValueError, match=error):
        decoded(broken)


def test_any_cut_of_a_jpeg_is_a_picture_or_a_value_error() -> None:
    for end in range(0, len(JPEG), 7):
        try:
            pixels = decoded(image(JPEG[:end] or b"\0"))
        except ValueError:
            continue
        assert pixels.shape == (48, 64, 3)
