"""One camera on the bus: checks, packs and publishes its exposures, or withholds them."""

import logging
from collections.abc import Callable
from typing import Any, NamedTuple

import cv2

from gigabrain_drivers.cameras.base import CameraOptions, Frame
from gigabrain_schemas.base import Cause
from gigabrain_schemas.body import Camera
from gigabrain_schemas.sensors import Image
from gigabrain_schemas.topics import CAMERA, DEPTH, IMAGE
from gigabrain_schemas.vision import MAX_PLANE_BYTES, CameraInfo, DepthImage, pack_depth
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.logs import Fault
from gigabrain_zenoh.vision import camera_health
from gigabrain_zenoh.vision.camera_health import CameraHealth

log = logging.getLogger(__name__)
CHECK_PERIOD_NS = 50_000_000  # between two checks of a camera's health
INFO_CHECKS = 20  # checks between two messages about a camera without changes
STARTUP_NS = 5_000_000_000  # a silent camera counts as starting for this long
REMEDIES = {
    camera_health.COVERED: "uncover the lens, or clean it",
    camera_health.DARK: "uncover the lens, or switch a light on",
    camera_health.UNDEREXPOSED: "switch a light on, or set the camera's exposure",
    camera_health.OVEREXPOSED: "turn it away from the light, or set the camera's exposure",
}
HEADER_BYTES = 1024  # reserved in a message for all but its pixels
RECONNECT = "check its cable, or connect it again"
CHECK_SOURCE = "check its source in the robot's file, then its cable"


class Packed(NamedTuple):
    """An exposure with its messages."""

    frame: Frame
    picture: Image | None
    depth: DepthImage | None
    problem: str = ""  # why it cannot be published


class CameraOutput:
    """Publishes a camera's exposures. `pack` may run in any thread, the rest on the loop's."""

    def __init__(
        self,
        camera: Camera,
        options: CameraOptions,
        bus: Bus,
        now_s: Callable[[], float],
        *,
        repeats: bool = False,
    ) -> None:
        self.camera, self._options, self._bus, self._now_s = camera, options, bus, now_s
        self._repeats = repeats
        self._health = CameraHealth(camera, repeats=repeats)
        self._lost, self._problem = "", camera_health.SILENT
        self._fault, self._began_ns, self._checks = Fault(log), bus.clock.now_ns(), 0
        self.exposures = 0  # received, published or not

    def pack(self, frame: Frame) -> Packed:
        """Compress an exposure."""
        camera = self.camera
        size = camera.height, camera.width
        for pixels in (frame.picture, frame.depth):
            if pixels is not None and pixels.shape[:2] != size:
                height, width = pixels.shape[:2]
                text = f"pictures of {width} x {height} pixels; the body's file says "
                return Packed(frame, None, None, f"{text}{camera.width} x {camera.height}")
        about: dict[str, Any] = {
            "frame_id": camera.name,
            "height": camera.height,
            "width": camera.width,
        }
        picture = depth = None
        if frame.depth is not None:
            depth = DepthImage(**about, planes=pack_depth(frame.depth))
        if frame.picture is not None and self._options.encoding == "jpeg":
            quality = (cv2.IMWRITE_JPEG_QUALITY, self._options.quality)
            data = cv2.imencode(".jpg", frame.picture, quality)[1].tobytes()
            picture = Image(**about, encoding="jpeg", data=data)
        elif frame.picture is not None:
            picture = Image(**about, encoding="bgr8", data=frame.picture.tobytes())
        return Packed(frame, picture, depth, _too_large(picture, depth))

    def put(self, packed: Packed) -> None:
        """Check an exposure, and publish it if the camera is healthy."""
        self.exposures += 1
        bus, frame, name = self._bus, packed.frame, self.camera.name
        self._lost = packed.problem
        tick = frame.tick or bus.time.tick
        stamp_ns = frame.stamp_ns or bus.clock.unix_ns()
        usable = self._health.take(self._now_s(), frame.picture, frame.depth)
        self._check()
        if not usable or self._problem or packed.problem:
            bus.counters[f"{name}_withheld"] += 1
            bus.publish(CAMERA, self._info(), basis=tick, name=name)
            return
        header: dict[str, Any] = {"basis": tick, "tick": tick, "stamp_ns": stamp_ns, "name": name}
        if packed.depth:
            bus.publish(DEPTH, packed.depth, **header)
        if packed.picture:
            bus.publish(IMAGE, packed.picture, **header)

    def lose(self, problem: str) -> None:
        """Note why there are no pictures, and restart the health check."""
        self.restart()
        self._lost = problem
        self._check()

    def restart(self) -> None:
        """Restart the health check, because the robot's time starts again."""
        self._health = CameraHealth(self.camera, repeats=self._repeats)

    def look(self) -> None:
        """Check the camera's health; publish it once a second, and when it changes."""
        self._checks += 1
        if not self._check() and self._checks % INFO_CHECKS == 1:
            self._bus.publish(CAMERA, self._info(), name=self.camera.name)

    @property
    def cause(self) -> Cause | None:
        """Return the camera's problem for the process's health."""
        if not self._problem:
            return None
        text = f"camera {self.camera.name}: {self._problem}"[:500]
        remedy = CHECK_SOURCE if self._lost else REMEDIES.get(self._problem, RECONNECT)
        return Cause(code="camera", text=text, remedy=remedy)

    def _check(self) -> bool:
        """Check for a problem; publish it and return True if it has changed."""
        before, problem = self._problem, self._health.problem(self._now_s())
        self._problem = problem = self._lost or problem
        name = self.camera.name
        starting = not self.exposures and self._bus.clock.now_ns() - self._began_ns < STARTUP_NS
        if problem and not starting:
            if problem != before and self._fault.active:
                self._fault.end(f"camera {name}: no longer {before}")
            if not self._fault.active:
                self._fault.begin(f"camera {name} is taken for blind: {problem}")
        elif not problem:
            self._fault.end(f"camera {name} sees again")
        if problem == before:
            return False
        self._bus.publish(CAMERA, self._info(), name=name)
        return True

    def _info(self) -> CameraInfo:
        source = self._options.source[:32]
        return CameraInfo(camera=self.camera, source=source, problem=self._problem[:500])


def _too_large(picture: Image | None, depth: DepthImage | None) -> str:
    """Return which message, or part of it, is larger than readers accept; empty if none is."""
    planes = [len(plane) for plane in depth.planes] if depth else [0]
    sizes = (
        ("a picture", len(picture.data) if picture else 0, IMAGE.max_bytes),
        ("a depth picture", sum(planes), DEPTH.max_bytes),
        ("a plane of depth", max(planes), MAX_PLANE_BYTES),
    )
    for what, size, limit in sizes:
        if size > limit - HEADER_BYTES:
            return f"{what} of {size / 1e6:.1f} MB; at most {limit / 1e6:.1f} MB are sent"
    return ""
