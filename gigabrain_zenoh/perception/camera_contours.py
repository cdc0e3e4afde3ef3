"""Contours from the pictures of a body's cameras, computed in a thread beside the event loop.

A scan never waits for a picture. One picture is processed at a time: the newest one of each camera
in turn. Its contours are then moved to the body's pose at each scan.
"""

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from msgspec.structs import replace

from gigabrain_schemas.base import TICK_S, Pose
from gigabrain_schemas.body import BodyDescription, Camera, RobotState
from gigabrain_schemas.brain import CameraStatus, Contour
from gigabrain_schemas.sensors import Image
from gigabrain_schemas.topics import CAMERA, DEPTH, IMAGE, STATE, Topic
from gigabrain_schemas.vision import CameraInfo, DepthImage
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.geometry.pose import ORIGIN, PoseHistory, relative
from gigabrain_zenoh.geometry.se2 import from_pose, transform
from gigabrain_zenoh.host.threads import Job
from gigabrain_zenoh.vision.obstacle_contours import ObstacleContours, OwnPoints, Seen
from gigabrain_zenoh.vision.pictures import decoded

if TYPE_CHECKING:
    from gigabrain_zenoh.perception.solid_publisher import SolidPublisher
    from gigabrain_zenoh.vision.solid_fit import SolidFit

SILENT_PERIODS, SILENT_S = 2.5, 0.4  # a camera is silent after the longer of them
MIN_PERIOD_SHARE = 0.5  # of the camera's period; pictures that come faster are skipped
SKIPPED = "pictures_left_out"


@dataclass(frozen=True)
class View:
    """Contours in the frame of the body, which was at `pose` at `tick`."""

    contours: tuple[Contour, ...] = ()
    pose: Pose = ORIGIN
    tick: int = 0

    def at(self, pose: Pose, tick: int) -> tuple[Contour, ...]:
        """Return the contours in the frame of a body at `pose`, with their ages at `tick`."""
        if not self.contours:
            return ()
        corners = np.concatenate([np.array(one.polygon) for one in self.contours])
        moved = transform(from_pose(relative(pose, self.pose)), corners).tolist()
        elapsed_s, first = max(0, tick - self.tick) * TICK_S, 0
        found = []
        for one in self.contours:
            polygon = tuple((x, y) for x, y in moved[first : first + len(one.polygon)])
            first += len(one.polygon)
            found.append(replace(one, polygon=polygon, age=one.age + elapsed_s))
        return tuple(found)


class _Result(NamedTuple):
    """Result of one picture."""

    refused: str  # why the picture was refused, or empty
    view: View
    seen: Seen | None = None  # only of a body with an arm
    solids: "tuple[SolidFit, ...]" = ()  # in the picture


@dataclass
class _CameraState:
    """One camera, and its newest waiting picture."""

    description: Camera
    waiting: DepthImage | Image | None = None
    job: int = 0  # number of the newest job for one of its pictures
    exposure: int = 0  # tick of the newest picture whose contours are known
    refused: str = ""  # why that picture was refused
    problem: str = ""  # as reported by the camera process

    def status(self, tick: int) -> CameraStatus:
        """Return whether the camera is ok at `tick`, or its problem."""
        silent_s = max(SILENT_S, SILENT_PERIODS / self.description.rate_hz)
        silent = not self.exposure or (tick - self.exposure) * TICK_S > silent_s
        problem = self.problem or self.refused or ("no picture" if silent else "")
        return CameraStatus(
            name=self.description.name,
            ok=not problem,
            problem=problem[:500],
            exposure=self.exposure,
        )


