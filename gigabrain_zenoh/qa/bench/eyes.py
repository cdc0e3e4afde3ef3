"""Contours compared with MuJoCo's true shapes: errors, recall, false contours, ghosts, CPU."""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from statistics import mean
from typing import NamedTuple

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from gigabrain_drivers.cameras.depth_noise import NO_ERRORS, SENSOR, DepthErrors, DepthSensor
from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import BodyDescription, Camera
from gigabrain_schemas.brain import Contour
from gigabrain_schemas.vision import DepthImage, pack_depth
from gigabrain_zenoh.geometry.pose import ORIGIN, compose
from gigabrain_zenoh.host.bounded import percentile
from gigabrain_zenoh.qa.bench.eyes_worlds import (
    LIGHTS,
    TEXTURES,
    EyesWorld,
    Part,
    Renderer,
    distances,
    draw_world,
)
from gigabrain_zenoh.vision.camera_model import CameraModel
from gigabrain_zenoh.vision.obstacle_contours import ObstacleContours

PICTURES, PERIOD_S = 10, 0.1  # per cluttered world, while the robot drives on an arc
SPEED, TURN = 0.2, 0.2  # [m/s], [rad/s]
ERROR_REACH_M, RECALL_REACH_M = 3.0, 2.0  # largest distance from the robot that counts
STEP_M, EDGE_STEP_M = 0.02, 0.004  # between points of outlines
BEARING_STEP = math.radians(0.5)
MIN_SEEN_M = 0.028  # visible size of a thing that counts: 3 cm, less the size of a pixel
FOUND_M, FOUND_SHARE = 0.05, 0.5  # distance to a contour, and share of a thing's points within it
PIT_SEEN_M = 0.03  # least depth below the floor
FALSE_M = 0.10  # a contour farther than this from all things is false
GHOST_M = 0.03  # a contour nearer than this to a thing's old place is a ghost
GHOST_KINDS = ("gone", "walks off", "gone unseen")
SEEN_S, GHOST_WAIT_S = 1.0, 3.0


class EyesFigures(Struct, frozen=True, kw_only=True):
    """The figures measured with one kind of sensor."""

    sensor: str
    camera: str
    worlds: int
    error_p50_m: float  # from the first surface along each line of sight to the nearest outline
    error_p95_m: float
    beyond_p95_m: float  # from outlines to the true shapes
    missed_p95_m: float  # from visible points to outlines
    pit_p50_m: float
    pit_p95_m: float
    pits: int  # in view
    pits_found: float  # share
    things: int  # within reach of recall
    recall: float
    recall_first: float  # in the first picture
    false_in_clutter: int
    false_per_min: float  # on empty floors
    colour_per_min: float  # the same, by the floor's colour alone
    empty_pictures: int
    ghosts: int  # things that were removed
    ghost_p50_s: float
    ghost_max_s: float
    cpu_p50_ms: float
    cpu_p99_ms: float


class EyesResult(Struct, frozen=True, kw_only=True):
    """All figures, and the first seed."""

    seed: int
    figures: tuple[EyesFigures, ...]


@dataclass
class Eyes:
    """A body's contours, and its camera with errors, which sees a renderer's pictures."""

    body: BodyDescription
    errors: DepthErrors
    seed: int
    cpu_ms: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.camera: Camera = self.body.cameras[0]
        self.sensor = DepthSensor(self.camera, self.seed, self.errors)
        self.contours = ObstacleContours(self.body)

    def see(
        self, renderer: Renderer, pose: Pose, now: float, thing: tuple[float, float] = (0.0, 0.0)
    ) -> tuple[Contour, ...]:
        """Take one more picture and return the contours."""
        renderer.move(pose, self.sensor.mounted, thing)
        pixels = self.sensor.measure(renderer.depth())
        height, width = pixels.shape
        image = DepthImage(
            frame_id=self.camera.name, height=height, width=width, planes=pack_depth(pixels)
        )
        begin = time.thread_time()
        self.contours.add_depth(self.camera.name, image, pose, now)
        found = self.contours.contours(pose, now)
        self.cpu_ms.append((time.thread_time() - begin) * 1e3)
        return found


@dataclass
class ClutterScores:
    """Scores of all cluttered worlds: errors [m], and found pits and things."""

    front: list[float] = field(default_factory=list)
    beyond: list[float] = field(default_factory=list)
    missed: list[float] = field(default_factory=list)
    pit: list[float] = field(default_factory=list)
    pits: list[bool] = field(default_factory=list)
    found: list[bool] = field(default_factory=list)
    found_first: list[bool] = field(default_factory=list)
    wrong: int = 0


