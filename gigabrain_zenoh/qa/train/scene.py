"""Draws a scene in a studio: room, lights, camera, paints and poses. Renders it with labels."""

import math
from dataclasses import dataclass

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.qa.train import textures
from gigabrain_zenoh.qa.train.distractors import OCCLUDERS, is_table
from gigabrain_zenoh.qa.train.looks import Random, about
from gigabrain_zenoh.qa.train.studio import RGB, Studio, Thing
from gigabrain_zenoh.vision.labels import CLASSES
from gigabrain_zenoh.vision.recognizer import HEIGHT_PX, WIDTH_PX

FAR_M = 4.0
MAX_THINGS = 6
# A thing of which less is visible is ignored.
MIN_FRACTION, MIN_INSIDE, MIN_PIXELS, MIN_SIDE_PX = 0.4, 0.5, 60, 6
SMALL_M = 0.4  # lower things may stand on a table
TRIES = 30  # to find a free place
MIN_DRAWN_PX = 14.0  # least size in the picture, which limits the distance of a thing
OCCLUDED = 0.95  # share of things for which an occluder is tried
SHARES = np.array((14, 14, 10, 14, 11, 9, 11, 11, 6)) / 100  # of the classes, in their order
TEXTURED = {"label": 0.6, "print": 0.6, "shirt": 0.4, "leaf": 0.3, "wall": 0.4, "carton": 0.0}
VIVID = {  # chance of a bright colour, by class; otherwise it is close to grey
    "": 0.2, "cube": 0.9, "ball": 0.8, "cylinder": 0.8, "can": 0.8, "box": 0.2, "person": 0.4,
    "robot": 0.5, "charger": 0.2, "door": 0.2,
}  # fmt: skip
# hue [deg] and its spread, range of saturation, range of value
HUES = {
    "carton": ((29.0, 4.0), (0.25, 0.5), (0.5, 0.9)),
    "tape": ((35.0, 4.0), (0.0, 0.5), (0.45, 0.95)),
    "skin": ((20.0, 4.0), (0.3, 0.6), (0.3, 0.95)),
    "hair": ((27.0, 6.0), (0.0, 0.6), (0.05, 0.7)),
}


@dataclass(frozen=True)
class Truth:
    """One thing in a picture: its class, and the box of its visible part [px]."""

    label: int
    box: tuple[int, int, int, int]  # left, top, right, bottom
    fraction: float  # share of its pixels that is not hidden
    ignored: bool  # too little of it is visible


@dataclass(frozen=True)
class Split:
    """The textures, proportions and lights that may be drawn."""

    families: tuple[textures.Family, ...]
    wide: int
    other_lights: bool


SPLITS = {
    "train": Split(textures.TRAIN, 0, False),
    "test": Split(textures.TEST, 0, True),
    "other": Split(textures.TEST, 1, True),
}


