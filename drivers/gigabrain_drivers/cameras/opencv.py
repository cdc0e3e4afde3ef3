"""Cameras through OpenCV: USB (v4l2), network streams (RTSP, HTTP), and video files."""

import math
import os
import re
import socket
import stat
import sys
import time
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import urlsplit

import cv2
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from gigabrain_drivers.cameras.base import CameraLost, CameraOptions, CameraSource, Frame, Picture
from gigabrain_zenoh.host.files import expanded
from gigabrain_zenoh.host.network import host_shown

TIMEOUT_MS = 3000  # for opening a stream, and for reading from it
ASPECT_TOLERANCE = 0.01  # relative difference of the aspect ratios of two pictures
MAX_PIXELS = 16_000_000  # of a picture before scaling
MAX_BROKEN = 1000  # after this many broken pictures in a row, a film has ended
MAX_LIVE_BROKEN = 3  # after this many in a row, a device or a stream is lost
SLOW_READ_S = 1.0  # a failed read of a device or a stream that takes longer has timed out
BUSY = "; check that nothing else uses it, and that this user is in the group 'video'"
# port of a stream, and a request that a server answers whatever it streams; one that expects TLS
# answers it with an error
QUESTIONS = {
    "rtsp": (554, b"OPTIONS * RTSP/1.0\r\nCSeq: 1\r\n\r\n"),
    "rtsps": (322, b"OPTIONS * RTSP/1.0\r\nCSeq: 1\r\n\r\n"),
    "http": (80, b"HEAD / HTTP/1.0\r\n\r\n"),
    "https": (443, b"HEAD / HTTP/1.0\r\n\r\n"),
}


