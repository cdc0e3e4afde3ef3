"""Recognition node: publishes detections of things and tags in the pictures of each camera.

A worker thread processes one picture at a time, always the newest one of the camera that is due. So
more pictures than the configured rate cost no more CPU time.
"""

import asyncio
import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING

from msgspec.structs import replace

from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import Body, Camera, RobotState
from gigabrain_schemas.brain import PoseInMap
from gigabrain_schemas.objects import MAX_LABELS, Detections, Labels, Point
from gigabrain_schemas.sensors import Image
from gigabrain_schemas.topics import BODY, DEPTH, DETECTIONS, IMAGE, LABELS, POSE, STATE
from gigabrain_schemas.vision import DepthImage
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.settings import RecognitionConfig
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.geometry.pose import PoseHistory, compose, relative, to_parent, wrap_angle
from gigabrain_zenoh.host.this_process import step_aside
from gigabrain_zenoh.host.threads import Job
from gigabrain_zenoh.logs import QuietFault
from gigabrain_zenoh.runtime.heartbeat import Progress

if TYPE_CHECKING:
    from gigabrain_zenoh.recognition.observer import Observer

log = logging.getLogger(__name__)
MAX_EARLY_SHARE = 0.25  # of a period; a picture that arrives earlier is skipped
MAX_DEPTH_WAIT_NS = 60_000_000  # from a picture's arrival to that of its depth
CONFIRMED_PICTURES = 5  # a warning follows when a tag has another size in so many in a row
LABELS_TICKS = 50  # robot/labels is published once a second of the robot's time
MAX_DEPTHS = 4  # newest depth pictures of a camera, kept until its pictures arrive
INSTALL = "recognition needs OpenCV; install it with: pip install 'gigabrain-zenoh[eyes]'"


@dataclass
class _CameraInput:
    """A camera, its waiting picture, and its newest depth pictures."""

    camera: Camera
    due_ns: int = 0  # when its next picture is due
    picture: Image | None = None  # newest one, until it is processed
    received_ns: int = 0  # arrival of that picture
    depths: dict[int, DepthImage] = field(default_factory=dict)  # by basis
    fault: QuietFault = field(default_factory=lambda: QuietFault(log))  # broken pictures
    depth_fault: QuietFault = field(default_factory=lambda: QuietFault(log))

    def keep(self, depth: DepthImage) -> None:
        """Keep the depth of an exposure."""
        self.depths[depth.basis] = depth
        while len(self.depths) > MAX_DEPTHS:
            del self.depths[next(iter(self.depths))]

    def depth_of(self, picture: Image) -> DepthImage | None:
        """Return the depth of the same exposure."""
        depth = self.depths.get(picture.basis)
        return depth if depth and depth.boot == picture.boot else None


