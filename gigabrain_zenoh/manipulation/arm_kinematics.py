"""Kinematics of an arm from its MJCF model: pose of the tool, Jacobian, and gravity efforts."""

import functools
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.body import MAX_MODEL_CHARACTERS, JointDescription
from gigabrain_zenoh.errors import ConfigError, unknown
from gigabrain_zenoh.manipulation.descent import Chain

BASE = "base"  # the body in whose frame all poses are
PADS = "pad_fixed", "pad_moving"  # geoms that touch what is held
NEAR_M, NEAR_POSTURES = 0.001, 3000  # to find bodies that can collide; see `neighbours`
GRIPPER_STEPS = 41  # postures of the gripper at which its opening is measured
# elements that read files, or that make a large model of a short text
FORBIDDEN = re.compile(
    r"<(include|mesh|hfield|skin|flex|flexcomp|composite|replicate|attach|model|plugin|extension)\b"
    r"|\bfile\s*="
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """A pose in the frame of the arm's base."""

    position: Floats  # (3,) [m]
    axes: Floats  # (3, 3), its columns are the axes x, y and z; a rotation

    def place(self, points: Floats) -> Floats:
        """Return points (..., 3) [m] of this frame in the frame of the base."""
        return np.asarray(points @ self.axes.T + self.position)

    @property
    def quaternion(self) -> Floats:
        """Its rotation (4,), as w, x, y, z."""
        found = np.empty(4)
        mujoco.mju_mat2Quat(found, self.axes.ravel())
        return found


@dataclass(frozen=True, kw_only=True)
class Follower:
    """A joint that an equality of the model couples to another one, such as a second finger."""

    joint: str
    follows: str
    polynomial: tuple[float, ...]  # coefficients; argument: the other joint's offset from `qpos0`


class ArmKinematics:
    """An arm that reaches with its tool. Not for two threads at once.

    Postures are arrays (n,) of the joints whose `part` is "arm", in the order of the description,
    [rad] or [m]. Methods that take a posture leave it in the model.
    """

    def __init__(self, mjcf: str, joints: Sequence[JointDescription], tool: str = "tool") -> None:
        """Read a model.

        Raises:
            ConfigError: It is not an MJCF model of primitives, or lacks a joint or the tool.
        """
        self.tool = tool
        self.joints = tuple(one for one in joints if one.part == "arm")
        self.gripper = next((one for one in joints if one.part == "gripper"), None)
        if not self.joints:
            raise ConfigError("this body has no joints of an arm")
        self._spec, self.followers = _read_model(mjcf, [one.name for one in joints], tool)
        self._model = _compile(self._spec)
        self._data = mujoco.MjData(self._model)
        self.names = tuple(one.name for one in self.joints)
        self.lower = np.array([one.lower for one in self.joints])
        self.upper = np.array([one.upper for one in self.joints])
        self._site = self._model.site(tool).id
        self._dofs = np.array([self._model.joint(name).dofadr[0] for name in self.names])
        self._set = PostureSetter(self._model, self)
        self._jacobian = np.zeros((2, 3, self._model.nv))
        slide = mujoco.mjtJoint.mjJNT_SLIDE
        self.slides = np.array([self._model.joint(name).type[0] == slide for name in self.names])
        self.chain = self._chain()

    def spec(self) -> mujoco.MjSpec:
        """Return a copy of the model, in which only the given joints and their followers move."""
        return self._spec.copy()

    def forward(self, posture: Floats) -> Frame:
        """Return the pose of the tool."""
        self._set(self._data, posture)
        mujoco.mj_kinematics(self._model, self._data)
        return Frame(
            position=self._data.site_xpos[self._site].copy(),
            axes=self._data.site_xmat[self._site].reshape(3, 3).copy(),
        )

    def jacobian(self, posture: Floats) -> tuple[Frame, Floats]:
        """Return the pose of the tool, and its Jacobian (6, n).

        Its rows are the velocity [m/s] along x, y and z, then the angular velocity [rad/s] about
        them, per unit of each joint's speed.
        """
        frame = self.forward(posture)
        mujoco.mj_comPos(self._model, self._data)
        linear, angular = self._jacobian
        mujoco.mj_jacSite(self._model, self._data, linear, angular, self._site)
        return frame, self._jacobian.reshape(6, -1)[:, self._dofs]

    def weights(self, posture: Floats) -> Floats:
        """Return the joints' efforts that hold the arm against gravity (n,) [N m] or [N]."""
        self._set(self._data, posture)
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        efforts = np.zeros(self._model.nv)
        mujoco.mj_rne(self._model, self._data, 0, efforts)
        return np.asarray(efforts[self._dofs])

    def levers(self, beyond: float) -> Floats:
        """Return the largest distance of moved parts from each joint (n,) [m]; 1 if it slides.

        Parts may stick out `beyond` [m] farther than the tool.
        """
        links = np.linalg.norm([*self.chain.fixed[1:, :, 3], self.chain.tool[:, 3]], axis=1)
        reach = np.cumsum(links[::-1])[::-1] + beyond
        return np.where(self.slides, 1.0, reach)

    def tool_frame(self) -> Frame:
        """Return the pose of the tool in the frame of its body."""
        axes = np.empty(9)
        mujoco.mju_quat2Mat(axes, self._model.site_quat[self._site])
        return Frame(position=self._model.site_pos[self._site].copy(), axes=axes.reshape(3, 3))

    @functools.cached_property
    def neighbours(self) -> list[tuple[str, str]]:
        """The pairs of bodies whose distance is ignored.

        Either they are joined and one is fixed: MuJoCo leaves out such a pair only if both move.
        Or two joints are between them, like a jaw and a wrist, and they are far from each other
        in all of many random postures.
        """
        model = self._model
        roots, parents = (
            model.body_weldid,
            model.body_parentid,
        )  # a root is a rigid part's first body
        above = [int(roots[parents[roots[body]]]) for body in range(model.nbody)]
        near, found = self._bodies_that_come_near(), []
        for one in range(1, model.nbody):
            for other in range(1, model.nbody):
                joined = roots[other] and not roots[one] and above[other] == 0
                apart = roots[other] and above[other] and above[above[other]] == roots[one]
                if joined or (apart and (min(one, other), max(one, other)) not in near):
                    found.append((str(model.body(one).name), str(model.body(other).name)))
        return found

    def _bodies_that_come_near(self) -> set[tuple[int, int]]:
        """Return the pairs of bodies (lower number first) that can come near each other."""
        spec = self.spec()
        for geom in spec.geoms:
            geom.contype = geom.conaffinity = int(bool(geom.contype or geom.conaffinity))
            geom.margin = NEAR_M
        model = _compile(spec)
        data, put = mujoco.MjData(model), PostureSetter(model, self)
        found: set[tuple[int, int]] = set()
        random = np.random.default_rng(0)
        grip = self.gripper
        for posture in random.uniform(self.lower, self.upper, (NEAR_POSTURES, len(self.joints))):
            put(data, posture, random.uniform(grip.lower, grip.upper) if grip else None)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_collision(model, data)
            if data.ncon:
                bodies = np.sort(model.geom_bodyid[data.contact.geom], axis=1)
                found.update((int(one), int(other)) for one, other in bodies)
        return found

    def show(self, joint: int, position: float) -> str:
        """Return a position of the arm's joint with this number as text, with its unit."""
        slides = self.slides[joint]
        return f"{position * 1000:.0f} mm" if slides else f"{math.degrees(position):.0f}°"

    def inside(self, posture: Floats, tolerance: float = 1e-6) -> bool:
        """Return whether a posture is finite and within the limits of the joints."""
        low, high = self.lower - tolerance, self.upper + tolerance
        return bool(np.all((posture >= low) & (posture <= high)))

    @property
    def hand(self) -> tuple[str, ...]:
        """The bodies whose pads touch what is held. Raises ConfigError for a model without pads."""
        return tuple(self._spec.geom(pad).parent.name for pad in self._pads())

    def opening(self) -> "Opening":
        """Measure how far the gripper opens. Raises ConfigError for a model without pads."""
        if not self.gripper:
            raise ConfigError("this arm has no gripper")
        pads = self._pads()
        positions = np.linspace(self.gripper.lower, self.gripper.upper, GRIPPER_STEPS)
        faces = np.array([self._pad_faces(position, pads) for position in positions])
        return Opening(positions=positions, low=faces[:, 0], high=faces[:, 1])

    def _chain(self) -> Chain:
        """Return the joints and the links between them, from the model at posture 0."""
        data = self._data
        self._set(data, np.zeros(len(self.joints)))
        mujoco.mj_kinematics(self._model, data)
        numbers = [self._model.joint(name).id for name in self.names]
        turns, places = [np.eye(3)], [np.zeros(3)]
        for joint in numbers:
            turns.append(data.xmat[self._model.jnt_bodyid[joint]].reshape(3, 3).copy())
            places.append(data.xanchor[joint].copy())
        turns.append(data.site_xmat[self._site].reshape(3, 3).copy())
        places.append(data.site_xpos[self._site].copy())
        steps = np.zeros((len(turns) - 1, 3, 4))
        for step, before, after, begin, end in zip(
            steps, turns, turns[1:], places, places[1:], strict=False
        ):
            step[:, :3], step[:, 3] = before.T @ after, before.T @ (end - begin)
        axes = self._model.jnt_axis[numbers].copy()
        return Chain(fixed=steps[:-1].copy(), axes=axes, slides=self.slides, tool=steps[-1].copy())

    def _pads(self) -> list[str]:
        """Return the names of the pads in the model, with any prefix. Raises ConfigError."""
        known = [geom.name for geom in self._spec.geoms if geom.name]
        found = []
        for pad in PADS:
            name = next((one for one in known if one == pad or one.endswith(f"_{pad}")), None)
            if name is None:
                raise unknown("geom", pad, known)
            found.append(name)
        return found

    def _pad_faces(self, gripper: float, pads: Sequence[str]) -> tuple[float, float]:
        """Return the positions of the pads' inner faces along the tool's z axis [m]."""
        self._set(self._data, (self.lower + self.upper) / 2, gripper)
        mujoco.mj_kinematics(self._model, self._data)
        axis = self._data.site_xmat[self._site].reshape(3, 3)[:, 2]
        middles, halves = [], []
        for pad in pads:
            geom = self._model.geom(pad).id
            along = self._data.geom_xmat[geom].reshape(3, 3).T @ axis
            middles.append(axis @ (self._data.geom_xpos[geom] - self._data.site_xpos[self._site]))
            halves.append(np.abs(along) @ self._model.geom_aabb[geom, 3:])
        low, high = np.argsort(middles)
        return float(middles[low] + halves[low]), float(middles[high] - halves[high])


@dataclass(frozen=True, kw_only=True, eq=False)
class Opening:
    """Positions of the pads' inner faces along the tool's z axis, for positions of the gripper."""

    positions: Floats  # (k,) [rad] or [m] of the gripper's joint, rising
    low: Floats  # (k,) [m] from the tool's origin
    high: Floats  # (k,) [m]

    @property
    def widest(self) -> float:
        """The largest width between the pads [m]."""
        return float((self.high - self.low).max())

    def position(self, width: float) -> float:
        """Return the gripper's position [rad] or [m] for pads about `width` [m] apart."""
        widths = self.high - self.low
        end = int(widths.argmax())  # beyond it, a jaw that swings may close again
        begin = int(widths.argmin())
        part = slice(min(begin, end), max(begin, end) + 1)
        order = np.argsort(widths[part])
        return float(np.interp(width, widths[part][order], self.positions[part][order]))

    def middle(self, position: float) -> float:
        """Return the position of the middle between the pads along the tool's z axis [m]."""
        both = (self.low + self.high) / 2
        return float(np.interp(position, self.positions, both))


class PostureSetter:
    """Puts postures into the data of a model that was made from `ArmKinematics.spec`."""

    def __init__(self, model: mujoco.MjModel, arm: ArmKinematics) -> None:
        def address(name: str) -> int:
            return int(model.joint(name).qposadr[0])

        self._arm = np.array([address(one.name) for one in arm.joints])
        self._gripper = address(arm.gripper.name) if arm.gripper else None
        self._followers = [
            (address(one.joint), address(one.follows), one.polynomial) for one in arm.followers
        ]
        self._rest = model.qpos0

    def __call__(self, data: mujoco.MjData, posture: Floats, gripper: float | None = None) -> None:
        """Set the joints of the arm, its followers, and the gripper's joint if given."""
        data.qpos[self._arm] = posture
        if gripper is not None and self._gripper is not None:
            data.qpos[self._gripper] = gripper
        for joint, follows, polynomial in self._followers:
            moved = data.qpos[follows] - self._rest[follows]
            shift = sum(factor * moved**power for power, factor in enumerate(polynomial))
            data.qpos[joint] = self._rest[joint] + shift


def _read_model(
    mjcf: str, joints: Sequence[str], tool: str
) -> tuple[mujoco.MjSpec, tuple[Follower, ...]]:
    """Return the model with only the given joints, its base at the origin, and followers."""
    if len(mjcf) > MAX_MODEL_CHARACTERS:
        raise ConfigError(
            f"the arm's model has {len(mjcf)} characters; at most {MAX_MODEL_CHARACTERS} are read"
        )
    if found := FORBIDDEN.search(mjcf):
        raise ConfigError(
            f"the arm's model has {found[0]!r}; expected primitives alone, without files"
        )
    try:
        spec = mujoco.MjSpec.from_string(mjcf)
    except ValueError as error:
        raise unusable(error) from None
    known = {one.name: one for one in spec.joints}
    for name in joints:
        if name not in known:
            raise unknown("joint in the arm's model", name, filter(None, known))
    if not any(site.name == tool for site in spec.sites):
        raise unknown("site in the arm's model", tool, (s.name for s in spec.sites if s.name))
    base = spec.body(BASE)
    if base is None or base.parent.name != "world":
        raise ConfigError(f"the arm's model has no body {BASE!r} in the world's body")
    _prune(spec, joints, followers := _followers(spec, joints))
    for number, body in enumerate(spec.bodies):
        body.name = body.name or f"body {number}"
    base.pos, base.quat, base.alt.type = (0, 0, 0), (1, 0, 0, 0), mujoco.mjtOrientation(0)
    return spec, followers


def _followers(spec: mujoco.MjSpec, joints: Sequence[str]) -> tuple[Follower, ...]:
    found = []
    for one in spec.equalities:
        if one.type == mujoco.mjtEq.mjEQ_JOINT and one.name2 in joints:
            polynomial = tuple(float(value) for value in one.data[:5])
            found.append(Follower(joint=one.name1, follows=one.name2, polynomial=polynomial))
    return tuple(one for one in found if one.joint not in joints)


def _prune(spec: mujoco.MjSpec, joints: Sequence[str], followers: Sequence[Follower]) -> None:
    """Delete unneeded elements, and all other joints: a base's wheels become rigid parts."""
    kept = {*joints, *(one.joint for one in followers)}
    for kind in (spec.keys, spec.equalities, spec.actuators, spec.sensors, spec.tendons):
        for one in list(kind):
            spec.delete(one)
    for joint in list(spec.joints):
        if joint.name not in kept:
            spec.delete(joint)


def _compile(spec: mujoco.MjSpec) -> mujoco.MjModel:
    try:
        return spec.compile()
    except ValueError as error:
        raise unusable(error) from None


def unusable(error: ValueError) -> ConfigError:
    """Return the error for a model that MuJoCo refuses, in one line."""
    problem = " ".join(str(error).split())[:300]
    return ConfigError(f"the arm's model cannot be used: {problem}")