def measure_eyes(
    bodies: Sequence[BodyDescription],
    worlds: int,
    seconds: float,
    ghosts: int,
    seed: int,
    show: Callable[[str], None],
) -> EyesResult:
    """Measure the first camera of each body, with and without a sensor's errors.

    It drives for `seconds` on each of 15 empty floors. Raises ConfigError if rendering fails.
    """
    figures = []
    for body in bodies:
        for name, errors in (("sensor", SENSOR), ("no errors", NO_ERRORS)):
            show(f"{body.robot_type}, {name}: {worlds} worlds")
            cpu: list[float] = []
            scores = ClutterScores()
            for number in range(seed, seed + worlds):
                _judge_clutter(Eyes(body, errors, number, cpu), draw_world(number), scores)
            show(f"{body.robot_type}, {name}: empty floors")
            empty = _empty_floors(body, errors, seconds, seed)
            show(f"{body.robot_type}, {name}: {ghosts} ghosts")
            times = [
                _ghost_duration(Eyes(body, errors, number), number)
                for number in range(seed, seed + ghosts)
            ]
            figures.append(_figures(body, name, scores, empty, times, cpu, worlds))
    return EyesResult(seed=seed, figures=tuple(figures))


def _figures(
    body: BodyDescription,
    sensor: str,
    scores: ClutterScores,
    empty: "EmptyFloors",
    ghosts: list[float],
    cpu: list[float],
    worlds: int,
) -> EyesFigures:
    return EyesFigures(
        sensor=sensor,
        camera=body.cameras[0].name,
        worlds=worlds,
        error_p50_m=_percentile(scores.front, 0.5),
        error_p95_m=_percentile(scores.front, 0.95),
        beyond_p95_m=_percentile(scores.beyond, 0.95),
        missed_p95_m=_percentile(scores.missed, 0.95),
        pit_p50_m=_percentile(scores.pit, 0.5),
        pit_p95_m=_percentile(scores.pit, 0.95),
        pits=len(scores.pits),
        pits_found=mean(scores.pits) if scores.pits else 1.0,
        things=len(scores.found),
        recall=mean(scores.found) if scores.found else 1.0,
        recall_first=mean(scores.found_first) if scores.found_first else 1.0,
        false_in_clutter=scores.wrong,
        false_per_min=empty.by_depth / (empty.pictures * PERIOD_S / 60),
        colour_per_min=empty.by_colour / (empty.pictures * PERIOD_S / 60),
        empty_pictures=empty.pictures,
        ghosts=len(ghosts),
        ghost_p50_s=_percentile(ghosts, 0.5),
        ghost_max_s=max(ghosts, default=0.0),
        cpu_p50_ms=_percentile(cpu, 0.5),
        cpu_p99_ms=_percentile(cpu, 0.99),
    )


def _percentile(values: Sequence[float], share: float) -> float:
    return round(percentile(sorted(values), share) or 0.0, 4)


def _pose_on_arc(picture: int, turn: float = TURN) -> Pose:
    """Return the robot's pose at a picture's number, on an arc from the origin."""
    yaw = turn * picture * PERIOD_S
    if not turn:
        return Pose(x=SPEED * picture * PERIOD_S, y=0.0, yaw=0.0)
    return Pose(x=SPEED / turn * math.sin(yaw), y=SPEED / turn * (1 - math.cos(yaw)), yaw=yaw)


def _judge_clutter(eyes: Eyes, world: EyesWorld, scores: ClutterScores) -> None:
    """Drive in a cluttered world, and judge the contours after the last picture."""
    turn = TURN if eyes.seed % 2 else -TURN
    with Renderer(world, eyes.camera) as renderer:
        for number in range(PICTURES):
            pose = _pose_on_arc(number, turn)
            contours = eyes.see(renderer, pose, number * PERIOD_S)
            if number == 0:
                scores.found_first += _found_things(_Truth(eyes, renderer, world, pose), contours)
        truth = _Truth(eyes, renderer, world, pose)
    scores.found += _found_things(truth, contours)
    _judge_outlines(truth, contours, scores)


class _Truth:
    """The true view of a camera without errors, in the world's frame."""

    def __init__(self, eyes: Eyes, renderer: Renderer, world: EyesWorld, pose: Pose) -> None:
        self.world, self.pose, self.height = world, pose, eyes.body.body_height
        model = CameraModel(eyes.sensor.mounted)
        depth, part = renderer.depth(), renderer.parts()
        seen = (part >= 0) & (depth < eyes.camera.depth_max) & (depth > eyes.camera.depth_min)
        points = (model.rays[:, seen] * depth[seen]).T.astype(np.float64) + model.origin
        self.pit = self._pit_seen(model, depth, part)
        low = (points[:, 2] > 0.0) & (points[:, 2] < self.height)
        self.away = np.hypot(points[low, 0], points[low, 1])
        self.points: Floats = np.column_stack((_to_world(pose, points[low, :2]), points[low, 2]))
        owners = np.array([one.thing for one in world.parts], np.intp)
        self.thing = owners[part[seen][low]] if len(owners) else np.empty(0, np.intp)

    def _pit_seen(
        self, model: CameraModel, depth: NDArray[np.float32], part: NDArray[np.int32]
    ) -> Floats:
        """Return the points (n, 2) [m] where lines of sight into a pit cross the floor."""
        down = (part < 0) & (model.rays[2] * depth + model.origin[2] < -PIT_SEEN_M)
        rays = model.rays[:, down].astype(np.float64)
        through = (rays[:2] * (-model.origin[2] / rays[2])).T + model.origin[:2]
        return _to_world(self.pose, through)


