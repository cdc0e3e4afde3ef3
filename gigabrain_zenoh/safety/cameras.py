"""Monitor of the depth cameras: the faults of each, and the obstacles that they see.

A camera looks ahead, so it loses sight of obstacles close to the body and behind it. They are
remembered in the odometry's frame until a picture shows that they are gone, or they are out of
reach.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import TICK_NS, TICK_S, Cause, Pose
from gigabrain_schemas.body import BodyDescription, Camera, RobotState
from gigabrain_schemas.vision import DepthImage
from gigabrain_zenoh.geometry.pose import PoseHistory, relative
from gigabrain_zenoh.geometry.se2 import from_pose, transform
from gigabrain_zenoh.geometry.sweep import depth as outside
from gigabrain_zenoh.geometry.sweep import edges
from gigabrain_zenoh.safety.catalogue import cause
from gigabrain_zenoh.safety.depth import (
    Mask,
    Sighting,
    Up,
    blind,
    reach_of,
    seen_through,
    sight,
    view_of,
)

LATE_PERIODS = 2.5  # a picture after this many is late, unless the age limit of scans is longer
RECOVERY_TICKS = 50  # 1 s without a late picture, before a late camera is trusted again
MIN_PERIOD_SHARE = 0.5  # of the camera's period; pictures that come faster are skipped
FROZEN_M, FROZEN_RAD = 0.02, math.radians(2)  # motion that must change the picture
UP_STEP = 0.01  # resolution of the vertical's x and y: 0.6 deg
DIRECTION_YAWS = {"forward": 0.0, "left": math.pi / 2, "backward": math.pi, "right": -math.pi / 2}
MIN_HALF_ANGLE = math.radians(45)  # also of a narrower camera, for the directions it must see
CELL_M = 0.03  # side of a cell, which keeps one point
CONFIRM_M = 0.04  # two sightings of a doubtful point this near confirm each other
PENDING, BELIEVED = 1, 3  # levels: a point counts from 2 on; each look through it subtracts 1
PENDING_PERIODS = 2.5  # a doubtful point is dropped after this many, unless seen again
DRIFT_M = 0.02  # points farther inside the footprint are no obstacles
JUMP_M = 0.5  # farther than the body can drive between two pictures: the odometry has restarted
MAX_POINTS = 1500
MIN_KNOWN = 0.8  # share of the pixels with a known ray
CHECK_TICKS = 5  # between two checks of remembered points without pictures


class Picture(Struct, frozen=True, kw_only=True):
    """The newest picture of a camera, and its age."""

    image: DepthImage
    age_ns: int = 0  # since its arrival


Pictures = Mapping[str, Picture]
NO_PICTURES: Pictures = {}


class Marks(NamedTuple):
    """Remembered points in the odometry's frame."""

    points: Floats  # (n, 3) [m]
    hole: Mask  # (n,)
    level: NDArray[np.int8]  # (n,), from PENDING to BELIEVED
    tick: NDArray[np.int64]  # (n,), of the last sighting

    def select(self, keep: Mask) -> "Marks":
        """Return the marks in the mask `keep` (n,)."""
        if keep.all():
            return self
        return Marks(self.points[keep], self.hole[keep], self.level[keep], self.tick[keep])


NO_MARKS = Marks(np.empty((0, 3)), np.empty(0, bool), np.empty(0, np.int8), np.empty(0, np.int64))


class CameraState(Struct, frozen=True, kw_only=True):
    """The state of one camera and of its newest picture."""

    basis: int = 0  # tick of the newest picture; 0 before the first
    code: str = ""  # of that picture's fault; empty without one
    text: str = ""
    plane: bytes = b""  # of that picture, encoded
    since: Pose | None = None  # of the body when the same plane first came
    late: int = 0  # last tick with an overdue picture; 0 for never