class Recognition:
    """Receives the pictures of a body's fixed cameras; `observer` processes them in a thread."""

    def __init__(self, config: RecognitionConfig, bus: Bus, observer: "Observer") -> None:
        self._bus, self._observer = bus, observer
        self._period_ns = round(1e9 / config.recognizer.rate_hz)
        self._pool = ThreadPoolExecutor(1, "recognition", initializer=step_aside)
        self._inputs: dict[str, _CameraInput] = {}
        self._history = PoseHistory()
        self._labels_at = 0, 0  # boot and tick of the newest robot/labels
        self._busy, self._closed, self._received, self._done = False, False, 0, 0
        self._size_mismatches: dict[int, int] = {}  # pictures in a row with another size, by tag
        self.failed: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._pose = bus.latest(POSE)
        bus.latest(BODY, self._on_body)
        bus.latest(STATE, self._on_state)
        bus.subscribe(DEPTH, self._on_depth)
        bus.subscribe(IMAGE, self._on_image)
        bus.progress = Progress(
            lambda: (self._received,) if self._inputs else (), lambda: self._done
        )

    def close(self) -> None:
        """Let the thread end after its present picture, without waiting for it."""
        self._closed = True
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _on_body(self, body: Body) -> None:
        cameras = {camera.name: camera for camera in body.description.fixed_cameras}
        if cameras != {name: source.camera for name, source in self._inputs.items()}:
            self._inputs = {name: _CameraInput(camera) for name, camera in cameras.items()}

    def _on_state(self, state: RobotState) -> None:
        self._history = self._history.then(state)
        self._publish_labels(state)
        self._start()

    def _on_depth(self, key: str, depth: DepthImage) -> None:
        if source := self._inputs.get(key.removeprefix(f"{DEPTH.key}/")):
            source.keep(depth)
            self._start()

    def _on_image(self, key: str, picture: Image) -> None:
        source = self._inputs.get(key.removeprefix(f"{IMAGE.key}/"))
        now_ns = self._bus.clock.now_ns()
        if source is None or now_ns < source.due_ns - MAX_EARLY_SHARE * self._period_ns:
            return
        if picture.boot != self._bus.time.boot:
            return
        source.picture, source.received_ns = picture, now_ns
        self._received += 1
        self._start()

    def _start(self) -> None:
        """Start processing the picture that is most overdue, unless the thread is busy."""
        if self._busy or self._closed:
            return
        now_ns = self._bus.clock.now_ns()
        for source in sorted(self._inputs.values(), key=lambda source: source.due_ns):
            picture = source.picture
            if picture is None:
                continue
            depth = source.depth_of(picture)
            if (
                source.camera.depth
                and depth is None
                and now_ns - source.received_ns < MAX_DEPTH_WAIT_NS
            ):
                continue
            source.picture = None
            source.due_ns = max(source.due_ns, now_ns - self._period_ns) + self._period_ns
            self._busy = True
            job = self._pool.submit(self._observer.observe, source.camera, picture, depth)
            self._bus.input_log.when_done(job, partial(self._finish, source, picture))
            return

    def _finish(self, source: _CameraInput, picture: Image, job: Job) -> None:
        name, now_ns = source.camera.name, self._bus.clock.now_ns()
        self._busy, self._done = False, self._done + 1
        if self._closed:
            return
        try:
            found: Detections = job.result()
        except ValueError as error:
            self._bus.counters["broken_pictures"] += 1
            source.fault.begin(f"camera {name}: skipped a picture: {error}", now_ns)
        except Exception as error:  # noqa: BLE001 - `failed` passes it on, and ends this process
            if not self.failed.done():
                self.failed.set_exception(error)
        else:
            source.fault.end(f"camera {name}: its pictures are whole again", now_ns)
            self._judge_depth(source, self._observer.broken_depth, now_ns)
            self._publish(found, picture)
            self._warn_of_sizes(found)
        self._start()

    def _judge_depth(self, source: _CameraInput, problem: str, now_ns: int) -> None:
        """Count and log broken depth: things in its picture have no position."""
        name = source.camera.name
        if problem:
            self._bus.counters["broken_depths"] += 1
            source.depth_fault.begin(f"camera {name}: recognised without depth: {problem}", now_ns)
        else:
            source.depth_fault.end(f"camera {name}: its depth is whole again", now_ns)

    def _warn_of_sizes(self, found: Detections) -> None:
        """Log once each tag whose size in several pictures differs from the settings."""
        measured = self._observer.other_sizes
        for tag in found.tags:
            if tag.id not in measured:
                self._size_mismatches.pop(tag.id, None)
                continue
            times = self._size_mismatches[tag.id] = self._size_mismatches.get(tag.id, 0) + 1
            if times == CONFIRMED_PICTURES:
                log.warning(
                    "tag %d measures %.2f m by depth, but its size is set to %.2f m; "
                    "set `tags: size`, or its own in `sizes`",
                    tag.id, measured[tag.id], tag.size,
                )  # fmt: skip

    def _publish(self, found: Detections, picture: Image) -> None:
        bus = self._bus
        if picture.boot != bus.time.boot:
            return
        if body_pose := self._body_pose(picture.boot, picture.basis):
            found = in_map(found, body_pose)
        bus.latency_ms["recognition"] = found.took_ms
        bus.publish(DETECTIONS, found, basis=picture.basis, stamp_ns=picture.stamp_ns)

    def _publish_labels(self, state: RobotState) -> None:
        """Publish the net's classes if they are due, unless there are none or too many."""
        boot, tick = self._labels_at
        if state.boot == boot and 0 <= state.tick - tick < LABELS_TICKS:
            return
        self._labels_at = state.boot, state.tick
        labels = self._observer.labels
        if 0 < len(labels) <= MAX_LABELS:
            self._bus.publish(LABELS, Labels(labels=labels), name=self._bus.process)

    def _body_pose(self, boot: int, tick: int) -> Pose | None:
        """Return the body's pose in the map at `tick`; None if it is not localized."""
        newest: PoseInMap | None = self._pose.fresh()
        if newest is None or not newest.localized:
            return None
        before, now = self._history.at(boot, newest.basis), self._history.at(boot, tick)
        if before is None or now is None:
            return None
        return compose(Pose(x=newest.x, y=newest.y, yaw=newest.yaw), relative(before, now))


def in_map(found: Detections, body_pose: Pose) -> Detections:
    """Return detections with positions in the map, for a body at `body_pose` in the map."""
    from gigabrain_zenoh.vision.tags import yaw_of

    def at(position: Point) -> Point:
        x, y = to_parent(body_pose, position[0], position[1])
        return x, y, position[2]

    return replace(
        found,
        things=tuple(
            replace(thing, in_map=at(thing.position)) if thing.position else thing
            for thing in found.things
        ),
        tags=tuple(
            replace(
                tag,
                in_map=at(tag.position),
                yaw_in_map=wrap_angle(body_pose.yaw + yaw_of(tag.orientation)),
            )
            for tag in found.tags
        ),
    )


def make_observer(config: RecognitionConfig) -> "Observer":
    """Return the observer of the settings. Raises ConfigError."""
    try:
        import cv2
    except ImportError:
        raise ConfigError(INSTALL) from None
    from gigabrain_zenoh.recognition.observer import Observer
    from gigabrain_zenoh.vision.nets import load_net
    from gigabrain_zenoh.vision.tags import TagFinder

    cv2.setNumThreads(1)
    net, tags = load_net(config.recognizer), config.tags
    if net is None:
        log.warning("no weights of a net are installed: only tags are recognised")
    sizes = {int(number): size for number, size in tags.sizes.items()}
    return Observer(net, TagFinder(tags.family, tags.size, sizes))


async def run(config: RecognitionConfig, bus: Bus, ready: Callable[[], None]) -> None:
    """Publish detections until the process ends. Raises ConfigError."""
    recognition = Recognition(config, bus, await asyncio.to_thread(make_observer, config))
    try:
        ready()
        await asyncio.gather(bus.failed, recognition.failed)
    finally:
        recognition.close()
