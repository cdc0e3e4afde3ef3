"""Distances between an arm's shapes, computed by MuJoCo from the text of its model.

Only imported for bodies with an arm, since MuJoCo costs memory and start-up time.
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
KEEP_OUT = "keep_out/"  # prefix of the boxes' names in the compiled model
REFUSED_ELEMENTS = re.compile(
    r"<\s*(include|mesh|hfield|skin|flex|flexcomp|composite|plugin|attach|model)\b"
)
FILE_ATTRIBUTES = re.compile(r"\b(file|fileright|fileleft|fileup|filedown|filefront|fileback)\s*=")
NEXT, PREVIOUS = (1, 2, 0), (2, 0, 1)  # of the axes x, y, z
MIN_DISTANCE_M = 1e-9  # avoids a division by 0 for shapes that touch
SLIDE = mujoco.mjtJoint.mjJNT_SLIDE.value
PLANE = mujoco.mjtGeom.mjGEOM_PLANE.value
BOX = mujoco.mjtGeom.mjGEOM_BOX.value
CAPSULE = mujoco.mjtGeom.mjGEOM_CAPSULE.value
ELLIPSOID = mujoco.mjtGeom.mjGEOM_ELLIPSOID.value
SPHERE = mujoco.mjtGeom.mjGEOM_SPHERE.value
Floats = NDArray[np.float64]
Indices = NDArray[np.int64]


class _Poses(NamedTuple):
    """Poses of shapes and joints in several postures."""

    positions: Floats  # (postures, movable joints) [rad] or [m]
    centers: Floats  # (postures, shapes, 3) [m]
    rotations: Floats  # (postures, shapes, 9), matrices by row
    axes: Floats  # (postures, joints, 3)
    anchors: Floats  # (postures, joints, 3) [m]


class MujocoArm:
    """The arm's shapes, which must not touch each other, the floor or keep-out boxes.

    Raises ConfigError for a model that safety does not accept.
    """

    def __init__(self, mjcf: str, body: BodyDescription) -> None:
        self._model = model = _compile(mjcf, body)
        self._data = mujoco.MjData(model)
        self._coupling, self._offsets = _coupling(model, [joint.name for joint in body.joints])
        self._joints = _movable(model)
        self._qpos_indices = model.jnt_qposadr[self._joints]
        self._slides = model.jnt_type[self._joints] == SLIDE
        moved = _moved_by_joints(model)
        shapes = _shapes(model)
        pairs = _pairs(model, shapes, moved)
        self._floor = body.arm.floor if body.arm else None
        moving = [] if self._floor is None else shapes[moved[model.geom_bodyid[shapes]].any(axis=1)]
        with_floor = ((int(geom), -1) for geom in moving)
        self._geoms = np.array([*pairs, *with_floor], np.int64).reshape(-1, 2)
        self._with_floor = self._geoms[:, 1] < 0
        moves_first = moved[model.geom_bodyid[self._geoms[:, 0]]]
        moves_second = moved[model.geom_bodyid[self._geoms[:, 1]]] & ~self._with_floor[:, None]
        self._signs = moves_second.astype(float) - moves_first  # (pairs, movable joints)
        reach = _reach(model, moved)
        reach = np.where(moves_first, reach[self._geoms[:, 0]], reach[self._geoms[:, 1]])
        self._levers: Floats = np.abs(self._signs) * reach @ np.abs(self._coupling)
        self._radii = model.geom_rbound[self._geoms].sum(axis=1, where=self._geoms >= 0)
        self._descriptions = [self._description(a, b) for a, b in self._geoms.tolist()]

    @property
    def levers(self) -> Floats:
        """Upper bounds of the absolute gradients, (pairs, joints)."""
        return self._levers

    def describe(self, pair: int) -> tuple[Kind, str, str]:
        """Return the kind of a pair, and the names of both shapes."""
        return self._descriptions[pair]

    def _description(self, a: int, b: int) -> tuple[Kind, str, str]:
        if b < 0:
            return "floor", self._name(a), FLOOR
        box = self._model.geom(b).name
        if box.startswith(KEEP_OUT):
            return "keep_out", self._name(a), box.removeprefix(KEEP_OUT)
        return "self", self._name(a), self._name(b)

    def near(self, postures: Floats, within: Floats) -> Near:
        """Return the pairs that are nearer than their limits `within`, (postures, pairs) [m].

        Pairs whose bounding spheres are farther apart are not measured.
        """
        poses = self._poses(postures)
        indices, pairs = np.nonzero(self._lower_bounds(poses.centers) < within)
        limits = within[indices, pairs]
        distances, points, normals = self._measure(poses, indices, pairs, limits)
        (near,) = np.nonzero(distances < limits)
        indices, pairs = indices[near], pairs[near]
        speeds = self._speeds(poses, indices, points[near], normals[near])
        gradients = (speeds * self._signs[pairs]) @ self._coupling
        return Near(indices, pairs, distances[near], gradients)

    def _poses(self, postures: Floats) -> _Poses:
        model, data, count = self._model, self._data, len(postures)
        shapes, joints = (count, model.ngeom), (count, model.njnt)
        poses = _Poses(
            self._offsets + postures @ self._coupling.T,
            np.empty((*shapes, 3)), np.empty((*shapes, 9)),
            np.empty((*joints, 3)), np.empty((*joints, 3)),
        )  # fmt: skip
        for index in range(count):
            self._pose(poses.positions[index])
            poses.centers[index], poses.rotations[index] = data.geom_xpos, data.geom_xmat
            poses.axes[index], poses.anchors[index] = data.xaxis, data.xanchor
        return poses

    def _pose(self, positions: Floats) -> None:
        self._data.qpos[self._qpos_indices] = positions
        mujoco.mj_kinematics(self._model, self._data)

    def _lower_bounds(self, centers: Floats) -> Floats:
        """Return the distances of bounding spheres, (postures, pairs) [m]."""
        a, b = self._geoms.T
        offsets = centers[:, a] - centers[:, b]
        distances = np.sqrt(np.einsum("kni,kni->kn", offsets, offsets))
        height = centers[:, a, 2] - (self._floor or 0.0)
        return np.asarray(np.where(self._with_floor, height, distances) - self._radii)

    def _measure(
        self, poses: _Poses, postures: Indices, pairs: Indices, limits: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Return distances (n,), midpoints between shapes and normals to the second (n, 3).

        Distances beyond their `limits` (n,) [m] are not measured.
        """
        model, data = self._model, self._data
        distances, lines = np.zeros(len(pairs)), np.zeros((len(pairs), 6))
        floor, posed = self._with_floor[pairs], -1
        geoms = self._geoms[pairs].T.tolist()
        rows = zip(postures.tolist(), *geoms, limits.tolist(), lines, strict=True)
        for row, (posture, a, b, cutoff, line) in enumerate(rows):
            if b < 0:
                continue
            if posture != posed:
                self._pose(poses.positions[posture])
                posed = posture
            distances[row] = mj_geomDistance(model, data, a, b, cutoff, line)
        starts, stops = lines[:, :3], lines[:, 3:]
        divisor = np.where(np.abs(distances) < MIN_DISTANCE_M, MIN_DISTANCE_M, distances)
        # normals point outwards also where shapes overlap, as their distance is negative
        points, normals = (starts + stops) / 2, (stops - starts) / divisor[:, None]
        if floor.any():
            indices, shapes = postures[floor], self._geoms[pairs[floor], 0]
            rotations = poses.rotations[indices, shapes].reshape(-1, 3, 3)
            lowest = poses.centers[indices, shapes] + _lowest_points(model, shapes, rotations)
            distances[floor] = lowest[:, 2] - (self._floor or 0.0)
            points[floor], normals[floor] = lowest, (0.0, 0.0, -1.0)
        return distances, points, normals

    def _speeds(self, poses: _Poses, postures: Indices, points: Floats, normals: Floats) -> Floats:
        """Return the speeds of points along normals at unit joint speed, (n, movable joints)."""
        axes, anchors = poses.axes[:, self._joints], poses.anchors[:, self._joints]
        turns = np.concatenate((axes, _cross(anchors, axes)), axis=2)
        slides = np.concatenate((np.zeros_like(axes), axes), axis=2)
        lines = np.where(self._slides[:, None], slides, turns)[postures]
        along = np.concatenate((_cross(points, normals), normals), axis=1)
        return np.asarray(np.einsum("nji,ni->nj", lines, along))

    def _name(self, geom: int) -> str:
        return str(self._model.body(self._model.geom_bodyid[geom]).name) or "the base"