class Cameras(Struct, frozen=True, kw_only=True):
    """All depth cameras of a body, and the obstacles that they saw."""

    states: Mapping[str, CameraState] = {}
    marks: Marks = NO_MARKS
    pose: Pose | None = None  # at the newest picture
    basis: int = 0  # tick of that picture
    checked: int = 0  # tick of the last check of remembered points
    pictures: int = 0  # processed so far
    causes: tuple[Cause, ...] = ()
    blind: frozenset[str] = frozenset()  # directions that a camera should see, but does not

    def then(
        self, body: BodyDescription, pictures: Pictures, state: RobotState, history: PoseHistory
    ) -> "Cameras":
        """Return the monitor after one more state or picture."""
        now = self
        for camera in depth_cameras(body):
            picture = pictures.get(camera.name)
            if picture and now._due(camera, picture.image, state):
                pose = history.at(state.boot, picture.image.basis)
                now = now._with_picture(body, camera, picture.image, state, pose) if pose else now
        causes, unseen = [], set[str]()
        for camera in depth_cameras(body):
            seen = now.states.get(camera.name)
            if seen and _overdue(body, camera, seen, pictures.get(camera.name), state):
                seen = replace(seen, late=state.tick)
                now = replace(now, states={**now.states, camera.name: seen})
            if found := now._cause(body, camera, pictures.get(camera.name), state):
                causes.append(found)
                unseen |= directions(camera)
        now = replace(now, causes=tuple(causes), blind=frozenset(unseen))
        if now.pictures != self.pictures or state.tick - self.checked >= CHECK_TICKS:
            now = replace(now, checked=state.tick, marks=_in_reach(body, now.marks, state))
        return now

    @property
    def version(self) -> tuple[int, int]:
        """Value that changes whenever `obstacles` may change."""
        return self.pictures, self.checked

    def obstacles(self, pose: Pose) -> Floats:
        """Return obstacles and holes around a body at `pose`, (n, 2) [m] in its frame."""
        believed = self.marks.level > PENDING
        points = self.marks.points[believed, :2]
        if not believed.any():
            return points
        return transform(from_pose(relative(pose, Pose(x=0.0, y=0.0, yaw=0.0))), points)

    def _due(self, camera: Camera, image: DepthImage, state: RobotState) -> bool:
        """Return whether a picture is new, not of the future, and not too soon."""
        before = self.states.get(camera.name, CameraState()).basis
        period = 1e9 / camera.rate_hz / TICK_NS
        min_ticks = MIN_PERIOD_SHARE * period if before else 1
        return before + min_ticks <= image.basis <= state.tick

    def _with_picture(
        self,
        body: BodyDescription,
        camera: Camera,
        image: DepthImage,
        state: RobotState,
        pose: Pose,
    ) -> "Cameras":
        """Process a picture that was taken with the body at `pose`."""
        before = self.states.get(camera.name, CameraState())
        same = image.planes[0] == before.plane
        since = before.since if same and before.since else pose
        marks, code, text = self.marks, "", ""
        fastest = math.hypot(body.max_linear_speed, body.max_lateral_speed)
        max_m = JUMP_M + fastest * abs(image.basis - self.basis) * TICK_S
        if self.pose and math.hypot(pose.x - self.pose.x, pose.y - self.pose.y) > max_m:
            marks = NO_MARKS
        size = (camera.width, camera.height)
        if image.frame_id != camera.name:
            code, text = "camera_wrong", f"sends pictures of the camera {image.frame_id!r}"
        elif (image.width, image.height) != size:
            code = "camera_wrong"
            text = f"has {image.width} x {image.height} pixels, its file {size[0]} x {size[1]}"
        else:
            result = _look(body, camera, image, (pose, _up(state)), marks)
            if same and not result[1] and _moved(since, pose):  # dark pictures may be equal
                code, text = "camera_frozen", "repeats one picture while the body moves"
            else:
                marks, code, text = result
        seen = replace(
            before, basis=image.basis, code=code, text=text, plane=image.planes[0], since=since
        )
        states = {**self.states, camera.name: seen}
        return replace(
            self, states=states, marks=marks, pose=pose, basis=image.basis,
            pictures=self.pictures + 1,
        )  # fmt: skip

    def _cause(
        self, body: BodyDescription, camera: Camera, picture: Picture | None, state: RobotState
    ) -> Cause | None:
        """Return the present fault of a camera."""
        seen = self.states.get(camera.name)
        if seen is None or picture is None:
            return cause("camera_lost", f"no picture of camera {camera.name} has come yet")
        if late := _overdue(body, camera, seen, picture, state):
            return cause("camera_lost", late)
        if seen.late and state.tick - seen.late < RECOVERY_TICKS:
            return cause("camera_lost", f"pictures of camera {camera.name} have just come back")
        return cause(seen.code, f"camera {camera.name} {seen.text}") if seen.code else None


def depth_cameras(body: BodyDescription) -> tuple[Camera, ...]:
    """Return the cameras of `body` that measure depth."""
    return tuple(camera for camera in body.cameras if camera.depth)


def _overdue(
    body: BodyDescription,
    camera: Camera,
    seen: CameraState,
    picture: Picture | None,
    state: RobotState,
) -> str:
    """Return a text if the newest picture is too old; empty otherwise."""
    limit_ns = max(body.thresholds.scan_age * 1e9, LATE_PERIODS * 1e9 / camera.rate_hz)
    age_ns = (state.tick - seen.basis) * TICK_NS
    if max(age_ns, picture.age_ns if picture else 0) <= limit_ns:
        return ""
    late = f"no picture of camera {camera.name} for more than {limit_ns / 1e6:.0f} ms"
    future = picture is not None and picture.image.basis > state.tick
    return f"{late}; the newest is of the future" if future else late


def directions(camera: Camera) -> set[str]:
    """Return the directions of motion that a camera should see."""
    fx, *_ = camera.pinhole
    side = max(math.atan2(camera.width / 2, fx), MIN_HALF_ANGLE) + 1e-6
    return {
        way
        for way, yaw in DIRECTION_YAWS.items()
        if abs(math.remainder(yaw - camera.yaw, math.tau)) <= side
    }