class StudioScene:
    """One picture's scene; `render` after `draw`."""

    def __init__(self, studio: Studio, split: Split, rng: Random) -> None:
        self._studio, self._split, self._rng = studio, split, rng
        self._model, self._data = studio.model, studio.data
        self._placed: list[tuple[Thing, float, float]] = []  # with x, y

    def draw(self) -> None:
        """Draw everything for one picture."""
        rng = self._rng
        self._camera()
        self._room()
        self._lights()
        kinds = self._studio.things
        wanted = [t for t in kinds if t.look.label]
        labels = rng.choice(len(CLASSES), min(1 + rng.poisson(2.2), MAX_THINGS), p=SHARES)
        tables = [t for t in kinds if is_table(t.look)]
        table = tables[rng.integers(len(tables))] if rng.random() < 0.3 else None
        if table and not self._put(table, rng.uniform(0.9, 3.5)):
            table = None
        for label in labels:
            free = [t for t in wanted if t.look.label == CLASSES[label] and not self._is_placed(t)]
            if free:
                self._put_wanted(free[rng.integers(len(free))], table)
        others = [t for t in kinds if not t.look.label and t is not table]
        for _ in range(int(rng.integers(0, 4))):
            thing = others[rng.integers(len(others))]
            if not self._is_placed(thing):
                self._put(thing, rng.uniform(0.8, 5.0))
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)

    def render(self) -> tuple[NDArray[np.uint8], list[Truth]]:
        """Return the picture, RGB, and the things in it."""
        studio = self._studio
        things = [thing for thing, _, _ in self._placed]
        studio.show(things)
        picture, owners = studio.picture(), studio.owners()
        truths = []
        for thing in things:
            number = studio.things.index(thing)
            seen = owners == number
            if thing.look.label and seen.any():
                studio.show([thing], room=False, labelled=True)
                alone = int((studio.owners() == number).sum())
                truths.append(_truth(thing, seen, alone, self._is_cut(thing, number, seen)))
        return expose(self._rng, picture), truths

    def _is_cut(self, thing: Thing, number: int, seen: NDArray[np.bool_]) -> bool:
        """Return whether most of a thing that should fit is outside the picture."""
        edges = seen[0].any() or seen[-1].any() or seen[:, 0].any() or seen[:, -1].any()
        if not (thing.look.fits and edges):
            return False
        fovy = self._model.cam_fovy[0]
        self._model.cam_fovy[0] = math.degrees(2 * math.atan(2 * math.tan(self._fovy / 2)))
        mujoco.mj_camlight(self._model, self._data)
        whole = 4 * int((self._studio.owners() == number).sum())
        self._model.cam_fovy[0] = fovy
        return int(seen.sum()) < MIN_INSIDE * whole

    def _is_placed(self, thing: Thing) -> bool:
        return any(thing is placed for placed, _, _ in self._placed)

    def _camera(self) -> None:
        rng, model = self._rng, self._model
        self._height = rng.uniform(0.1, 0.6) if rng.random() < 0.75 else rng.uniform(0.6, 1.4)
        self._fovy = math.radians(rng.uniform(36, 56))
        pitch = rng.normal(0.03 + 0.12 * self._height, 0.1)  # down
        roll = rng.normal(0, 0.03)
        forward = np.array([math.cos(pitch), 0, -math.sin(pitch)])
        right = np.cross(forward, (0, 0, 1))
        right /= np.linalg.norm(right)
        up = np.cross(right, forward)
        right, up = (
            right * math.cos(roll) + up * math.sin(roll),
            up * math.cos(roll) - right * math.sin(roll),
        )
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, np.stack([right, up, -forward], axis=1).ravel())
        model.cam_pos[0], model.cam_quat[0] = (0, 0, self._height), quaternion
        model.cam_fovy[0] = math.degrees(self._fovy)

    def _room(self) -> None:
        rng, model = self._rng, self._model
        self._front, left, right = rng.uniform(3.5, 9), rng.uniform(1.2, 6), rng.uniform(1.2, 6)
        self._sides = (-right, left)
        high = rng.uniform(1.3, 2.0) if rng.random() < 0.8 else rng.uniform(0.3, 0.9)
        walls = {
            "front": ((self._front, 0, high), about((0, 1, 0), -math.pi / 2), (high, 12)),
            "left": ((0, left, high), about((1, 0, 0), math.pi / 2), (12, high)),
            "right": ((0, -right, high), about((1, 0, 0), -math.pi / 2), (12, high)),
        }
        for name, (at, turn, size) in walls.items():
            geom = model.geom(name)
            geom.pos, geom.quat, geom.size[:2] = at, turn, size
        common = rng.integers(len(self._studio.flat_textures))  # for most walls
        for name in ("floor", "front", "left", "right"):
            material = model.material(name).id
            other = rng.integers(len(self._studio.flat_textures))
            number = other if name == "floor" or rng.random() < 0.2 else common
            plain = rng.random() < 0.35
            colour = textures.colour(rng, 0.1, 0.4)
            self._paint(material, -1 if plain else self._studio.flat_textures[number], colour)
            model.mat_texrepeat[material] = rng.uniform(0.3, 2.5)
            shines = name == "floor" and rng.random() < 0.1
            model.mat_reflectance[material] = rng.uniform(0, 0.15) if shines else 0

    def _paint(self, material: int, texture: int, colour: NDArray[np.float32]) -> None:
        rng, model = self._rng, self._model
        model.mat_texid[material, RGB] = texture
        if texture >= 0:
            colour = 0.65 + 0.35 * colour
        model.mat_rgba[material, :3] = colour
        model.mat_specular[material] = rng.uniform(0, 0.5)
        model.mat_shininess[material] = rng.uniform(0, 0.6)

    def _lights(self) -> None:
        rng, model, other = self._rng, self._model, self._split.other_lights
        warm = rng.uniform(0.1, 0.25) if other else rng.uniform(0, 0.1)
        tint = (
            1 - warm * np.array([0, 0.4, 1])
            if rng.random() < 0.5
            else 1 - warm * np.array([1, 0.4, 0])
        )
        total = rng.uniform(0.55, 1.2)
        ambient = rng.uniform(0.15, 0.5)
        model.vis.headlight.ambient[:] = ambient * total * tint
        model.vis.headlight.diffuse[:] = rng.uniform(0, 0.35) * total if rng.random() < 0.5 else 0
        model.vis.headlight.specular[:] = 0.1
        active = int(rng.integers(1, 4))
        for n in range(3):
            model.light_active[n] = n < active
            low, high = _elevation(rng, other)
            azimuth, up = rng.uniform(0, 2 * math.pi), rng.uniform(low, high)
            towards = (
                math.cos(azimuth) * math.cos(up),
                math.sin(azimuth) * math.cos(up),
                math.sin(up),
            )
            distance = rng.uniform(2.5, 5)
            model.light_pos[n] = np.array((1.8, 0, 0.3)) + distance * np.array(towards)
            model.light_dir[n] = -np.array(towards)
            model.light_type[n] = (
                mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
                if rng.random() < 0.6
                else mujoco.mjtLightType.mjLIGHT_SPOT
            )
            model.light_cutoff[n], model.light_exponent[n] = rng.uniform(40, 80), rng.uniform(0, 6)
            model.light_castshadow[n] = n == 0 and rng.random() < 0.45
            model.light_diffuse[n] = tint * total * rng.uniform(0.3, 0.9) / math.sqrt(active)
            model.light_specular[n] = rng.uniform(0.1, 0.5)

    def _put_wanted(self, thing: Thing, table: Thing | None) -> None:
        """Put a thing on the floor, or sometimes on the table, often behind an occluder."""
        rng = self._rng
        if (
            table
            and thing.look.height < SMALL_M
            and rng.random() < 0.6
            and self._put_on(thing, table)
        ):
            return
        # far things are small: sometimes draw the inverse of the distance, to have more near ones
        near, far = thing.look.nearest, self._farthest(thing)
        if rng.random() < 0.5:
            distance = 1 / rng.uniform(1 / far, 1 / near)
        else:
            distance = rng.uniform(near, far)
        if self._put(thing, distance) and rng.random() < OCCLUDED:
            self._hide(thing)

    def _farthest(self, thing: Thing) -> float:
        """Return the largest distance at which a thing is large enough in the picture [m]."""
        focal = HEIGHT_PX / 2 / math.tan(self._fovy / 2)
        side = min(2 * thing.look.radius, thing.look.height)
        return max(thing.look.nearest + 0.1, min(FAR_M, focal * side / MIN_DRAWN_PX))

    def _hide(self, thing: Thing) -> None:
        """Put an occluder in front of the newest thing, to hide a part of it."""
        rng = self._rng
        _, x, y = self._placed[-1]
        distance, side = math.hypot(x, y), rng.choice([-1, 1])
        pool = self._occluders() if rng.random() < 0.85 else self._hiding_things()
        for _ in range(20):
            other = pool[rng.integers(len(pool))]
            gap = thing.look.radius + other.look.radius + rng.uniform(0.02, 0.4)
            near = distance - gap
            if self._is_placed(other) or near < max(0.35, other.look.nearest * 0.6):
                continue
            half = (other.look.hides or other.look.radius) * distance / near
            aside = half + (thing.look.hides or thing.look.radius) * rng.uniform(0.1, 0.95)
            if self._put(other, near, math.atan2(y, x) + side * aside / distance):
                return

    def _occluders(self) -> list[Thing]:
        first = next(n for n, thing in enumerate(self._studio.things) if not thing.look.label)
        return self._studio.things[first : first + len(OCCLUDERS)]

    def _hiding_things(self) -> list[Thing]:
        return [t for t in self._studio.things if t.look.label not in ("", "door")]

    def _put(self, thing: Thing, distance: float, bearing: float | None = None) -> bool:
        """Put a thing at a free place on the floor; return False if there is none."""
        rng, look = self._rng, thing.look
        half = math.atan(math.tan(self._fovy / 2) * WIDTH_PX / HEIGHT_PX)
        for _ in range(TRIES if bearing is None else 1):
            angle = rng.uniform(-half, half) * 0.95 if bearing is None else bearing
            x, y = distance * math.cos(angle), distance * math.sin(angle)
            low, high = self._sides
            if x > self._front - 0.2 or not low + 0.1 < y < high - 0.1:
                continue
            if all(
                math.hypot(x - u, y - v) > look.radius + t.look.radius for t, u, v in self._placed
            ):
                self._set(thing, x, y, 0.0)
                return True
        return False

    def _put_on(self, thing: Thing, table: Thing) -> bool:
        """Put a small thing at a free place on the table; return False if there is none."""
        rng, size = self._rng, table.look.parts[0].size
        _, x, y = next(placed for placed in self._placed if placed[0] is table)
        if math.hypot(x, y) > self._farthest(thing):
            return False
        if self._height < table.look.height - 0.1 and rng.random() < 0.6:
            return False  # the camera does not see the table's top
        turn = 2 * math.atan2(
            self._data.mocap_quat[table.mocap, 3], self._data.mocap_quat[table.mocap, 0]
        )
        for _ in range(TRIES):
            u, v = rng.uniform(-1, 1, 2) * (np.array(size[:2]) - thing.look.radius)
            at_x, at_y = (
                x + u * math.cos(turn) - v * math.sin(turn),
                y + u * math.sin(turn) + v * math.cos(turn),
            )
            near = [(t, a, b) for t, a, b in self._placed if t is not table]
            if all(
                math.hypot(at_x - a, at_y - b) > thing.look.radius + t.look.radius
                for t, a, b in near
            ):
                self._set(thing, at_x, at_y, table.look.height)
                return True
        return False

    def _set(self, thing: Thing, x: float, y: float, z: float) -> None:
        """Put a thing at a place [m], with a random turn and random colours."""
        rng, look = self._rng, thing.look
        yaw = math.atan2(y, x) + math.pi + rng.uniform(-look.facing, look.facing)
        turn = np.array(about((0, 0, 1), yaw))
        if look.lies and rng.random() < look.lies:
            lying = np.zeros(4)
            mujoco.mju_mulQuat(lying, turn, np.array(about((0, 1, 0), math.pi / 2)))
            turn, z = lying, z + look.radius
        self._data.mocap_pos[thing.mocap], self._data.mocap_quat[thing.mocap] = (x, y, z), turn
        self._placed.append((thing, x, y))
        for paint, material in thing.paints.items():
            self._repaint(look.label, paint, material)

    def _repaint(self, label: str, paint: str, material: int) -> None:
        """Draw colour and texture of a material, by its paint and the thing's class."""
        rng = self._rng
        textured = rng.random() < TEXTURED.get(paint, 0.25)
        if paint in HUES:
            (hue, spread), saturation, value = HUES[paint]
            colour = _hsv(
                hue + rng.normal(0, spread), rng.uniform(*saturation), rng.uniform(*value)
            )
            textured = False
        elif paint in ("label", "print", "shirt", "band"):
            colour = textures.colour(rng, 0.8, 0.3)
        else:
            colour = textures.colour(rng, VIVID[label], 0.3)
        cubes = self._studio.cube_textures
        self._paint(material, cubes[rng.integers(len(cubes))] if textured else -1, colour)