def _to_world(pose: Pose, points: Floats) -> Floats:
    cos, sin = math.cos(pose.yaw), math.sin(pose.yaw)
    return np.asarray(points @ np.array([[cos, sin], [-sin, cos]]) + (pose.x, pose.y))


def _outlines(pose: Pose, contours: Sequence[Contour], *, holes: bool) -> list[Floats]:
    return [
        _to_world(pose, np.array(one.polygon)) for one in contours if (one.bottom < 0.0) == holes
    ]


def _found_things(truth: _Truth, contours: Sequence[Contour]) -> list[bool]:
    """Return for each visible, near and large enough thing whether contours cover it."""
    outlines = _outlines(truth.pose, contours, holes=False)
    found = []
    for number in np.unique(truth.thing).tolist():
        points = truth.points[truth.thing == number]
        away = truth.away[truth.thing == number]
        if (
            away.max() > RECALL_REACH_M
            or np.ptp(points[:, 2]) < MIN_SEEN_M
            or _width(points, truth.pose) < MIN_SEEN_M
        ):
            continue
        covered = distances(outlines, points[:, :2]) < FOUND_M
        found.append(bool(covered.mean() >= FOUND_SHARE))
    return found


def _width(points: Floats, pose: Pose) -> float:
    """Return the extent of points (n, 3) across the line of sight [m]."""
    x, y = points[:, 0] - pose.x, points[:, 1] - pose.y
    bearing = math.atan2(y.mean(), x.mean())
    return float(np.ptp(y * math.cos(bearing) - x * math.sin(bearing)))


def _judge_outlines(truth: _Truth, contours: Sequence[Contour], scores: ClutterScores) -> None:
    """Add the distances from outlines to true shapes, and from true points to outlines."""
    solids, pit = truth.world.solids(truth.height), truth.world.pit
    here = np.array((truth.pose.x, truth.pose.y))
    outlines = _outlines(truth.pose, contours, holes=False)
    for outline in outlines:
        samples = _points_along(outline)
        samples = samples[np.hypot(*(samples - here).T) < ERROR_REACH_M]
        off = distances(solids, samples)
        scores.wrong += bool(len(off) and off.min() > FALSE_M)
        scores.beyond += off[np.isfinite(off)].tolist()
    reach = truth.points[truth.away < ERROR_REACH_M]
    cells = np.unique(np.round(reach[:, :2] / STEP_M), axis=0) * STEP_M
    scores.missed += np.minimum(distances(outlines, cells), 1.0).tolist()
    scores.front += np.minimum(_edge_distances(outlines, _nearest_points(truth)), 1.0).tolist()
    holes = _outlines(truth.pose, contours, holes=True)
    off_pit = [distances([pit.outline] if pit else [], _points_along(one)) for one in holes]
    scores.wrong += sum(bool(off.min() > 3 * FALSE_M) for off in off_pit)
    if pit and len(truth.pit):
        edge = np.linspace(-1, 1, 21)[:, None] * (0.0, pit.half_y) + (pit.x - pit.half_x, pit.y)
        edge = edge[[np.hypot(*(truth.pit - one).T).min() < FALSE_M for one in edge]]
        if not len(edge):
            return
        gaps = distances(holes, edge)
        scores.pits.append(bool(gaps.min() < 2 * FALSE_M))
        scores.pit += np.minimum(gaps, 1.0).tolist()
        scores.pit += np.concatenate([*off_pit, np.empty(0)]).tolist()


def _nearest_points(truth: _Truth) -> Floats:
    """Return the nearest point along each line of sight (n, 2), in steps of BEARING_STEP."""
    reach = truth.away < ERROR_REACH_M
    points, away = truth.points[reach, :2], truth.away[reach]
    bearing = np.arctan2(points[:, 1] - truth.pose.y, points[:, 0] - truth.pose.x)
    step = np.round(bearing / BEARING_STEP).astype(np.intp)
    order = np.lexsort((away, step))
    return points[order[np.flatnonzero(np.diff(step[order], prepend=-9999))]]


