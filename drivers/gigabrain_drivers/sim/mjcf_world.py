"""MJCF models as worlds or parts of worlds: loads, checks and measures them."""

import logging
import math
import re
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np

from gigabrain_drivers.sim.world import Box, Shape, World
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import file_problem, read_bounded

MAX_MODEL_BYTES = 10_000_000
MAX_GEOMS, MAX_BODIES, MAX_EXTENT_M = 10_000, 800, 400.0
LOW_M, HIGH_M = 0.02, 1.0  # above the floor; geoms between them are obstacles
UPRIGHT = 0.999  # minimal cosine of the tilt of an upright geom
log = logging.getLogger(__name__)

FLOOR_NAME = re.compile(r"(^|/)(floor|ground)\d*$")  # names of floor geoms
COUNT = re.compile(rb"\bcount\s*=\s*[\"']([\d\s]{1,60})[\"']")  # of replicated parts
# after comments and declarations; atomic groups, or a hostile file would take for ever
URDF = re.compile(rb"(?>[^<]|<!--.*?-->|<\?.*?\?>|<![^-].*?>)*+<robot\b", re.DOTALL)
PLANE, BOX = mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_BOX


def load_model(path: Path) -> mujoco.MjSpec:
    """Load a world's MJCF. Raises ConfigError, with the line if MuJoCo names it."""
    mujoco.set_mju_user_warning(log.warning)  # not to MuJoCo's log file
    try:
        text = read_bounded(path, MAX_MODEL_BYTES)
        if urdf := URDF.match(text):
            line = urdf[0].count(b"\n") + 1
            raise ConfigError(f"{path}:{line}: a URDF; expected an MJCF model, with <mujoco>")
        counts = [int(number) for each in COUNT.findall(text) for number in each.split()]
        if math.prod(counts) > MAX_GEOMS:
            raise ConfigError(f"{path}: it repeats parts more than {MAX_GEOMS} times")
        return mujoco.MjSpec.from_file(str(path))
    except OSError as error:
        raise ConfigError(f"{path}: the world's model: {file_problem(error)}") from None
    except ValueError as error:
        raise model_error(path, error) from None


def model_error(path: Path, error: ValueError) -> ConfigError:
    """Return MuJoCo's error as one line, with the file's line if it is named."""
    text = " ".join(str(error).split())[:300]
    line = re.search(r"[Ll]ine(?: number=|:? )(\d+)", text)
    return ConfigError(f"{path}{f':{line[1]}' if line else ''}: not a usable MJCF model: {text}")


def measured(world: World) -> World:
    """Return the world with the outlines of its model's obstacles, enlarged to contain them.

    Raises ConfigError.
    """
    assert world.model
    try:
        model = load_model(world.model).compile()
    except ValueError as error:
        raise model_error(world.model, error) from None
    if model.ngeom > MAX_GEOMS:
        raise ConfigError(f"{world.model}: {model.ngeom} geoms; expected at most {MAX_GEOMS}")
    if model.nbody > MAX_BODIES:
        raise ConfigError(f"{world.model}: {model.nbody} bodies; expected at most {MAX_BODIES}")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    lowest = min(_floor_heights(model, data), default=0.0)
    if lowest > LOW_M:
        raise ConfigError(
            f"{world.model}: its floor is at a height of {lowest:g} m; expected 0, where robots "
            "start, or less for an arm that stands on something"
        )
    outlines = _outlines(model, data)
    if not all(abs(value) <= MAX_EXTENT_M for one in outlines for value in _bounds(one)):
        raise ConfigError(
            f"{world.model}: it reaches further than {MAX_EXTENT_M:g} m from its origin"
        )
    east, north = world.middle
    own = Box(east, north, max(world.half_x, 1.0), max(world.half_y, 1.0), 0.0)
    low_x, low_y, high_x, high_y = np.array([_bounds(one) for one in (own, *outlines)]).T
    box = float(low_x.min()), float(low_y.min()), float(high_x.max()), float(high_y.max())
    return replace(
        world,
        outlines=outlines,
        middle=((box[0] + box[2]) / 2, (box[1] + box[3]) / 2),
        half_x=(box[2] - box[0]) / 2,
        half_y=(box[3] - box[1]) / 2,
    )


def is_floor(model: mujoco.MjModel, geom: int) -> bool:
    """Return whether a geom is floor: a plane, or named floor or ground."""
    name = model.geom(geom).name
    return bool(model.geom_type[geom] == PLANE or FLOOR_NAME.search(name))


def has_floor(spec: mujoco.MjSpec) -> bool:
    """Return whether a model has its own floor."""
    return any(geom.type == PLANE or FLOOR_NAME.search(geom.name) for geom in spec.geoms)


def _floor_heights(model: mujoco.MjModel, data: mujoco.MjData) -> list[float]:
    """Return the heights of all level floors [m]; none unless all are planes or boxes."""
    floors = [
        (geom, kind)
        for geom, kind in enumerate(model.geom_type.tolist())
        if is_floor(model, geom) and model.geom_contype[geom]
    ]
    if any(kind not in (PLANE, BOX) for _, kind in floors):
        return []
    return [
        float(data.geom_xpos[geom, 2] + (0.0 if kind == PLANE else model.geom_size[geom, 2]))
        for geom, kind in floors
        if data.geom_xmat[geom, 8] > UPRIGHT
    ]


def _outlines(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[Shape, ...]:
    """Return a box round each obstacle."""
    found = []
    for geom in range(model.ngeom):
        if not (model.geom_contype[geom] or model.geom_conaffinity[geom]) or is_floor(model, geom):
            continue
        axes, offset = data.geom_xmat[geom].reshape(3, 3), model.geom_aabb[geom, :3]
        half = model.geom_aabb[geom, 3:]
        middle = data.geom_xpos[geom] + axes @ offset
        upright = abs(axes[2, 2]) > UPRIGHT
        reach = np.abs(axes) @ half
        if middle[2] - reach[2] > HIGH_M or middle[2] + reach[2] < LOW_M:
            continue
        size = half if upright else reach
        yaw = float(np.arctan2(axes[1, 0], axes[0, 0])) if upright else 0.0
        found.append(Box(
            float(middle[0]), float(middle[1]), float(size[0]), float(size[1]),
            float(2 * reach[2]), yaw=yaw,
        ))  # fmt: skip
    return tuple(found)


def _bounds(shape: Shape) -> tuple[float, float, float, float]:
    """Return the bounds of a box: min x, min y, max x, max y [m]."""
    assert isinstance(shape, Box)
    cos, sin = abs(np.cos(shape.yaw)), abs(np.sin(shape.yaw))
    reach_x = float(cos * shape.half_x + sin * shape.half_y)
    reach_y = float(sin * shape.half_x + cos * shape.half_y)
    return shape.x - reach_x, shape.y - reach_y, shape.x + reach_x, shape.y + reach_y
