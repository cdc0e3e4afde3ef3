"""Distances of an arm's shapes by MuJoCo, from the text of its model.

Imported where an arm is described, since MuJoCo takes memory and time that a base need not pay.
"""

import re
from typing import NamedTuple

import mujoco
import numpy as np
from mujoco import mj_geomDistance
from numpy.typing import NDArray

from gigabrain_schemas.body import MAX_MODEL_CHARACTERS, BodyDescription
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.safety.arm_motion import Kind, Near

FLOOR = "the floor"
KEEP_OUT = "keep_out/"  # begins the names of boxes in the compiled model
REFUSED = re.compile(
    r"<\s*(include|mesh|hfield|skin|flex|flexcomp|composite|plugin|attach|model)\b"
)
FILES = re.compile(r"\b(file|fileright|fileleft|fileup|filedown|filefront|fileback)\s*=")
NEXT, LAST = (1, 2, 0), (2, 0, 1)  # of the axes x, y, z
TOUCH_M = 1e-9
SLIDE = mujoco.mjtJoint.mjJNT_SLIDE.value
FLAT = mujoco.mjtGeom.mjGEOM_PLANE.value
BOX = mujoco.mjtGeom.mjGEOM_BOX.value
CAPSULE = mujoco.mjtGeom.mjGEOM_CAPSULE.value
ELLIPSOID = mujoco.mjtGeom.mjGEOM_ELLIPSOID.value
SPHERE = mujoco.mjtGeom.mjGEOM_SPHERE.value
Floats = NDArray[np.float64]
Indices = NDArray[np.int64]


class _Poses(NamedTuple):
    """The poses of shapes and joints in some postures."""

    positions: Floats  # (postures, movable joints) [rad] or [m]
    middles: Floats  # (postures, shapes, 3) [m]
    turns: Floats  # (postures, shapes, 9)
    axes: Floats  # (postures, joints, 3)
    anchors: Floats  # (postures, joints, 3) [m]


