"""Cameras for browsers: each browser gets the newest picture after it has shown the last.

So a slow browser gets fewer pictures, and no picture waits in the network. Pictures are received
from the bus only while a browser has the panel open.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Any

from msgspec import Meta, Struct

from gigabrain_schemas.base import Name
from gigabrain_schemas.brain import Contour, Objects, WorldModel
from gigabrain_schemas.objects import Detections
from gigabrain_schemas.sensors import Image
from gigabrain_schemas.topics import CAMERA, DETECTIONS, IMAGE, PERCEIVED
from gigabrain_schemas.vision import CameraInfo
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.host.bounded import put_newest
from gigabrain_zenoh.ui.camera_feed import CameraFeed
from gigabrain_zenoh.ui.page import frames

MIN_PICTURE_INTERVAL_NS = 190_000_000  # of a camera, for one browser
SHOWN_TIMEOUT_NS = 3_000_000_000  # a picture counts as lost after this time
MAX_PAIRED_TICKS = 25  # between pictures with detections, to show only these
RESTART_TICKS = 50  # a picture so much older means that the robot's clock has restarted
MAX_NAMES = 16  # of cameras and perceptors


class Watch(Struct, frozen=True, forbid_unknown_fields=True):
    """Frame of a browser: the pictures that it wants."""

    open: bool = False  # its panel of cameras
    folded: Annotated[tuple[Name, ...], Meta(max_length=MAX_NAMES)] = ()  # cameras without pictures


class Shown(Struct, frozen=True, forbid_unknown_fields=True):
    """Frame of a browser: it has shown a camera's picture, and can receive the next one."""

    camera: Name


class PicturePace:
    """Paces the pictures of one browser: it gets the next one after it has shown the last one."""

    def __init__(self) -> None:
        self.watch = Watch()
        self._waiting: set[str] = set()  # cameras whose last picture it has not shown yet
        self._sent: dict[str, tuple[int, int]] = {}  # number and time of the last picture

    def set_watch(self, watch: Watch) -> None:
        """Set the wanted pictures, and forget those sent before."""
        self.watch = watch
        self._waiting.clear()
        self._sent.clear()

    def shown(self, camera: str) -> None:
        """Store that the browser has shown a camera's last picture."""
        self._waiting.discard(camera)

    def wants(self, camera: str) -> bool:
        """Return whether the browser wants a camera's pictures."""
        return self.watch.open and camera not in self.watch.folded

    def is_ready(self, camera: str, now_ns: int) -> bool:
        """Return whether a new picture of a camera may be sent."""
        since_ns = now_ns - self._sent.get(camera, (0, -MIN_PICTURE_INTERVAL_NS))[1]
        waiting = camera in self._waiting and since_ns < SHOWN_TIMEOUT_NS
        return self.wants(camera) and not waiting and since_ns >= MIN_PICTURE_INTERVAL_NS

    def take(self, camera: str, number: int, now_ns: int) -> bool:
        """Store that a picture is sent; return False if it was sent before."""
        if self._sent.get(camera, (0, 0))[0] == number:
            return False
        put_newest(self._sent, camera, (number, now_ns), MAX_NAMES)
        self._waiting.add(camera)
        return True