class OpenCvOptions(CameraOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Fields of a camera that OpenCV opens."""

    device: Annotated[str, Meta(min_length=1)]
    # /dev/video0, /dev/v4l/by-id/..., 0, rtsp://..., http://..., or a file beside the robot's file


class OpenCvCamera(CameraSource):
    """A camera without depth, read by cv2.VideoCapture. Pictures of other sizes are scaled."""

    Options = OpenCvOptions
    options: OpenCvOptions
    gives_depth = False

    _capture: cv2.VideoCapture | None = None
    _file = False  # the device is a video file
    _ended = False  # a file without `repeat` has ended
    _due_s = 0.0  # time of a file's next picture
    _reads = 0  # pictures read since a file's start, including broken ones

    def open(self) -> None:
        """Open the device. Raises CameraLost, and ConfigError if `~` has no home folder."""
        if self._ended:
            raise CameraLost(f"{self._shown} has ended")
        target, backend = self._target()
        timeouts = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, TIMEOUT_MS]
        timeouts += [cv2.CAP_PROP_READ_TIMEOUT_MSEC, TIMEOUT_MS]
        network = backend == cv2.CAP_FFMPEG
        device = not self._file and not network
        if network and (problem := _unanswered(self.options.device)):
            raise CameraLost(f"{self._shown} {problem}")
        capture = cv2.VideoCapture(target, backend, timeouts if network else [])
        self._capture, self._due_s, self._reads = capture, time.monotonic(), 0
        if not capture.isOpened():
            raise CameraLost(f"{self._shown} cannot be opened{BUSY if device else ''}")
        if device:
            capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # prefer no picture to an old one
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, self.camera.width)
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, self.camera.height)
            capture.set(cv2.CAP_PROP_FPS, self.camera.rate_hz)

    def read(self) -> Frame:
        """Return the next picture. Raises CameraLost."""
        capture = self._capture
        if capture is None:
            raise CameraLost(f"{self._shown} is not open")
        if self._file:
            now_s = time.monotonic()
            self._due_s = max(self._due_s + 1 / self.camera.rate_hz, now_s)
            time.sleep(self._due_s - now_s)
        picture = self._next(capture)
        if picture is None and self._file and self.options.repeat:
            capture.set(cv2.CAP_PROP_POS_FRAMES, 0)
            self._reads = 0
            picture = self._next(capture)
        if picture is None:
            self._ended = self._file and not self.options.repeat  # some files cannot be rewound
            end = "has ended" if self._file else "gives no picture"
            raise CameraLost(f"{self._shown} {end}")
        return Frame(fitted(picture, self.camera.width, self.camera.height))

    def close(self) -> None:
        """Free the device."""
        capture, self._capture = self._capture, None
        if capture:
            capture.release()

    @property
    def _shown(self) -> str:
        """Return the device for messages, without the user and password of an address."""
        return re.sub(r"^.*:.*@", "…@", host_shown(self.options.device))  # also without ://

    def _next(self, capture: cv2.VideoCapture) -> NDArray[Any] | None:
        """Return the next picture, or None; broken pictures are skipped."""
        count = capture.get(cv2.CAP_PROP_FRAME_COUNT) if self._file else 0
        for _ in range(MAX_BROKEN if self._file else MAX_LIVE_BROKEN):
            began_s = time.monotonic()
            ok, picture = capture.read()
            self._reads += 1
            if ok:
                return np.asarray(picture)
            took_s = time.monotonic() - began_s
            if self._reads >= count if self._file else took_s > SLOW_READ_S:
                break
        return None

    def _target(self) -> tuple[int | str, int]:
        """Return what OpenCV opens, and by which backend. Raises CameraLost."""
        device, linux = self.options.device, sys.platform == "linux"
        if "://" in device:
            return device, cv2.CAP_FFMPEG  # others have no timeouts, and print the address
        if device.isdecimal() and not linux:
            return int(device), cv2.CAP_ANY
        path = Path(f"/dev/video{int(device)}") if device.isdecimal() else expanded(device)
        path = self.site.folder / path
        try:
            mode = path.stat().st_mode
        except (FileNotFoundError, ValueError):  # ValueError: a null character
            raise CameraLost(f"{self._shown} is not there") from None
        except OSError as error:
            raise CameraLost(f"{self._shown} cannot be opened: {error.strerror}") from None
        self._file = stat.S_ISREG(mode)
        if not self._file and not stat.S_ISCHR(mode):  # opening a pipe would block all others
            raise CameraLost(f"{self._shown} is no camera and no file")
        return str(path), cv2.CAP_V4L2 if linux and not self._file else cv2.CAP_ANY


def _unanswered(address: str) -> str:
    """Return why a stream's server does not answer within TIMEOUT_MS; empty if it does.

    FFmpeg opens one stream at a time in a process. Without this check, a silent one would keep the
    other cameras from opening. Also return an empty text where this cannot be checked.
    """
    try:
        url = urlsplit(address)
        host, port = url.hostname, url.port
    except ValueError:
        return ""
    default, question = QUESTIONS.get(url.scheme, (0, b""))
    by_proxy = url.scheme.startswith("http") and os.environ.get("http_proxy")
    if not host or not question or by_proxy:
        return ""
    try:
        server = socket.create_connection((host, port or default), TIMEOUT_MS / 1e3)
    except TimeoutError:
        return "does not answer"
    except (OSError, UnicodeError):
        return "cannot be opened"
    with server:
        try:
            server.sendall(question)
            server.recv(1)
        except TimeoutError:
            return "does not answer"
        except OSError:  # it closed the connection, which is an answer
            pass
    return ""


def fitted(picture: NDArray[Any], width: int, height: int) -> Picture:
    """Return a picture in the size of the body's file, in colour. Raises CameraLost."""
    tall, wide = picture.shape[:2]
    channels = picture.shape[2] if picture.ndim == 3 else 1
    if picture.dtype != np.uint8 or channels not in (1, 3) or not 0 < tall * wide <= MAX_PIXELS:
        kind = f"{channels} channels of {picture.dtype}"
        raise CameraLost(
            f"gives pictures of {wide} x {tall} pixels, {kind}; expected 1 or 3 of uint8"
        )
    if channels == 1:
        picture = np.asarray(cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR), np.uint8)
    if (wide, tall) == (width, height):
        return np.asarray(picture, np.uint8)
    if not math.isclose(wide / tall, width / height, rel_tol=ASPECT_TOLERANCE):
        raise CameraLost(
            f"gives pictures of {wide} x {tall} pixels; the body's file says {width} x {height}"
        )
    return np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