class MujocoArm:
    """The arm's shapes, and what they must not touch: each other, the floor and boxes.

    Raises ConfigError, in one line, for a model that safety does not take.
    """

    def __init__(self, mjcf: str, body: BodyDescription) -> None:
        self._model = model = _compiled(mjcf, body)
        self._data = mujoco.MjData(model)
        self._coupling, self._start = _coupling(model, [joint.name for joint in body.joints])
        self._joints = _movable(model)
        self._places = model.jnt_qposadr[self._joints]
        self._slides = model.jnt_type[self._joints] == SLIDE
        moves = _moves(model)
        shapes = _shapes(model)
        pairs = _pairs(model, shapes, moves)
        self._floor = body.arm.floor if body.arm else None
        low = [] if self._floor is None else shapes[moves[model.geom_bodyid[shapes]].any(axis=1)]
        self._ends = np.array([*pairs, *((int(geom), -1) for geom in low)], np.int64).reshape(-1, 2)
        self._below = self._ends[:, 1] < 0
        first = moves[model.geom_bodyid[self._ends[:, 0]]]
        second = moves[model.geom_bodyid[self._ends[:, 1]]] & ~self._below[:, None]
        self._signs = second.astype(float) - first  # (pairs, movable joints)
        reach = _reach(model, moves)
        reach = np.where(first, reach[self._ends[:, 0]], reach[self._ends[:, 1]])
        self._levers: Floats = np.abs(self._signs) * reach @ np.abs(self._coupling)
        self._radii = model.geom_rbound[self._ends].sum(axis=1, where=self._ends >= 0)
        self._words = [self._in_words(a, b) for a, b in self._ends.tolist()]

    @property
    def levers(self) -> Floats:
        """The greatest gradients that there can be, (pairs, joints), all positive."""
        return self._levers

    def describe(self, pair: int) -> tuple[Kind, str, str]:
        """Return what a pair is: its kind, and the names of both."""
        return self._words[pair]

    def _in_words(self, a: int, b: int) -> tuple[Kind, str, str]:
        if b < 0:
            return "floor", self._name(a), FLOOR
        box = self._model.geom(b).name
        if box.startswith(KEEP_OUT):
            return "keep_out", self._name(a), box.removeprefix(KEEP_OUT)
        return "self", self._name(a), self._name(b)

    def near(self, postures: Floats, within: Floats) -> Near:
        """Return each pair that is nearer than its value in `within`, (postures, pairs) [m].

        Pairs whose enclosing spheres are farther apart are left out without measuring them.
        """
        poses = self._posed(postures)
        where, pairs = np.nonzero(self._apart(poses.middles) < within)
        most = within[where, pairs]
        distances, points, normals = self._measured(poses, where, pairs, most)
        (near,) = np.nonzero(distances < most)
        where, pairs = where[near], pairs[near]
        speeds = self._speeds(poses, where, points[near], normals[near])
        gradients = (speeds * self._signs[pairs]) @ self._coupling
        return Near(where, pairs, distances[near], gradients)

    def _posed(self, postures: Floats) -> _Poses:
        model, data, count = self._model, self._data, len(postures)
        shapes, joints = (count, model.ngeom), (count, model.njnt)
        poses = _Poses(
            self._start + postures @ self._coupling.T,
            np.empty((*shapes, 3)), np.empty((*shapes, 9)),
            np.empty((*joints, 3)), np.empty((*joints, 3)),
        )  # fmt: skip
        for index in range(count):
            self._pose(poses.positions[index])
            poses.middles[index], poses.turns[index] = data.geom_xpos, data.geom_xmat
            poses.axes[index], poses.anchors[index] = data.xaxis, data.xanchor
        return poses

    def _pose(self, positions: Floats) -> None:
        self._data.qpos[self._places] = positions
        mujoco.mj_kinematics(self._model, self._data)

    def _apart(self, middles: Floats) -> Floats:
        """Return the least distances by spheres round the shapes, (postures, pairs) [m]."""
        a, b = self._ends.T
        between = middles[:, a] - middles[:, b]
        apart = np.sqrt(np.einsum("kni,kni->kn", between, between))
        height = middles[:, a, 2] - (self._floor or 0.0)
        return np.asarray(np.where(self._below, height, apart) - self._radii)

    def _measured(
        self, poses: _Poses, where: Indices, pairs: Indices, most: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Return distances (n,), points between the shapes and normals to the second (n, 3).

        From its value in `most` on, (n,) [m], a distance is not measured.
        """
        model, data = self._model, self._data
        distances, lines = np.zeros(len(pairs)), np.zeros((len(pairs), 6))
        below, posed = self._below[pairs], -1
        rows = zip(where.tolist(), *self._ends[pairs].T.tolist(), most.tolist(), lines, strict=True)
        for row, (index, a, b, cutoff, line) in enumerate(rows):
            if b < 0:
                continue
            if index != posed:
                self._pose(poses.positions[index])
                posed = index
            distances[row] = mj_geomDistance(model, data, a, b, cutoff, line)
        starts, stops = lines[:, :3], lines[:, 3:]
        apart = np.where(np.abs(distances) < TOUCH_M, TOUCH_M, distances)
        points, normals = (starts + stops) / 2, (stops - starts) / apart[:, None]  # outwards, too
        if below.any():
            index, shapes = where[below], self._ends[pairs[below], 0]
            turns = poses.turns[index, shapes].reshape(-1, 3, 3)
            lowest = poses.middles[index, shapes] + _lowest(model, shapes, turns)
            distances[below] = lowest[:, 2] - (self._floor or 0.0)
            points[below], normals[below] = lowest, (0.0, 0.0, -1.0)
        return distances, points, normals

    def _speeds(self, poses: _Poses, where: Indices, points: Floats, normals: Floats) -> Floats:
        """Return how fast points move along normals with each movable joint, (n, joints)."""
        axes, anchors = poses.axes[:, self._joints], poses.anchors[:, self._joints]
        turns = np.concatenate((axes, _cross(anchors, axes)), axis=2)
        slides = np.concatenate((np.zeros_like(axes), axes), axis=2)
        lines = np.where(self._slides[:, None], slides, turns)[where]
        along = np.concatenate((_cross(points, normals), normals), axis=1)
        return np.asarray(np.einsum("nji,ni->nj", lines, along))

    def _name(self, geom: int) -> str:
        return str(self._model.body(self._model.geom_bodyid[geom]).name) or "the base"


def _compiled(mjcf: str, body: BodyDescription) -> mujoco.MjModel:
    """Return the model with the boxes of the description."""
    if len(mjcf.encode()) > MAX_MODEL_CHARACTERS:
        raise ConfigError(f"the arm's model is larger than {MAX_MODEL_CHARACTERS // 1024} kB")
    if found := REFUSED.search(mjcf) or FILES.search(mjcf):
        raise ConfigError(
            f"the arm's model has {found[1]!r}; safety takes primitive shapes only, in one file"
        )
    try:
        spec = mujoco.MjSpec.from_string(mjcf)
        for box in body.arm.keep_out if body.arm else ():
            turn = [np.cos(box.yaw / 2), 0.0, 0.0, np.sin(box.yaw / 2)]
            spec.worldbody.add_geom(
                name=f"{KEEP_OUT}{box.name}",
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=box.center,
                size=[side / 2 for side in box.size],
                quat=turn,
                contype=-1,
                conaffinity=-1,
            )
        model = spec.compile()
    except (ValueError, TypeError, mujoco.FatalError) as error:
        raise ConfigError(f"the arm's model: {' '.join(str(error).split())[:200]}") from None
    names = {model.joint(joint).name for joint in _movable(model)}
    if missing := [joint.name for joint in body.joints if joint.name not in names]:
        raise ConfigError(f"the arm's model has no joint {missing[0]!r}, which the body's file has")
    return model


def _movable(model: mujoco.MjModel) -> NDArray[np.int64]:
    """Return the joints with one degree of freedom."""
    return np.flatnonzero(model.jnt_type >= SLIDE)


def _coupling(model: mujoco.MjModel, names: list[str]) -> tuple[Floats, Floats]:
    """Return (movable joints, described joints) and offsets: all positions from those described.

    A joint that an equality ties to another follows it; one that is not described stays where the
    model begins.
    """
    joints = _movable(model).tolist()
    coupling = np.zeros((len(joints), len(names)))
    begin = np.array(model.qpos0[model.jnt_qposadr[joints]])
    start = begin.copy()
    for row, joint in enumerate(joints):
        name = model.joint(joint).name
        if name in names:
            coupling[row, names.index(name)], start[row] = 1.0, 0.0
    for one in np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_JOINT.value):
        follower, leader = model.eq_obj1id[one], model.eq_obj2id[one]
        offset, factor = model.eq_data[one, :2]
        if leader < 0 or follower not in joints or leader not in joints:
            continue
        first, second = joints.index(follower), joints.index(leader)
        offset += begin[first] - factor * begin[second]
        if coupling[first].any():  # the follower is the one described
            first, second, factor = second, first, 1 / factor
            offset *= -factor
        coupling[first], start[first] = factor * coupling[second], offset + factor * start[second]
    return coupling, start


def _moves(model: mujoco.MjModel) -> NDArray[np.bool_]:
    """Return which movable joint moves which body, (bodies, joints)."""
    joints = _movable(model)
    moves = np.zeros((model.nbody, len(joints)), bool)
    for body in range(1, model.nbody):
        moves[body] = moves[model.body_parentid[body]] | (model.jnt_bodyid[joints] == body)
    return moves


def _reach(model: mujoco.MjModel, moves: NDArray[np.bool_]) -> Floats:
    """Return how far from each movable joint any point of a geom can be, (geoms, joints) [m].

    For a joint that slides it is 1, what a point moves with it.
    """
    joints = _movable(model)
    slides = model.jnt_type[joints] == SLIDE
    ways = np.zeros(model.nbody)  # by which a body can slide
    np.add.at(ways, model.jnt_bodyid[joints], slides * np.abs(model.jnt_range[joints]).max(axis=1))
    steps = np.linalg.norm(model.body_pos, axis=1) + ways
    reach = np.zeros((model.nbody, len(joints)))  # of a body's origin
    for body in range(1, model.nbody):
        begins = model.jnt_bodyid[joints] == body
        reach[body] = np.where(
            begins,
            np.linalg.norm(model.jnt_pos[joints], axis=1) + ways[body],
            reach[model.body_parentid[body]] + steps[body],
        )
    own = np.linalg.norm(model.geom_pos, axis=1) + model.geom_rbound
    found = (reach[model.geom_bodyid] + own[:, None]) * moves[model.geom_bodyid]
    return np.asarray(np.where(slides, 1.0 * (found > 0), found))


def _shapes(model: mujoco.MjModel) -> NDArray[np.int64]:
    """Return the geoms that touch anything; planes are given by the body's file instead."""
    solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    return np.flatnonzero(solid & (model.geom_type != FLAT))


def _pairs(
    model: mujoco.MjModel, shapes: NDArray[np.int64], moves: NDArray[np.bool_]
) -> list[tuple[int, int]]:
    """Return the pairs that must not touch: not of one link, of neighbours, or excluded."""
    link = model.body_weldid
    parent = link[model.body_parentid[link]]
    excluded = {(int(one) >> 16, int(one) & 0xFFFF) for one in model.exclude_signature}
    found = []
    for index, b in enumerate(shapes.tolist()):
        for a in shapes[:index].tolist():
            box = [model.geom(one).name.startswith(KEEP_OUT) for one in (a, b)]
            first, second = int(model.geom_bodyid[a]), int(model.geom_bodyid[b])
            if (moves[first] == moves[second]).all():
                continue  # nothing moves one of them without the other
            i, j = link[first], link[second]
            neighbours = parent[i] == j or parent[j] == i
            if not any(box) and (neighbours or excluded & {(first, second), (second, first)}):
                continue
            if _collides(model, a, b):
                found.append((b, a) if box[0] else (a, b))
    return found


def _collides(model: mujoco.MjModel, a: int, b: int) -> bool:
    kinds, others = model.geom_contype, model.geom_conaffinity
    return bool((kinds[a] & others[b]) | (kinds[b] & others[a]))


def _lowest(model: mujoco.MjModel, shapes: Indices, turns: Floats) -> Floats:
    """Return the lowest point of shapes turned by (n, 3, 3), from their middles (n, 3) [m]."""
    down, sizes, kinds = -turns[:, 2], model.geom_size[shapes], model.geom_type[shapes]
    offsets = np.sign(down) * sizes  # of boxes
    for kind in set(kinds.tolist()) - {BOX}:
        (rows,) = np.nonzero(kinds == kind)
        offsets[rows] = _lowest_of(kind, sizes[rows], down[rows])
    return np.asarray(np.einsum("nij,nj->ni", turns, offsets))


def _lowest_of(kind: int, sizes: Floats, down: Floats) -> Floats:
    """Return the points of round shapes that lie farthest in directions, in their own frames."""
    if kind == ELLIPSOID:
        scaled = sizes * down
        return np.asarray(sizes * scaled / _lengths(scaled))
    if kind == SPHERE:
        return np.asarray(sizes[:, :1] * down)
    ends = np.zeros_like(down)
    ends[:, 2] = np.sign(down[:, 2]) * sizes[:, 1]
    if kind == CAPSULE:
        return np.asarray(sizes[:, :1] * down + ends)
    across = down * (1.0, 1.0, 0.0)
    return np.asarray(sizes[:, :1] * across / _lengths(across) + ends)


def _lengths(vectors: Floats) -> Floats:
    return np.asarray(np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12))


def _cross(a: Floats, b: Floats) -> Floats:
    """Return the cross products of the last axes, as np.cross does in five times the time."""
    return a[..., NEXT] * b[..., LAST] - a[..., LAST] * b[..., NEXT]