def _compile(mjcf: str, body: BodyDescription) -> mujoco.MjModel:
    """Return the model with the keep-out boxes of the body."""
    if len(mjcf.encode()) > MAX_MODEL_CHARACTERS:
        raise ConfigError(f"the arm's model is larger than {MAX_MODEL_CHARACTERS // 1024} kB")
    if found := REFUSED_ELEMENTS.search(mjcf) or FILE_ATTRIBUTES.search(mjcf):
        raise ConfigError(
            f"the arm's model has {found[1]!r}; safety takes primitive shapes only, in one file"
        )
    try:
        spec = mujoco.MjSpec.from_string(mjcf)
        for box in body.arm.keep_out if body.arm else ():
            quaternion = [np.cos(box.yaw / 2), 0.0, 0.0, np.sin(box.yaw / 2)]
            spec.worldbody.add_geom(
                name=f"{KEEP_OUT}{box.name}",
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=box.center,
                size=[side / 2 for side in box.size],
                quat=quaternion,
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
    """Return the matrix (movable joints, described joints) and offsets that give all positions.

    An equality makes a joint follow another. Other joints that the body does not describe keep the
    model's initial position.
    """
    joints = _movable(model).tolist()
    coupling = np.zeros((len(joints), len(names)))
    initial = np.array(model.qpos0[model.jnt_qposadr[joints]])
    offsets = initial.copy()
    for row, joint in enumerate(joints):
        name = model.joint(joint).name
        if name in names:
            coupling[row, names.index(name)], offsets[row] = 1.0, 0.0
    for equality in np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_JOINT.value):
        follower, leader = model.eq_obj1id[equality], model.eq_obj2id[equality]
        offset, factor = model.eq_data[equality, :2]
        if leader < 0 or follower not in joints or leader not in joints:
            continue
        first, second = joints.index(follower), joints.index(leader)
        offset += initial[first] - factor * initial[second]
        if coupling[first].any():  # the follower is described
            first, second, factor = second, first, 1 / factor
            offset *= -factor
        coupling[first], offsets[first] = (
            factor * coupling[second],
            offset + factor * offsets[second],
        )
    return coupling, offsets