class CameraContours:
    """Processes the pictures of the cameras that are fixed to one body. Runs on the event loop.

    `on_new` is called after each picture, `on_state` with each state.
    """

    def __init__(
        self,
        bus: Bus,
        description: BodyDescription,
        on_new: Callable[[], object],
        on_state: Callable[[RobotState], object],
    ) -> None:
        self._bus, self._description = bus, description
        self._on_new, self._pass_on = on_new, on_state
        self._cameras = {one.name: _CameraState(one) for one in description.fixed_cameras}
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="contours")
        self._contours, self._boot = ObstacleContours(description), 0
        self._busy, self._jobs = False, 0
        self._view = View()
        self._history = PoseHistory()
        self._solids = _solid_publisher(bus, description)
        self._unsubscribe = [
            bus.subscribe(CAMERA, self._on_info),
            bus.subscribe(STATE, lambda _, state: self._on_state(state)),
        ]
        depth = [camera.description.depth for camera in self._cameras.values()]
        topics: list[Topic[Any]] = [DEPTH] if any(depth) else []
        topics += [] if all(depth) else [IMAGE]
        self._unsubscribe += [bus.subscribe(topic, self._on_picture) for topic in topics]

    def close(self) -> None:
        """End the subscriptions, and the thread after its current job."""
        for unsubscribe in self._unsubscribe:
            unsubscribe()
        if self._solids:
            self._solids.close()
        self._cameras.clear()  # so that no new job begins
        self._pool.shutdown()

    def contours(self, pose: Pose | None, tick: int) -> tuple[Contour, ...]:
        """Return the contours at `tick`, in the frame of a body at `pose`.

        If the pose is None, the newest known pose is used.
        """
        return self._view.at(pose or self._history.newest or self._view.pose, tick)

    def statuses(self, tick: int) -> tuple[CameraStatus, ...]:
        """Return the status of each camera at `tick`."""
        return tuple(camera.status(tick) for camera in self._cameras.values())

    def _on_state(self, state: RobotState) -> None:
        if state.boot != self._boot:
            self._boot, self._view = state.boot, View()
            self._contours = ObstacleContours(self._description)
            self._cameras = {
                name: _CameraState(camera.description) for name, camera in self._cameras.items()
            }
        self._history = self._history.then(state)
        if self._solids:
            self._solids.on_state(state)
        self._start()
        self._pass_on(state)

    def _on_info(self, key: str, info: CameraInfo) -> None:
        camera = self._cameras.get(key.removeprefix(f"{CAMERA.key}/"))
        if camera:
            camera.problem = info.problem

    def _on_picture(self, key: str, picture: DepthImage | Image) -> None:
        topic = DEPTH if isinstance(picture, DepthImage) else IMAGE
        camera = self._cameras.get(key.removeprefix(f"{topic.key}/"))
        if camera is None or camera.description.depth != (topic is DEPTH):
            return
        min_ticks = math.ceil(MIN_PERIOD_SHARE / (camera.description.rate_hz * TICK_S))
        early = camera.exposure and picture.basis < camera.exposure + min_ticks
        if picture.boot != self._boot or early:
            self._bus.counters[SKIPPED] += 1
            return
        if camera.waiting:
            self._bus.counters[SKIPPED] += 1
        camera.waiting = picture
        self._start()

    def _start(self) -> None:
        """Process a waiting picture whose pose is known, unless another one is being processed.

        Cameras take turns. On a slow host, the last camera's next picture may be waiting already.
        """
        if self._busy:
            return
        for camera in sorted(self._cameras.values(), key=lambda one: one.job):
            picture = camera.waiting
            if picture is None or picture.basis > self._history.newest_tick:
                continue
            camera.waiting = None
            pose = self._history.at(picture.boot, picture.basis)
            if pose is None:
                self._bus.counters[SKIPPED] += 1
                continue
            self._busy, self._jobs = True, self._jobs + 1
            camera.job = self._jobs
            on_arm = self._solids.own(picture.basis) if self._solids else None
            find = self._solids.find if self._solids and on_arm else None
            work = self._contours, camera.description.name, picture, pose, on_arm, find
            job = self._pool.submit(_process, *work)
            self._bus.input_log.when_done(job, partial(self._finish, camera, self._boot))
            return

    def _finish(self, camera: _CameraState, boot: int, job: Job) -> None:
        self._busy = False
        result: _Result = job.result()
        if boot == self._boot:
            view = self._view = result.view
            camera.exposure, camera.refused = view.tick, result.refused
            if self._solids and result.seen:
                self._solids.look(result.seen, result.solids, view.pose, view.tick)
            self._on_new()
        self._start()


def _process(
    contours: ObstacleContours,
    name: str,
    picture: DepthImage | Image,
    pose: Pose,
    on_arm: OwnPoints | None,
    find: "Callable[[Seen], tuple[SolidFit, ...]] | None",
) -> _Result:
    """Add a picture to `contours`. Find the solids in it if the arm's own points are known."""
    now = picture.basis * TICK_S
    if picture.frame_id != name:
        refused = f"it is a picture of the camera {picture.frame_id!r}"
    elif isinstance(picture, DepthImage):
        refused = contours.add_depth(name, picture, pose, now, on_arm)
    else:
        try:
            refused = contours.add_colour(name, decoded(picture), pose, now)
        except ValueError as error:
            refused = str(error)
    view = View(contours.contours(pose, now), pose, picture.basis)
    seen = contours.seen
    if find is None or seen is None:
        return _Result(refused, view)
    return _Result(refused, view, seen, find(seen))


def _solid_publisher(bus: Bus, description: BodyDescription) -> "SolidPublisher | None":
    """Return a publisher of solids if the body has an arm."""
    if description.arm is None:
        return None
    from gigabrain_zenoh.perception.solid_publisher import SolidPublisher  # imports OpenCV

    return SolidPublisher(bus, description)
