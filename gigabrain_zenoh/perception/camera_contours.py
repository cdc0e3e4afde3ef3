"""Contours from the pictures of a body's cameras, made in a thread beside the event loop.

A scan never waits for a picture. One picture is worked on at a time, the newest of each camera in
turn; its contours are then moved to wherever the body is at a scan.
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

SILENT_PERIODS, SILENT_S = 2.5, 0.4  # without a picture, whichever is longer
MIN_PERIOD_SHARE = 0.5  # of its period: pictures that come faster are skipped
SKIPPED = "pictures_left_out"


@dataclass(frozen=True)
class View:
    """Contours in the frame of a body at `pose`, where it was at `tick`."""

    contours: tuple[Contour, ...] = ()
    pose: Pose = ORIGIN
    tick: int = 0

    def at(self, pose: Pose, tick: int) -> tuple[Contour, ...]:
        """Return the contours in the frame of the body at `pose`, as old as they are at `tick`."""
        if not self.contours:
            return ()
        corners = np.concatenate([np.array(one.polygon) for one in self.contours])
        moved = transform(from_pose(relative(pose, self.pose)), corners).tolist()
        older, at = max(0, tick - self.tick) * TICK_S, 0
        found = []
        for one in self.contours:
            polygon = tuple((x, y) for x, y in moved[at : at + len(one.polygon)])
            at += len(one.polygon)
            found.append(replace(one, polygon=polygon, age=one.age + older))
        return tuple(found)


class _Look(NamedTuple):
    """Result of one picture."""

    refused: str  # why it was, if it was
    view: View
    seen: Seen | None = None  # of a body with an arm
    solids: "tuple[SolidFit, ...]" = ()  # what stands in it


@dataclass
class _Eye:
    """One camera, and its newest picture that waits."""

    camera: Camera
    waiting: DepthImage | Image | None = None
    look: int = 0  # number of the newest look at one of its pictures
    exposure: int = 0  # tick of the newest picture whose contours are known
    refused: str = ""  # why that picture gave none
    problem: str = ""  # what the camera process says of it

    def status(self, tick: int) -> CameraStatus:
        """Return whether it can be believed at `tick`."""
        silent_s = max(SILENT_S, SILENT_PERIODS / self.camera.rate_hz)
        silent = not self.exposure or (tick - self.exposure) * TICK_S > silent_s
        problem = self.problem or self.refused or ("no picture" if silent else "")
        return CameraStatus(
            name=self.camera.name, ok=not problem, problem=problem[:500], exposure=self.exposure
        )


class CameraContours:
    """Follows the cameras that are fixed to one body, on the loop.

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
        self._eyes = {one.name: _Eye(one) for one in description.fixed_cameras}
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="contours")
        self._contours, self._boot = ObstacleContours(description), 0
        self._busy, self._looks = False, 0
        self._view = View()
        self._history = PoseHistory()
        self._solids = _solid_publisher(bus, description)
        self._ends = [
            bus.subscribe(CAMERA, self._on_info),
            bus.subscribe(STATE, lambda _, state: self._on_state(state)),
        ]
        depth = [eye.camera.depth for eye in self._eyes.values()]
        topics: list[Topic[Any]] = [DEPTH] if any(depth) else []
        topics += [] if all(depth) else [IMAGE]
        self._ends += [bus.subscribe(topic, self._on_picture) for topic in topics]

    def close(self) -> None:
        """Stop listening, and end the thread after its work."""
        for end in self._ends:
            end()
        if self._solids:
            self._solids.close()
        self._eyes.clear()  # no work is begun any more
        self._pool.shutdown()

    def contours(self, pose: Pose | None, tick: int) -> tuple[Contour, ...]:
        """Return what is known at `tick`, in the frame of a body at `pose`.

        Where that is not known, the body is taken to be where it was last.
        """
        return self._view.at(pose or self._history.newest or self._view.pose, tick)

    def statuses(self, tick: int) -> tuple[CameraStatus, ...]:
        """Return whether each camera can be believed at `tick`."""
        return tuple(eye.status(tick) for eye in self._eyes.values())

    def _on_state(self, state: RobotState) -> None:
        if state.boot != self._boot:
            self._boot, self._view = state.boot, View()
            self._contours = ObstacleContours(self._description)
            self._eyes = {name: _Eye(eye.camera) for name, eye in self._eyes.items()}
        self._history = self._history.then(state)
        if self._solids:
            self._solids.on_state(state)
        self._start()
        self._pass_on(state)

    def _on_info(self, key: str, info: CameraInfo) -> None:
        eye = self._eyes.get(key.removeprefix(f"{CAMERA.key}/"))
        if eye:
            eye.problem = info.problem

    def _on_picture(self, key: str, picture: DepthImage | Image) -> None:
        topic = DEPTH if isinstance(picture, DepthImage) else IMAGE
        eye = self._eyes.get(key.removeprefix(f"{topic.key}/"))
        if eye is None or eye.camera.depth != (topic is DEPTH):
            return
        least = math.ceil(MIN_PERIOD_SHARE / (eye.camera.rate_hz * TICK_S))
        early = eye.exposure and picture.basis < eye.exposure + least
        if picture.boot != self._boot or early:
            self._bus.counters[SKIPPED] += 1
            return
        if eye.waiting:
            self._bus.counters[SKIPPED] += 1
        eye.waiting = picture
        self._start()

    def _start(self) -> None:
        """Work on a picture, if none is worked on and the pose of one is known.

        Cameras take turns: on a slow host, the next picture of the last one waits again already.
        """
        if self._busy:
            return
        for eye in sorted(self._eyes.values(), key=lambda one: one.look):
            picture = eye.waiting
            if picture is None or picture.basis > self._history.newest_tick:
                continue
            eye.waiting = None
            pose = self._history.at(picture.boot, picture.basis)
            if pose is None:
                self._bus.counters[SKIPPED] += 1
                continue
            self._busy, self._looks = True, self._looks + 1
            eye.look = self._looks
            on_arm = self._solids.own(picture.basis) if self._solids else None
            find = self._solids.find if self._solids and on_arm else None
            work = self._contours, eye.camera.name, picture, pose, on_arm, find
            job = self._pool.submit(_look, *work)
            self._bus.input_log.when_done(job, partial(self._finish, eye, self._boot))
            return

    def _finish(self, eye: _Eye, boot: int, job: Job) -> None:
        self._busy = False
        look: _Look = job.result()
        if boot == self._boot:
            view = self._view = look.view
            eye.exposure, eye.refused = view.tick, look.refused
            if self._solids and look.seen:
                self._solids.look(look.seen, look.solids, view.pose, view.tick)
            self._on_new()
        self._start()


def _look(
    contours: ObstacleContours,
    name: str,
    picture: DepthImage | Image,
    pose: Pose,
    on_arm: OwnPoints | None,
    find: "Callable[[Seen], tuple[SolidFit, ...]] | None",
) -> _Look:
    """Add a picture, and find what stands in it where it is known what of it is the arm."""
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
        return _Look(refused, view)
    return _Look(refused, view, seen, find(seen))


def _solid_publisher(bus: Bus, description: BodyDescription) -> "SolidPublisher | None":
    """Return who finds things near an arm, for a body that has one."""
    if description.arm is None:
        return None
    from gigabrain_zenoh.perception.solid_publisher import SolidPublisher  # imports OpenCV

    return SolidPublisher(bus, description)