def _edge_distances(outlines: Sequence[Floats], points: Floats) -> Floats:
    """Return the distance of each point (n, 2) to the nearest edge [m], inside as well."""
    if not outlines or not len(points):
        return np.full(len(points), np.inf)
    samples = np.concatenate([_points_along(one, EDGE_STEP_M) for one in outlines])
    off = points[:, None] - samples
    return np.asarray(np.hypot(off[..., 0], off[..., 1]).min(axis=1))


def _points_along(outline: Floats, step: float = STEP_M) -> Floats:
    """Return points along an outline (n, 2), at most `step` [m] apart."""
    parts = []
    for begin, end in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        count = int(math.dist(begin, end) / step) + 1
        parts.append(begin + (end - begin) * (np.arange(count) / count)[:, None])
    return np.concatenate(parts)


class EmptyFloors(NamedTuple):
    """Numbers of contours on empty floors, and of pictures taken there."""

    by_depth: int
    by_colour: int
    pictures: int


def _empty_floors(
    body: BodyDescription, errors: DepthErrors, seconds: float, seed: int
) -> EmptyFloors:
    """Drive on empty floors; count the contours by depth, and by colour alone."""
    depth = colour = 0
    count = max(1, round(seconds / PERIOD_S))
    for number, (texture, light) in enumerate((t, one) for t in TEXTURES for one in LIGHTS):
        eyes = Eyes(body, errors, seed + number)
        by_colour = ObstacleContours(body)
        found: set[int] = set()
        coloured: set[int] = set()
        with Renderer(EyesWorld(texture=texture, light=light), eyes.camera) as renderer:
            for picture in range(count):
                pose = _pose_on_arc(picture, 0.3 if picture % 100 < 50 else -0.3)
                now = picture * PERIOD_S
                found |= {one.track for one in eyes.see(renderer, pose, now)}
                by_colour.add_colour(eyes.camera.name, renderer.colour(), pose, now)
                coloured |= {one.track for one in by_colour.contours(pose, now)}
        depth, colour = depth + len(found), colour + len(coloured)
    return EmptyFloors(depth, colour, count * len(TEXTURES) * len(LIGHTS))


def _ghost_duration(eyes: Eyes, seed: int) -> float:
    """Return how long a removed thing's contour stays after its place is seen empty [s]."""
    random = np.random.default_rng(np.random.SeedSequence((seed, 19)))
    kind = GHOST_KINDS[seed % len(GHOST_KINDS)]
    away, angle = random.uniform(0.7, 2.5), random.uniform(-0.3, 0.3)
    x, y = away * math.cos(angle), away * math.sin(angle)
    half, tall = random.uniform(0.03, 0.15), random.choice((0.05, 0.15, 0.4, 1.7))
    bottom = random.choice((0.0, 0.0, 0.1))
    thing = Part(0, x, y, half, half, max(tall, bottom + 0.03), bottom, random.uniform(0, 3))
    looks_away = compose(ORIGIN, Pose(x=0.0, y=0.0, yaw=2.5))
    behind = Part(1, random.uniform(3.0, 5.0), 0.0, 0.05, 8.0, 2.5)
    with Renderer(EyesWorld((thing,), backdrop=behind), eyes.camera) as renderer:
        for now, pose, at, counts in _ghost_story(kind, looks_away):
            found = eyes.see(renderer, pose, now, at)
            if counts is not None and not _has_ghost(pose, found, thing.outline, at):
                return counts
    return GHOST_WAIT_S


def _ghost_story(
    kind: str, aside: Pose
) -> Iterator[tuple[float, Pose, tuple[float, float], float | None]]:
    """Yield time [s], pose, shift of the thing [m], and time since it is seen to be gone [s]."""
    far = (100.0, 0.0)
    pictures = round(SEEN_S / PERIOD_S)
    for number in range(pictures):
        yield number * PERIOD_S, ORIGIN, (0.0, 0.0), None
    begin = pictures
    if kind == "gone unseen":
        for number in range(begin, begin + 5):
            yield number * PERIOD_S, aside, far, None
        begin += 5
    walks = [0.1 * step for step in range(1, 6)] if kind == "walks off" else []  # 1 m/s
    for number, step in enumerate(walks):
        yield (begin + number) * PERIOD_S, ORIGIN, (0.0, step), None
    begin += len(walks)
    for number in range(round(GHOST_WAIT_S / PERIOD_S)):
        at = (0.0, 0.5) if walks else far
        yield (begin + number) * PERIOD_S, ORIGIN, at, number * PERIOD_S


def _has_ghost(
    pose: Pose, contours: Sequence[Contour], stood: Floats, moved: tuple[float, float]
) -> bool:
    """Return whether a contour covers the thing's old place, and not only its new one."""
    now = stood + moved
    for outline in _outlines(pose, contours, holes=False):
        samples = _points_along(outline)
        if distances([stood], samples).min() < GHOST_M and distances([now], samples).max() > 0.1:
            return True
    return False
