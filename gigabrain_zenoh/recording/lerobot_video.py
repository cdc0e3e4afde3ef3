"""Pictures and depth of a recording as the videos of a LeRobot dataset (format version 3.0).

Each frame of the dataset gets the newest picture that was exposed up to its tick. Without a new
picture, the last one is repeated, and counted. Colour is H.264. Depth is lossless HEVC, with 12
bits on a logarithmic scale, which lerobot 0.6 reads; unknown depth becomes the minimum, 1 cm.
"""

import math
import re
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from gigabrain_schemas.base import Message
from gigabrain_schemas.body import MAX_CAMERAS
from gigabrain_schemas.sensors import Image
from gigabrain_schemas.topics import DEPTH, IMAGE, STATE
from gigabrain_schemas.vision import DepthImage
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.recording.bag_reader import Bag
from gigabrain_zenoh.recording.message_tables import message_of
from gigabrain_zenoh.vision.pictures import check_jpeg

Frame = Any  # av.VideoFrame; PyAV is imported only if there are pictures
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
COLOUR_OPTIONS = {"g": "2", "bf": "0", "crf": "20"}  # every second picture is a key frame
DEPTH_OPTIONS = {"g": "2", "x265-params": "lossless=1:log-level=error"}
DEPTH_MAX_CODE = 4095
DEPTH_MIN_M, DEPTH_MAX_M, DEPTH_SHIFT_M = 0.01, 10.0, 3.5  # of lerobot's scale
RAW_FORMATS = {"rgb8": "rgb24", "bgr8": "bgr24", "mono8": "gray"}
CAMERA_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,31}")  # of our cameras; others are skipped
LIMITED_RANGE, BT601 = 1, 5  # of FFmpeg's AVColorRange and AVColorSpace
JPEG_END, JPEG_TAIL_BYTES = b"\xff\xd9", 64
SAMPLE_STEP = 4  # statistics use every fourth row and column ...
SAMPLE_EVERY = 10  # ... of every tenth picture


class VideoFeature(Struct, frozen=True, kw_only=True):
    """One video of the dataset."""

    key: str
    feature: dict[str, Any]  # for meta/info.json
    statistics: dict[str, Any]
    summary: str  # for people


