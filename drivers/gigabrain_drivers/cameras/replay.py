"""A camera that plays back a recording (`gigabrain record`) at the recorded pace."""

import logging
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from gigabrain_drivers.cameras.base import (
    CameraLost,
    CameraOptions,
    CameraSite,
    CameraSource,
    Frame,
)
from gigabrain_drivers.cameras.opencv import fitted
from gigabrain_schemas.body import Camera
from gigabrain_schemas.sensors import Image
from gigabrain_schemas.topics import DEPTH, IMAGE
from gigabrain_schemas.vision import DepthImage
from gigabrain_zenoh.codec import Codec
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import expanded
from gigabrain_zenoh.logs import QuietFault
from gigabrain_zenoh.recording.bag_reader import samples
from gigabrain_zenoh.vision.pictures import decoded

log = logging.getLogger(__name__)
MAX_WAIT_S = 1.0  # between two pictures; longer gaps in a recording are shortened


class ReplayOptions(CameraOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The file of the recording, and the camera in it."""

    file: str  # relative to the robot's file
    camera: str = ""  # name in the recording; empty: the same name


class Recorded(NamedTuple):
    """The recorded messages of one exposure."""

    stamp_ns: int
    picture: Image | None
    depth: DepthImage | None


class ReplayedCamera(CameraSource):
    """Pictures and depth from a recording; broken depth is left out. Needs the extra `record`."""

    Options = ReplayOptions
    options: ReplayOptions

    _exposures: Iterator[Recorded] | None = None
    _ended = False
    _last: tuple[int, float] | None = None  # newest exposure: stamp [ns], time of return [s]

    def __init__(self, options: Any, camera: Camera, site: CameraSite) -> None:
        super().__init__(options, camera, site)
        self._depth_fault = QuietFault(log)

    def open(self) -> None:
        """Open the recording at its start. Raises CameraLost after the end, without `repeat`.

        Raises ConfigError if `~` has no home folder.
        """
        if self._ended:
            raise CameraLost(f"{self.options.file} has ended")
        path = Path(self.site.folder) / expanded(self.options.file)
        self._exposures = recorded(path, self.options.camera or self.camera.name)
        self._last = None

    def read(self) -> Frame:
        """Wait until the next valid exposure is due, and return it. Raises CameraLost."""
        if self._exposures is None:
            raise CameraLost("the recording is not open")
        broken = ""
        try:
            for one in self._exposures:
                try:
                    frame = self._frame(one)
                except ValueError as error:
                    broken = str(error)
                    continue
                self._wait(one.stamp_ns)
                return frame
        except ConfigError as error:
            raise CameraLost(str(error)) from None
        if self.options.repeat and self._last:
            time.sleep(1 / self.camera.rate_hz)
            self.open()
            return self.read()
        self._ended = bool(self._last)
        end = "has ended" if self._ended else f"has none: {broken}" if broken else "has none"
        raise CameraLost(f"{self.options.file} {end}")

    def close(self) -> None:
        """Close the recording."""
        self._exposures = None

    def _wait(self, stamp_ns: int) -> None:
        """Wait as long as the recorded camera did, at most MAX_WAIT_S."""
        now_s = time.monotonic()
        if self._last:
            before_ns, given_s = self._last
            pause_s = min(max((stamp_ns - before_ns) / 1e9, 0.0), MAX_WAIT_S)
            time.sleep(max(0.0, given_s + pause_s - now_s))
            now_s = max(now_s, given_s + pause_s)
        self._last = stamp_ns, now_s

    def _frame(self, one: Recorded) -> Frame:
        """Decode an exposure; a picture with broken depth comes without it.

        Raises ValueError if nothing is whole, and CameraLost for another size.
        """
        camera = self.camera
        picture = None if one.picture is None else decoded(one.picture)
        if picture is not None:
            picture = fitted(picture, camera.width, camera.height)
        if one.depth is None or not camera.depth:
            return Frame(picture)
        about, now_ns = f"camera {camera.name}: depth in {self.options.file}", time.monotonic_ns()
        try:
            depth = one.depth.array()
        except ValueError as error:
            if picture is None:
                raise
            self._depth_fault.begin(f"{about} is broken and left out: {error}", now_ns)
            return Frame(picture)
        self._depth_fault.end(f"{about} is whole again", now_ns)
        return Frame(picture, depth)


def recorded(path: Path, name: str) -> Iterator[Recorded]:
    """Yield the exposures of a camera in a recording. Raises ConfigError.

    A picture and a depth picture of the same tick form one exposure.
    """
    keys: dict[str, Codec[Any]] = {
        topic.at(name): Codec(topic.type, topic.max_bytes) for topic in (IMAGE, DEPTH)
    }
    waiting: dict[type, Any] = {}
    basis = -1
    for sample in samples(path):
        if sample.key not in keys:
            continue
        try:
            message = keys[sample.key].decode(sample.payload)
        except ValueError:  # a damaged message
            continue
        if message.basis != basis and waiting:
            yield _one_exposure(waiting)
            waiting = {}
        basis = message.basis
        waiting[type(message)] = message
    if waiting:
        yield _one_exposure(waiting)


def _one_exposure(messages: dict[type, Any]) -> Recorded:
    picture, depth = messages.get(Image), messages.get(DepthImage)
    stamp_ns = max(one.stamp_ns for one in messages.values())
    return Recorded(stamp_ns, picture, depth)