def _moved_by_joints(model: mujoco.MjModel) -> NDArray[np.bool_]:
    """Return a mask (bodies, movable joints): the joint moved the body."""
    joints = _movable(model)
    moved = np.zeros((model.nbody, len(joints)), bool)
    for body in range(1, model.nbody):
        moved[body] = moved[model.body_parentid[body]] | (model.jnt_bodyid[joints] == body)
    return moved


def _reach(model: mujoco.MjModel, moved: NDArray[np.bool_]) -> Floats:
    """Return the maximum distances of geoms' points from joints, (geoms, movable joints) [m].

    For a sliding joint it is 1: a point moved as far as the joint.
    """
    joints = _movable(model)
    slides = model.jnt_type[joints] == SLIDE
    slide_ranges = np.zeros(model.nbody)  # [m] by which a body can slide
    np.add.at(
        slide_ranges, model.jnt_bodyid[joints], slides * np.abs(model.jnt_range[joints]).max(axis=1)
    )
    steps = np.linalg.norm(model.body_pos, axis=1) + slide_ranges
    reach = np.zeros((model.nbody, len(joints)))  # of a body's origin
    for body in range(1, model.nbody):
        attached = model.jnt_bodyid[joints] == body
        reach[body] = np.where(
            attached,
            np.linalg.norm(model.jnt_pos[joints], axis=1) + slide_ranges[body],
            reach[model.body_parentid[body]] + steps[body],
        )
    own = np.linalg.norm(model.geom_pos, axis=1) + model.geom_rbound
    found = (reach[model.geom_bodyid] + own[:, None]) * moved[model.geom_bodyid]
    return np.asarray(np.where(slides, 1.0 * (found > 0), found))


def _shapes(model: mujoco.MjModel) -> NDArray[np.int64]:
    """Return the solid geoms without planes: the body's file has the floor."""
    solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    return np.flatnonzero(solid & (model.geom_type != PLANE))


def _pairs(
    model: mujoco.MjModel, shapes: NDArray[np.int64], moved: NDArray[np.bool_]
) -> list[tuple[int, int]]:
    """Return the pairs that must not touch, without excluded ones and those of neighbours."""
    link = model.body_weldid
    parent = link[model.body_parentid[link]]
    excluded = {(int(pair) >> 16, int(pair) & 0xFFFF) for pair in model.exclude_signature}
    found = []
    for index, b in enumerate(shapes.tolist()):
        for a in shapes[:index].tolist():
            is_box = [model.geom(geom).name.startswith(KEEP_OUT) for geom in (a, b)]
            first, second = int(model.geom_bodyid[a]), int(model.geom_bodyid[b])
            if (moved[first] == moved[second]).all():
                continue  # the same joints move both
            i, j = link[first], link[second]
            neighbours = parent[i] == j or parent[j] == i
            if not any(is_box) and (neighbours or excluded & {(first, second), (second, first)}):
                continue
            if _collides(model, a, b):
                found.append((b, a) if is_box[0] else (a, b))
    return found


def _collides(model: mujoco.MjModel, a: int, b: int) -> bool:
    kinds, others = model.geom_contype, model.geom_conaffinity
    return bool((kinds[a] & others[b]) | (kinds[b] & others[a]))


def _lowest_points(model: mujoco.MjModel, shapes: Indices, rotations: Floats) -> Floats:
    """Return the lowest points of rotated shapes, relative to their centers (n, 3) [m]."""
    down, sizes, kinds = -rotations[:, 2], model.geom_size[shapes], model.geom_type[shapes]
    offsets = np.sign(down) * sizes  # right for boxes
    for kind in set(kinds.tolist()) - {BOX}:
        (rows,) = np.nonzero(kinds == kind)
        offsets[rows] = _farthest_points(kind, sizes[rows], down[rows])
    return np.asarray(np.einsum("nij,nj->ni", rotations, offsets))


def _farthest_points(kind: int, sizes: Floats, down: Floats) -> Floats:
    """Return the points of round shapes farthest in the directions `down`, in their own frames."""
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
    """Return the cross products of the last axes; np.cross takes five times as long."""
    return a[..., NEXT] * b[..., PREVIOUS] - a[..., PREVIOUS] * b[..., NEXT]
