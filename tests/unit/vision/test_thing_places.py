"""Places of things from the depth inside their boxes: the middle, for any face."""

import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_schemas.body import Camera
from gigabrain_zenoh.vision.camera_model import CameraModel, rotation
from gigabrain_zenoh.vision.thing_places import part_of_wall, thing_place

CAMERA = Camera(name="front", width=320, height=240, depth=True, x=0.1, z=0.2)
MODEL = CameraModel(CAMERA)
FAR = 4.0


def seen(model: CameraModel, surface, rng=None, noise: float = 0.0015):
    """Depth [mm] and the box of what `surface(origin, rays)` hits, before a wall at FAR."""
    rays = model.rays.reshape(3, -1).T.astype(float)
    with np.errstate(all="ignore"):
        depth = surface(model.origin, rays)
    hit = np.isfinite(depth) & (depth > 0)
    whole = np.where(hit, depth, FAR)
    if rng is not None:
        whole = whole + rng.normal(0, noise, whole.shape) * whole**2
        whole[rng.random(whole.shape) < 0.02] = 0
    rows, columns = np.nonzero(hit.reshape(model.rays.shape[1:]))
    box = (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
    return (whole * 1000).astype(np.uint16).reshape(model.rays.shape[1:]), tuple(map(float, box))


def ball(middle, radius):
    def surface(origin, rays):
        off = origin - np.array(middle)
        a, b = (rays * rays).sum(1), rays @ off
        root = b * b - a * (off @ off - radius**2)
        return np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.nan)

    return surface


def upright(middle, radius, height):
    """A cylinder on end."""

    def surface(origin, rays):
        off = (origin - np.array(middle))[:2]
        flat = rays[:, :2]
        a, b = (flat * flat).sum(1), flat @ off
        root = b * b - a * (off @ off - radius**2)
        depth = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.nan)
        z = origin[2] + depth * rays[:, 2] - middle[2]
        return np.where(np.abs(z) < height / 2, depth, np.nan)

    return surface


def cuboid(middle, half, yaw):
    turn = rotation(0, 0, yaw)

    def surface(origin, rays):
        off, turned = turn.T @ (origin - np.array(middle)), rays @ turn
        one, other = (-np.array(half) - off) / turned, (np.array(half) - off) / turned
        near, far = np.minimum(one, other).max(1), np.maximum(one, other).min(1)
        return np.where(near < far, near, np.nan)

    return surface


THINGS = [
    ("ball", lambda m: ball(m, 0.1), (0.2, 0.2)),
    ("ball", lambda m: ball(m, 0.05), (0.1, 0.1)),
    ("can", lambda m: upright(m, 0.035, 0.12), (0.07, 0.12)),
    ("cylinder", lambda m: upright(m, 0.12, 0.4), (0.24, 0.4)),
    ("cube", lambda m: cuboid(m, (0.08, 0.08, 0.08), 0.0), (0.16, 0.16)),
    ("cube", lambda m: cuboid(m, (0.08, 0.08, 0.08), 0.4), (0.21, 0.16)),
    ("cube", lambda m: cuboid(m, (0.08, 0.08, 0.08), 0.785), (0.226, 0.16)),
    ("box", lambda m: cuboid(m, (0.12, 0.15, 0.08), 0.2), (0.34, 0.16)),
]


@pytest.mark.parametrize(("label", "shape", "size"), THINGS)
@pytest.mark.parametrize("ahead", [0.7, 1.5, 2.5])
def test_the_middle_of_a_thing_is_within_3_cm_of_a_box_within_5(label, shape, size, ahead):
    middle = (ahead, 0.1 * ahead, 0.2)
    depth, box = seen(MODEL, shape(middle), np.random.default_rng(0))
    place = thing_place(label, box, MODEL, depth)
    assert place
    off = np.hypot(*(np.array(place.position) - middle)[:2])
    assert off < (0.05 if label == "box" else 0.03)  # as deep as wide is a guess
    assert place.position[2] == pytest.approx(0.2, abs=0.03)
    assert place.size == pytest.approx(size, abs=0.04, rel=0.16)


def test_a_leaning_camera_places_as_well():
    model = CameraModel(replace(CAMERA, z=0.5, pitch=0.35, yaw=-0.3))
    middle = (1.2, -0.4, 0.1)
    depth, box = seen(model, ball(middle, 0.1), np.random.default_rng(0))
    place = thing_place("ball", box, model, depth)
    assert place
    assert place.position == pytest.approx(middle, abs=0.02)


def test_holes_and_what_is_seen_behind_do_not_count():
    rng = np.random.default_rng(0)
    depth, box = seen(MODEL, ball((1.5, 0, 0.2), 0.12), rng)
    left, top, right, bottom = map(int, box)
    inner = depth[top:bottom, left:right]
    inner[rng.random(inner.shape) < 0.4] = int(FAR * 1000)
    inner[rng.random(inner.shape) < 0.3] = 0
    place = thing_place("ball", box, MODEL, depth)
    assert place
    assert place.position == pytest.approx((1.5, 0, 0.2), abs=0.03)


def test_a_thin_thing_before_it_does_not_count():
    depth, box = seen(MODEL, ball((1.5, 0, 0.2), 0.12), np.random.default_rng(0))
    depth[:, 158:162] = 700
    place = thing_place("ball", box, MODEL, depth)
    assert place
    assert place.position[0] == pytest.approx(1.5, abs=0.03)