def _up(state: RobotState) -> Up:
    """Return x and y of the vertical in the body's frame, rounded; (0, 0) for a level body."""
    if state.imu is None:
        return 0.0, 0.0
    x, y, z, w = state.imu.orientation
    ups = (2 * (x * z - w * y), 2 * (y * z + w * x))
    first, second = (round(max(-0.5, min(0.5, up)) / UP_STEP) * UP_STEP for up in ups)
    return first, second


def _moved(since: Pose, pose: Pose) -> bool:
    distance = math.hypot(pose.x - since.x, pose.y - since.y)
    return distance > FROZEN_M or abs(math.remainder(pose.yaw - since.yaw, math.tau)) > FROZEN_RAD


def _look(
    body: BodyDescription, camera: Camera, image: DepthImage, place: tuple[Pose, Up], marks: Marks
) -> tuple[Marks, str, str]:
    """Return the marks after a picture, and the code and text of its fault.

    `place` has the body's pose and vertical.
    """
    try:
        picture = image.quarter()
    except ValueError as error:
        return marks, "camera_wrong", f"sends invalid pictures: {error}"[:300]
    pose, up = place
    view = view_of(body, camera, up)
    if view.known < MIN_KNOWN:
        return marks, "camera_wrong", "has an impossible distortion in its file"
    dark = blind(camera, view, picture)
    trusted = view._replace(sure=np.zeros_like(view.sure)) if dark else view
    found = sight(body, camera, trusted, picture)
    if len(marks.level):
        here = _in_frame(pose, marks.points)
        gone = seen_through(camera, view, picture, here, marks.hole)
        marks = marks._replace(level=(marks.level - gone).astype(np.int8))
        marks = marks.select(marks.level > 0)
    oldest = image.basis - PENDING_PERIODS * 1e9 / camera.rate_hz / TICK_NS
    marks = _merge(marks, found, pose, image.basis)
    marks = marks.select((marks.level > PENDING) | (marks.tick >= oldest))
    if dark:
        return marks, "camera_blind", "sees neither the floor nor anything before it"
    return marks, "", ""


def _in_frame(pose: Pose, points: Floats) -> Floats:
    """Transform `points` (n, 3) from the odometry's frame to that of a body at `pose`."""
    origin = from_pose(relative(pose, Pose(x=0.0, y=0.0, yaw=0.0)))
    return np.column_stack((transform(origin, points[:, :2]), points[:, 2]))


def _merge(marks: Marks, found: Sighting, pose: Pose, tick: int) -> Marks:
    """Add points `found` from `pose`; doubtful ones wait for a second sighting."""
    if not len(found.points):
        return marks
    points = np.column_stack((transform(from_pose(pose), found.points[:, :2]), found.points[:, 2]))
    sure = found.sure.copy()
    doubtful = np.flatnonzero(~sure)
    if len(doubtful) and len(marks.points):
        offsets = points[doubtful, None, :2] - marks.points[None, :, :2]
        near = (offsets**2).sum(axis=-1) <= CONFIRM_M**2
        near &= found.hole[doubtful, None] == marks.hole
        sure[doubtful] = near.any(axis=1)
    level = np.where(sure, BELIEVED, PENDING).astype(np.int8)
    order = np.argsort(~sure, kind="stable")  # so that a cell keeps its sure point
    all_marks = Marks(
        np.concatenate((points[order], marks.points)),
        np.concatenate((found.hole[order], marks.hole)),
        np.concatenate((level[order], marks.level)),
        np.concatenate((np.full(len(points), tick), marks.tick)),
    )
    cells = np.floor(all_marks.points[:, :2] / CELL_M).astype(np.int64)
    keys = (cells[:, 0] * (1 << 31) + cells[:, 1]) * 2 + all_marks.hole
    believed = np.flatnonzero(all_marks.level > PENDING)
    pending = np.flatnonzero(all_marks.level <= PENDING)
    ranked = np.concatenate((believed, pending))
    _, first = np.unique(keys[ranked], return_index=True)
    keep = np.zeros(len(keys), bool)
    keep[ranked[first]] = True
    return all_marks.select(keep)


def _in_reach(body: BodyDescription, marks: Marks, state: RobotState) -> Marks:
    """Return the marks in reach, without obstacles under the body; a hole may be there."""
    if not len(marks.level):
        return marks
    points = _in_frame(state.pose, marks.points)[:, :2]
    distances = np.hypot(points[:, 0], points[:, 1])
    keep = distances <= reach_of(body)
    keep &= marks.hole | (outside(edges(body.footprint), points) > -DRIFT_M)
    if np.count_nonzero(keep) > MAX_POINTS:
        keep &= distances <= np.partition(distances[keep], MAX_POINTS)[MAX_POINTS]
    return marks.select(keep)