class CameraFrames:
    """Frames of cameras: pictures and detections for browsers that watch, problems for all.

    `send` passes a frame and its slot to all viewers.
    """

    def __init__(self, bus: Bus, send: Callable[[str, bytes], None]) -> None:
        self._send = send
        self._feed = CameraFeed(bus, IMAGE, DETECTIONS)
        self._newest: dict[str, tuple[int, bytes]] = {}  # number and frame, by camera
        self._polled: dict[str, Image] = {}  # the newest picture, by camera
        self._shown: dict[str, int] = {}  # tick of the last picture sent, by camera
        self._recognised: dict[str, tuple[int, int]] = {}  # ticks of the last two detections
        self._found: dict[str, bytes] = {}  # frame of the newest detections, by camera
        self._problems: dict[str, tuple[str, str]] = {}  # of the camera, and of its picture
        self._kept: dict[str, bytes] = {}
        bus.subscribe(CAMERA, self._on_info)

    def kept_frames(self) -> Iterator[tuple[str, bytes]]:
        """Yield the frames of the cameras' problems, for a new viewer."""
        yield from self._kept.items()

    def new_frames(
        self, paces: Sequence[PicturePace], now_ns: int
    ) -> Iterator[tuple[PicturePace, str, bytes]]:
        """Yield the frames that are due, with the pace of the browser they are for."""
        watching = [pace for pace in paces if pace.watch.open]
        self._feed.watch(bool(watching))
        if not watching:
            for held in (self._newest, self._found, self._recognised, self._polled, self._shown):
                held.clear()
            return
        new = [self._add(found) for found in self._feed.new_detections()]
        for camera in self._feed.names(IMAGE):
            ready = [pace for pace in watching if pace.is_ready(camera, now_ns)]
            number, frame = self._picture(camera) if ready else (0, b"")
            for pace in ready:
                if number and pace.take(camera, number, now_ns):
                    yield pace, f"image/{camera}", frame
                    if self._is_paired(camera):
                        yield pace, f"found/{camera}", self._found[camera]
        for camera in new:
            if not self._is_paired(camera):
                for pace in watching:
                    if pace.wants(camera):
                        yield pace, f"found/{camera}", self._found[camera]

    def _add(self, found: Detections) -> str:
        """Keep new detections; return their camera."""
        camera, (_, last) = found.camera, self._recognised.get(found.camera, (0, 0))
        put_newest(self._recognised, camera, (last, found.basis), MAX_NAMES)
        frame = frames.as_json(frames.FOUND, _overlay_of(found))
        put_newest(self._found, camera, frame, MAX_NAMES)
        return camera

    def _is_paired(self, camera: str) -> bool:
        """Return whether things are recognised often enough to show only those pictures."""
        before, last = self._recognised.get(camera, (0, 0))
        newest = self._polled.get(camera)
        often = 0 < last - before <= MAX_PAIRED_TICKS
        return often and newest is not None and newest.basis - last <= MAX_PAIRED_TICKS

    def _picture(self, camera: str) -> tuple[int, bytes]:
        """Return the newest picture and its number; the number is 0 without one."""
        number, frame = self._newest.get(camera, (0, b""))
        image = self._image(camera)
        if image is None:
            return number, frame
        problem = _picture_problem(image)
        self._set_problem(camera, self._problems.get(camera, ("", ""))[0], problem)
        if problem:
            return 0, b""
        newest = number + 1, frames.image_frame(camera, image)
        put_newest(self._newest, camera, newest, MAX_NAMES)
        return newest

    def _image(self, camera: str) -> Image | None:
        """Return the next picture to show; None if there is none.

        While things are recognised, it is the picture of the newest detections. Over a later one,
        boxes would be beside the things when the robot turns.
        """
        image = self._feed.poll(IMAGE, camera)
        newest = image if isinstance(image, Image) else self._polled.get(camera)
        if newest is None:
            return None
        put_newest(self._polled, camera, newest, MAX_NAMES)
        if self._is_paired(camera):
            last = self._recognised[camera][1]
            behind = self._shown.get(camera, -RESTART_TICKS) - last
            image = None if 0 <= behind < RESTART_TICKS else self._feed.picture_at(camera, last)
        if not isinstance(image, Image):
            return None
        put_newest(self._shown, camera, image.basis, MAX_NAMES)
        return image

    def _on_info(self, key: str, info: CameraInfo) -> None:
        camera = key.removeprefix(f"{CAMERA.key}/")
        self._set_problem(camera, info.problem, self._problems.get(camera, ("", ""))[1])

    def _set_problem(self, camera: str, problem: str, picture: str) -> None:
        """Send the problem of a camera when it changes."""
        if self._problems.get(camera) != (problem, picture):
            put_newest(self._problems, camera, (problem, picture), MAX_NAMES)
            content = {"camera": camera, "problem": problem or picture}
            frame = frames.as_json(frames.CAMERA, content)
            put_newest(self._kept, f"camera/{camera}", frame, MAX_NAMES)
            self._send(f"camera/{camera}", frame)


def _picture_problem(image: Image) -> str:
    """Return a reason not to send a picture to browsers; an empty text without one."""
    if image.encoding != "jpeg":
        return ""
    from gigabrain_zenoh.vision.pictures import check_jpeg  # numpy, for pictures only

    try:
        check_jpeg(image)
    except ValueError as error:
        return str(error)
    return ""


def _overlay_of(found: Detections) -> dict[str, Any]:
    """Return the rounded values that browsers draw over a picture."""
    return {
        "camera": found.camera,
        "width": found.width,
        "height": found.height,
        "things": [
            {
                "label": one.label,
                "confidence": round(one.confidence, 2),
                "box": [round(at, 1) for at in one.box],
                "position": one.position and [round(at, 3) for at in one.position],
            }
            for one in found.things
        ],
        "tags": [
            {
                "id": one.id,
                "corners": [[round(at, 1) for at in corner] for corner in one.corners],
                "position": [round(at, 3) for at in one.position],
            }
            for one in found.tags
        ],
    }


class SurroundingsFrames:
    """Contours of cameras and findings of perceptors, for the map."""

    def __init__(self, bus: Bus) -> None:
        self._feed = CameraFeed(bus, PERCEIVED)
        self._drawn_basis, self._drawn = -1, False

    def watch(self, on: bool) -> None:
        """Start or stop receiving findings."""
        self._feed.watch(on)

    def new_frames(self, world: WorldModel | None) -> Iterator[tuple[str, bytes]]:
        """Yield contours and findings received since the last call, with their slots."""
        basis = world.basis if world else -1
        shown: tuple[Contour, ...] = world.contours if world else ()
        if basis != self._drawn_basis and (shown or self._drawn):
            self._drawn = bool(shown)
            yield "contours", frames.as_json(frames.CONTOURS, [_rounded(one) for one in shown])
        self._drawn_basis = basis
        for name in self._feed.names(PERCEIVED):
            found = self._feed.poll(PERCEIVED, name)
            if isinstance(found, Objects):
                content = {"name": name, "objects": found.objects}
                yield f"perceived/{name}", frames.as_json(frames.PERCEIVED, content)


def _rounded(one: Contour) -> dict[str, Any]:
    """Round a contour to millimetres, as ten are sent a second."""
    return {
        "polygon": [[round(x, 3), round(y, 3)] for x, y in one.polygon],
        "bottom": round(one.bottom, 3),
        "top": round(one.top, 3),
        "age": round(one.age, 1),
        "confidence": round(one.confidence, 2),
    }