def test_unknown_depth_gives_no_place():
    depth, box = seen(MODEL, ball((1.5, 0, 0.2), 0.12))
    assert thing_place("ball", box, MODEL, np.zeros_like(depth)) is None
    few = np.zeros_like(depth)
    few[int(box[1]) + 8, int(box[0]) + 8 : int(box[0]) + 12] = 1400
    assert thing_place("ball", box, MODEL, few) is None


def test_a_thing_that_is_cut_off_at_a_side_has_no_place_and_above_or_below_no_size():
    depth, _ = seen(MODEL, ball((1.0, 0, 0.2), 0.2), np.random.default_rng(0))
    assert thing_place("ball", (0, 80, 200, 160), MODEL, depth) is None
    assert thing_place("ball", (120, 80, 320, 160), MODEL, depth) is None
    place = thing_place("ball", (100, 0, 220, 180), MODEL, depth)
    assert place
    assert place.size is None


def wall(distance, yaw, y=0.0):
    """A wall that goes on to all sides, through the point (distance, y)."""
    normal = np.array((np.cos(yaw), np.sin(yaw), 0.0))

    def surface(origin, rays):
        depth = ((distance, y, 0.0) - origin) @ normal / (rays @ normal)
        return np.where(depth > 0, depth, np.nan)

    return surface


def nearest(*surfaces):
    return lambda origin, rays: np.fmin.reduce([one(origin, rays) for one in surfaces])


WALLS = {
    "across": wall(2.0, 0.0),
    "aslant": wall(2.0, 0.9),
    "far": wall(3.5, -0.4),
    "corner": nearest(wall(2.5, 0.7), wall(2.5, -0.7)),
}


@pytest.mark.parametrize("name", WALLS)
@pytest.mark.parametrize(
    "box",
    [
        (120.0, 60.0, 200.0, 140.0),
        (100.0, 40.0, 140.0, 200.0),
        (0.0, 30.0, 110.0, 180.0),
        (230.0, 80.0, 320.0, 150.0),
    ],
)
def test_a_part_of_a_wall_is_no_thing_but_doors_and_pictures_may_be(name, box):
    depth, _ = seen(MODEL, WALLS[name], np.random.default_rng(0))
    assert part_of_wall("box", box, MODEL, depth)
    assert not part_of_wall("door", box, MODEL, depth)
    assert not part_of_wall("picture", box, MODEL, depth)


@pytest.mark.long
@pytest.mark.parametrize(("label", "shape", "size"), THINGS)
@pytest.mark.parametrize("ahead", [0.7, 1.5, 2.5])
@pytest.mark.parametrize("gap", [0.0, 0.3])
def test_a_thing_before_a_wall_is_no_part_of_it(label, shape, size, ahead, gap):
    thing = shape((ahead, 0.1 * ahead, 0.2))
    behind = wall(ahead + size[0] / 2 + gap, 0.3, 0.1 * ahead)
    depth, _ = seen(MODEL, nearest(thing, behind), np.random.default_rng(0))
    _, (left, top, right, bottom) = seen(MODEL, thing)
    for off in (0.0, 0.08):  # a net's box is not exact
        less = off * (right - left)
        assert not part_of_wall(label, (left + less, top, right - less, bottom), MODEL, depth)
        assert not part_of_wall(label, (left - less, top, right + less, bottom), MODEL, depth)


PILLARS = upright((1.8, 0.5, 0.3), 0.15, 0.8), upright((1.8, -0.5, 0.3), 0.15, 0.8)


def test_a_wall_between_pillars_is_no_thing_and_what_stands_behind_one_of_them_is():
    depth, _ = seen(MODEL, nearest(wall(3.5, 0.2), *PILLARS), np.random.default_rng(0))
    assert part_of_wall("box", (105.0, 60.0, 215.0, 150.0), MODEL, depth)
    cube = cuboid((2.6, 0.35, 0.3), (0.2, 0.2, 0.2), 0.3)
    scene = nearest(cube, wall(3.5, 0.2), PILLARS[0])
    depth, _ = seen(MODEL, scene, np.random.default_rng(0))
    _, (_, top, right, bottom) = seen(MODEL, cube)
    _, (_, _, left, _) = seen(MODEL, PILLARS[0])
    assert left < right - 20
    assert not part_of_wall("cube", (left, top, right, bottom), MODEL, depth)


def test_a_box_that_spans_the_picture_or_unknown_depth_tells_nothing_of_walls():
    depth, _ = seen(MODEL, WALLS["across"])
    assert not part_of_wall("box", (0.0, 40.0, 320.0, 200.0), MODEL, depth)
    assert not part_of_wall("box", (100.0, 40.0, 200.0, 200.0), MODEL, np.zeros_like(depth))


@pytest.mark.parametrize("box", [(-50, -50, 400, 300), (100, 100, 100, 100), (319, 239, 320, 240),
                                 (5, -1e5, 50, 1e5)])  # fmt: skip
def test_boxes_of_any_kind_give_a_finite_place_or_none(box):
    for value in (0, 1, 800, 65535):
        depth = np.full((240, 320), value, np.uint16)
        place = thing_place("x", box, MODEL, depth)
        assert part_of_wall("box", box, MODEL, depth) in (True, False)
        assert place is None or np.isfinite(place.position).all()