def quantized(depth: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Return depth [mm] as codes of 12 bits on lerobot's logarithmic scale."""
    low, high = (math.log(end + DEPTH_SHIFT_M) for end in (DEPTH_MIN_M, DEPTH_MAX_M))
    share = (np.log(depth / 1000.0 + DEPTH_SHIFT_M) - low) / (high - low)
    return np.rint(share * DEPTH_MAX_CODE).clip(0, DEPTH_MAX_CODE).astype(np.uint16)


def dequantized(codes: NDArray[np.uint16]) -> NDArray[np.float64]:
    """Return codes as depth [m]. Inverse of `quantized`."""
    low, high = (math.log(end + DEPTH_SHIFT_M) for end in (DEPTH_MIN_M, DEPTH_MAX_M))
    return np.exp(codes / DEPTH_MAX_CODE * (high - low) + low) - DEPTH_SHIFT_M


def write_videos(
    path: Path, ticks: Sequence[tuple[int, int]], folder: Path, hz: int
) -> list[VideoFeature]:
    """Write a video for each camera of a recording; `ticks` has boot and tick of each frame.

    Raises ConfigError if there are pictures, but PyAV is missing.
    """
    tracks: dict[str, _Track] = {}
    numbers = _FrameNumbers(ticks)
    for key, message, boot, tick in _exposures(path):
        if not find_spec("av"):
            raise ConfigError("videos need PyAV: pip install 'gigabrain-zenoh[lerobot]'")
        if key not in tracks and len(tracks) >= 2 * MAX_CAMERAS:
            continue
        if key not in tracks:
            tracks[key] = _Track(key, numbers, folder / _file_of(key), hz)
        tracks[key].take(message, boot, tick)
    finished = [tracks[key].finish() for key in sorted(tracks)]
    return [each for each in finished if each]


def _file_of(key: str) -> str:
    return VIDEO_PATH.format(video_key=key, chunk_index=0, file_index=0)


def _exposures(path: Path) -> Iterator[tuple[str, Message, int, int]]:
    """Yield pictures and depth with the names of their features, and boot and tick of exposure."""
    boot = tick = 0  # of the newest state, for pictures without them
    for sample in Bag(path):
        if sample.key == STATE.key:
            boot, tick = sample.header.boot, sample.header.tick
        topic, _, camera = sample.key.rpartition("/")
        if topic not in (IMAGE.key, DEPTH.key) or not CAMERA_NAME.fullmatch(camera):
            continue
        message = message_of(sample)
        if message is not None:
            key = f"observation.images.{camera}{'_depth' if topic == DEPTH.key else ''}"
            exposure = message.basis or message.tick or tick
            yield key, message, message.boot or boot, exposure


class _FrameNumbers:
    """Finds the first frame of a dataset for an exposure."""

    def __init__(self, ticks: Sequence[tuple[int, int]]) -> None:
        self.count = len(ticks)
        self._first: dict[int, int] = {}  # by boot
        self._ticks: dict[int, list[int]] = {}
        for number, (boot, tick) in enumerate(ticks):
            self._first.setdefault(boot, number)
            self._ticks.setdefault(boot, []).append(tick)

    def at(self, boot: int, tick: int) -> int | None:
        """Return the number of the first frame from an exposure on; None for an unknown boot."""
        if boot not in self._first:
            return None
        return self._first[boot] + bisect_left(self._ticks[boot], tick)


class _Track:
    """The video of one camera while it is written."""

    def __init__(self, key: str, numbers: _FrameNumbers, path: Path, hz: int) -> None:
        self._key, self._numbers, self._path, self._hz = key, numbers, path, hz
        self._waiting: Message | None = None  # the newest picture, decoded when it is needed
        self._exposed = 0, -1  # its boot and tick
        self._frame: Frame = None
        self._video: _Video | None = None
        self._written = self._new = self._broken = 0

    def take(self, message: Message, boot: int, tick: int) -> None:
        """Keep the next picture, after writing the frames before it."""
        number = self._numbers.at(boot, tick)
        same_boot = self._exposed[0] == boot
        if number is None or (same_boot and tick < self._exposed[1]):
            return
        if self._waiting is not None or self._frame is not None:
            self._fill(number)
        self._waiting, self._exposed = message, (boot, tick)

    def finish(self) -> VideoFeature | None:
        """Write the rest of the frames; return None if no picture could be read."""
        self._fill(self._numbers.count)
        if self._video is None:
            return None
        self._video.close()
        repeated = self._written - self._new
        name = self._key.removeprefix("observation.images.")
        summary = f"{name}: {self._new} pictures, {repeated} frames repeat one"
        summary += f", {self._broken} were broken" if self._broken else ""
        return VideoFeature(
            key=self._key,
            feature=self._video.feature(),
            statistics=self._video.statistics(),
            summary=summary,
        )

    def _fill(self, end: int) -> None:
        while self._written < end:
            self._decode()
            if self._frame is None:
                return  # these frames get the first picture that can be read
            if self._video is None:
                self._video = _Video(self._path, self._frame, self._hz)
            self._video.write(self._frame, self._written)
            self._written += 1

    def _decode(self) -> None:
        message, self._waiting = self._waiting, None
        if message is None:
            return
        try:
            frame = _frame_of(message)
            if self._video and not self._video.fits(frame):
                raise ValueError("a picture of another size")
        except ValueError:
            self._broken += 1
            return
        self._frame, self._new = frame, self._new + 1
        if self._new % SAMPLE_EVERY == 1 and self._video:
            self._video.sample(frame)


def _frame_of(message: Message) -> Frame:
    """Return a picture in the encoder's format. Raises ValueError if it is broken."""
    import av

    if isinstance(message, DepthImage):
        return av.VideoFrame.from_ndarray(quantized(message.array()), format="gray12le")
    assert isinstance(message, Image)
    if message.encoding == "jpeg":
        frame = _from_jpeg(message)
    elif message.encoding in RAW_FORMATS:
        pixels = np.ascontiguousarray(message.array())
        frame = av.VideoFrame.from_ndarray(pixels, format=RAW_FORMATS[message.encoding])
    else:
        raise ValueError(f"{message.encoding} is not a colour picture")
    even = frame.width - frame.width % 2, frame.height - frame.height % 2
    # JPEG uses all 256 levels, but players expect the limited range (ITU-R BT.601)
    return frame.reformat(*even, format="yuv420p", dst_color_range=LIMITED_RANGE)


def _from_jpeg(image: Image) -> Frame:
    import av

    check_jpeg(image)
    if JPEG_END not in image.data[-JPEG_TAIL_BYTES:]:
        raise ValueError("a JPEG that is cut off")
    try:
        frames = av.CodecContext.create("mjpeg", "r").decode(av.Packet(image.data))
    except av.FFmpegError as error:
        raise ValueError(str(error)) from None
    if not frames:
        raise ValueError("a JPEG without a picture")
    return frames[0]


def _container(path: Path) -> Any:
    import av

    return av.open(str(path), "w")


class _Video:
    """An MP4 file, and the statistics of some of its pictures."""

    def __init__(self, path: Path, first: Frame, hz: int) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._is_depth, self._hz = first.format.name == "gray12le", hz
        self._container = _container(path)
        codec, options = ("hevc", DEPTH_OPTIONS) if self._is_depth else ("h264", COLOUR_OPTIONS)
        self._stream = self._container.add_stream(codec, rate=hz, options=options)
        self._stream.width, self._stream.height = first.width, first.height
        self._stream.pix_fmt = first.format.name
        if not self._is_depth:
            context = self._stream.codec_context
            context.color_range, context.colorspace = LIMITED_RANGE, BT601
        self._codec = codec
        self._samples: list[NDArray[Any]] = []  # minimum, maximum, mean, mean square; (4, channels)
        self._sampled = 0
        self.sample(first)

    def fits(self, frame: Frame) -> bool:
        """Return whether a frame has the size of the video."""
        return (frame.width, frame.height) == (self._stream.width, self._stream.height)

    def write(self, frame: Frame, number: int) -> None:
        """Append a frame."""
        frame.pts = number
        self._container.mux(self._stream.encode(frame))

    def close(self) -> None:
        """Write the frames that the encoder still holds, and the index."""
        self._container.mux(self._stream.encode())
        self._container.close()

    def sample(self, frame: Frame) -> None:
        """Add a picture to the statistics: colours from 0 to 1, depth in millimetres."""
        if self._is_depth:
            codes = frame.to_ndarray(format="gray12le")[::SAMPLE_STEP, ::SAMPLE_STEP]
            pixels: Any = 1000.0 * dequantized(codes)[..., None]
        else:
            pixels = frame.to_ndarray(format="rgb24")[::SAMPLE_STEP, ::SAMPLE_STEP] / 255.0
        flat = pixels.reshape(-1, pixels.shape[-1])
        self._samples.append(np.stack([flat.min(0), flat.max(0), flat.mean(0), (flat**2).mean(0)]))
        self._sampled += 1

    def feature(self) -> dict[str, Any]:
        """Return the description of the video for `meta/info.json`."""
        width, height = self._stream.width, self._stream.height
        channels = 1 if self._is_depth else 3
        info: dict[str, Any] = {
            "video.height": height,
            "video.width": width,
            "video.codec": self._codec,
            "video.pix_fmt": self._stream.pix_fmt,
            "video.fps": self._hz,
            "video.channels": channels,
            "has_audio": False,
            "is_depth_map": self._is_depth,
        }
        if self._is_depth:
            info |= {
                "video.depth_min": DEPTH_MIN_M,
                "video.depth_max": DEPTH_MAX_M,
                "video.shift": DEPTH_SHIFT_M,
                "video.use_log": True,
                "depth_unit": "mm",
            }
        names = ["height", "width", "channels"]
        return {"dtype": "video", "shape": [height, width, channels], "names": names, "info": info}

    def statistics(self) -> dict[str, Any]:
        """Return the statistics in the dataset's format, (channels, 1, 1) each."""
        minima, maxima, means, squares = np.stack(self._samples, axis=1)
        mean = means.mean(0)
        deviation = np.sqrt(np.maximum(squares.mean(0) - mean**2, 0.0))
        values = {"min": minima.min(0), "max": maxima.max(0), "mean": mean, "std": deviation}
        found = {name: value.reshape(-1, 1, 1).tolist() for name, value in values.items()}
        return found | {"count": [self._sampled]}
