"""Obstacle contours from all cameras of a body, in its frame, with memory."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import BodyDescription, Camera
from gigabrain_schemas.brain import Contour
from gigabrain_schemas.vision import DepthImage
from gigabrain_zenoh.geometry.polygon import contains
from gigabrain_zenoh.vision.camera_model import CameraModel
from gigabrain_zenoh.vision.cell_memory import (
    COLOUR,
    CONFIRMED_PICTURES,
    HOLE,
    MAX_AGE_S,
    MISSING,
    OBSTACLE,
    CellMemory,
    Cells,
    Picture,
)
from gigabrain_zenoh.vision.depth_picture import HIGH_M, DepthCamera, DepthView
from gigabrain_zenoh.vision.floor_colour import ColourCamera
from gigabrain_zenoh.vision.outlines import Labels, connected, distinct, split, support_polygons

MAX_PIXELS = 320 * 240  # larger pictures are reduced to every second row and column, or fewer
MAX_CONTOURS = 128  # the nearest ones
BOTTOMLESS_M = -1.0  # height of a hole without depth
CLEARANCE_ABOVE_M = 0.01  # things up to this height above the body are obstacles
AT_ONCE_POINTS = 12.0  # least pixels of a thing that counts after its first picture,
LATER_POINTS = 2.0  # and after its second
GROUPS = ((OBSTACLE,), (HOLE, MISSING), (COLOUR,))  # kinds of cells that share contours
MIN_SEEN = {OBSTACLE: 2.0, HOLE: 2.0, MISSING: 3.0, COLOUR: 3.0}  # pictures
UNSURE = {MISSING: 0.5, COLOUR: 0.5}  # confidence of kinds with frequent mistakes
OwnPoints = Callable[[Floats], NDArray[np.bool_]]  # mask of points (n, 3) on the body's own arm


class Seen(NamedTuple):
    """An analysed depth picture."""

    view: DepthView
    model: CameraModel
    own: NDArray[np.bool_]  # (n,), obstacle points that are on the body itself


class ObstacleContours:
    """Contours from the pictures of all cameras of a body. Never raises for a bad picture.

    Poses are those of the odometry at the exposure of a picture. Times are in seconds of any clock
    that is consistent with them.
    """

    def __init__(self, description: BodyDescription) -> None:
        self._footprint: Floats = np.array(description.footprint)
        self._height = description.body_height + CLEARANCE_ABOVE_M
        self._cameras: dict[str, Camera] = {one.name: one for one in description.cameras}
        self._steps = {one.name: step_of(one) for one in description.cameras}
        self._depth: dict[str, DepthCamera] = {}
        self._colour: dict[str, ColourCamera] = {}
        self._memory = CellMemory()
        self._tracks = 0
        self.seen: Seen | None = None  # newest depth picture; None if it was refused

    def reset(self) -> None:
        """Forget everything, as after a restart of the odometry."""
        self._memory = CellMemory()

    def add_depth(
        self,
        name: str,
        image: DepthImage,
        pose: Pose,
        now: float,
        on_arm: OwnPoints | None = None,
    ) -> str:
        """Add a depth picture of the camera `name`; return why it was refused, or ''."""
        self.seen = None
        problem = self._refused(name, image.width, image.height)
        if problem:
            return problem
        if not self._cameras[name].depth:
            return f"the camera {name!r} measures no depth"
        try:
            pixels = image.array()
        except ValueError as error:
            return str(error)
        step = self._steps[name]
        if name not in self._depth:
            model = CameraModel(reduced(self._cameras[name], step))
            self._depth[name] = DepthCamera(model, self._height)
        camera = self._depth[name]
        view = camera.view(pixels[::step, ::step])
        self._memory.move(pose, now)
        if view is None:
            return "it shows nothing"
        floor = view.floor.coefficients
        picture = Picture(camera.model, view.depth, view.is_floor, floor)
        self._memory.look(picture, (OBSTACLE, HOLE, MISSING))
        standing = view.obstacles.astype(np.float64)
        own = contains(self._footprint, standing[:, :2])
        own |= on_arm(standing) if on_arm else False
        self.seen = Seen(view, camera.model, own)
        self._memory.add(view.obstacles[~own], OBSTACLE)
        self._memory.add(view.holes, HOLE)
        self._memory.add(
            np.pad(view.missing, ((0, 0), (0, 1)), constant_values=BOTTOMLESS_M), MISSING
        )
        return ""

    def add_colour(self, name: str, pixels: NDArray[np.uint8], pose: Pose, now: float) -> str:
        """Add a picture (height, width, 3) of the camera `name`; return why it was refused, or ''.

        For cameras without depth: obstacles are where the floor's colour ends.
        """
        if pixels.ndim != 3 or pixels.shape[2] != 3:
            return f"it has no three colours, but the shape {pixels.shape}"
        problem = self._refused(name, pixels.shape[1], pixels.shape[0])
        if problem:
            return problem
        step = self._steps[name]
        if name not in self._colour:
            self._colour[name] = ColourCamera(CameraModel(reduced(self._cameras[name], step)))
        camera = self._colour[name]
        view = camera.view(pixels[::step, ::step])
        self._memory.move(pose, now)
        if view is None:
            return "no floor is in view"
        self._memory.look(Picture(camera.model, view.known, view.is_floor, np.zeros(3)), (COLOUR,))
        standing = np.column_stack((view.boundary, np.full(len(view.boundary), self._height)))
        self._memory.add(standing[~contains(self._footprint, view.boundary)], COLOUR)
        return ""

    def contours(self, pose: Pose, now: float) -> tuple[Contour, ...]:
        """Return the contours at `now` [s] in the frame of a body at `pose`, nearest first."""
        memory = self._memory
        memory.move(pose, now)
        found: list[tuple[float, Contour]] = []
        taken: set[int] = set()
        for kinds in GROUPS:
            at = np.flatnonzero(np.isin(memory.cells["kind"], kinds) & memory.steady())
            if len(at):
                found += self._of_group(at, now, taken)
        found.sort(key=lambda one: one[0])
        return tuple(contour for _, contour in found[:MAX_CONTOURS])

    def _refused(self, name: str, width: int, height: int) -> str:
        camera = self._cameras.get(name)
        if camera is None:
            return f"the body has no camera {name!r}"
        if (width, height) != (camera.width, camera.height):
            return f"expected {camera.width} x {camera.height} pixels, got {width} x {height}"
        return ""

    def _of_group(self, at: Labels, now: float, taken: set[int]) -> list[tuple[float, Contour]]:
        """Return contours of some cells with their distance; store their tracks in the cells."""
        cells = self._memory.cells[at]
        labels = connected((cells["low"] + cells["high"]) / 2)
        believed = _believed(cells, labels)[labels]
        at, cells, labels = at[believed], cells[believed], labels[believed]
        if not len(at):
            return []
        labels = split(cells["low"], cells["high"], labels, self._memory.place)
        order = np.argsort(labels, kind="stable")
        at, cells, labels = at[order], cells[order], labels[order]
        first = np.flatnonzero(np.diff(labels, prepend=-1))
        outlines = support_polygons(cells["low"], cells["high"], first)
        ends = np.append(first[1:], len(cells))
        found = []
        for begin, end, outline in sorted(
            zip(first.tolist(), ends.tolist(), outlines, strict=True),
            key=lambda one: one[0] - one[1],
        ):
            part = cells[begin:end]
            track = self._track(part, taken)
            self._memory.cells["track"][at[begin:end]] = track
            corners = self._memory.to_body(outline)
            away = float(np.hypot(corners[:, 0], corners[:, 1]).min())
            found.append((away, _contour(part, corners, track, now)))
        return found

    def _track(self, part: Cells, taken: set[int]) -> int:
        """Return the most frequent track of the cells, unless another contour uses it."""
        before, count = np.unique(part["track"], return_counts=True)
        numbers: list[int] = before[np.argsort(-count, kind="stable")].tolist()
        track = next((one for one in numbers if one and one not in taken), 0)
        if not track:
            self._tracks += 1
            track = self._tracks
        taken.add(track)
        return track


def step_of(camera: Camera) -> int:
    """Return the step of rows and columns by which its pictures are reduced."""
    return max(1, int(math.sqrt(camera.width * camera.height / MAX_PIXELS) + 0.35))


def reduced(camera: Camera, step: int) -> Camera:
    """Return a camera with only each `step`th row and column of pixels."""
    fx, fy, cx, cy = camera.pinhole
    return replace(
        camera,
        width=-(-camera.width // step),
        height=-(-camera.height // step),
        intrinsics=(fx / step, fy / step, cx / step, cy / step),
    )


def _believed(cells: Cells, labels: Labels) -> NDArray[np.bool_]:
    """Return a mask of groups of cells that are more than noise."""
    groups = int(labels.max()) + 1
    points = np.bincount(labels, cells["points"], groups)
    enough = np.zeros(groups, np.bool_)
    for kind, least in MIN_SEEN.items():
        of_kind = cells["kind"] == kind
        enough[labels[of_kind & (cells["seen"] >= least)]] = True
        if kind == OBSTACLE:
            top = np.full(groups, -np.inf)
            np.maximum.at(top, labels[of_kind], cells["top"][of_kind])
            low = (top < HIGH_M) & (np.bincount(labels[of_kind], minlength=groups) > 0)
            at_once = np.bincount(labels[of_kind], cells["points"][of_kind], groups)
            enough |= at_once >= AT_ONCE_POINTS
    return enough & ~low & (points >= LATER_POINTS)


def _contour(part: Cells, corners: Floats, track: int, now: float) -> Contour:
    age = max(0.0, now - float(part["stamp"].max()))
    kind = int(part["kind"].max())
    surety = min(1.0, (1.0 + float(part["seen"].max())) / (1.0 + CONFIRMED_PICTURES))
    return Contour(
        polygon=tuple(distinct(corners)),
        bottom=float(np.clip(part["bottom"].min(), -10.0, 10.0)),
        top=float(np.clip(part["top"].max() if kind in (OBSTACLE, COLOUR) else 0.0, -10.0, 10.0)),
        age=age,
        confidence=UNSURE.get(kind, 1.0) * surety * max(0.0, 1.0 - age / (2 * MAX_AGE_S)),
        track=track,
        source="floor_colour" if kind == COLOUR else "depth",
    )