def _elevation(rng: Random, other: bool) -> tuple[float, float]:
    """Return the range of a light's elevation [rad]; training and test ranges do not overlap."""
    if other:
        return 0.35, 0.75
    return (0.75, 1.5) if rng.random() < 0.7 else (0.0, 0.35)


def expose(rng: Random, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Set the mean brightness like a camera's automatic exposure."""
    gain = np.clip(rng.uniform(90, 140) / max(float(picture.mean()), 1.0), 0.6, 4.0)
    return np.asarray(np.clip(picture * gain, 0, 255), np.uint8)


def _hsv(hue: float, saturation: float, value: float) -> NDArray[np.float32]:
    hsv = np.array([[[hue % 360, np.clip(saturation, 0, 1), np.clip(value, 0, 1)]]], np.float32)
    return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0, 0], np.float32)


def _truth(thing: Thing, seen: NDArray[np.bool_], alone: int, is_cut: bool) -> Truth:
    rows, columns = np.flatnonzero(seen.any(1)), np.flatnonzero(seen.any(0))
    box = (int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1)
    pixels = int(seen.sum())
    fraction = min(1.0, pixels / max(alone, 1))
    side = min(box[2] - box[0], box[3] - box[1])
    ignored = is_cut or fraction < MIN_FRACTION or pixels < MIN_PIXELS or side < MIN_SIDE_PX
    return Truth(CLASSES.index(thing.look.label), box, fraction, ignored)
