"""Compares a robot's MJCF model with the dimensions in the robot's file."""

import math
from collections.abc import Iterator, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from gigabrain_drivers.kinematics.wheels import Omni
from gigabrain_drivers.sim.body import SimBody, SimModel
from gigabrain_zenoh.errors import ConfigError

MAX_RELATIVE_ERROR = 0.05  # between lengths in the model and in the file
MAX_ERROR_M, MAX_ERROR_RAD = 0.02, 0.05  # between positions, and between angles
IMU_SENSORS = ("gyro", "accelerometer", "attitude")
UPRIGHT = 0.7  # minimal cosine between parallel axes


class ModelMeasures:
    """Positions of a model's parts at rest, in its base's frame. Parts have our names."""

    def __init__(self, spec: mujoco.MjSpec) -> None:
        self._model = spec.copy().compile()
        self._data = mujoco.MjData(self._model)
        mujoco.mj_kinematics(self._model, self._data)
        base = self._model.body("base").id
        self._origin = self._data.xpos[base].copy()
        self._axes = self._data.xmat[base].reshape(3, 3).copy()

    def joint_axis(self, name: str) -> NDArray[np.float64]:
        """Return the axis of a joint (3,)."""
        return np.asarray(self._data.xaxis[self._model.joint(name).id] @ self._axes)

    def geom(self, name: str) -> NDArray[np.float64]:
        """Return the centre of a geom (3,) [m]."""
        return self._placed(self._data.geom_xpos[self._model.geom(name).id])

    def body(self, name: str) -> NDArray[np.float64]:
        """Return the origin of a body (3,) [m]."""
        return self._placed(self._data.xpos[self._model.body(name).id])

    def site(self, name: str) -> tuple[float, float, float]:
        """Return x, y [m] and yaw [rad] of a site."""
        x, y, _ = self.place(name).tolist()
        axes = self._data.site_xmat[self._model.site(name).id].reshape(3, 3)
        ahead = self._axes.T @ axes[:, 0]
        return x, y, math.atan2(ahead[1], ahead[0])

    def is_level(self, name: str) -> bool:
        """Return whether a site's axes are those of the base."""
        turned = self._axes.T @ self._data.site_xmat[self._model.site(name).id].reshape(3, 3)
        return bool(np.allclose(turned, np.eye(3), atol=1e-3))

    def place(self, name: str) -> NDArray[np.float64]:
        """Return the position of a site (3,) [m]."""
        return self._placed(self._data.site_xpos[self._model.site(name).id])

    def radius(self, name: str) -> float:
        """Return the radius of a wheel's geom, which may be a mesh [m]."""
        return float(self._model.geom_aabb[self._model.geom(name).id, 3:].max())

    def reach(self, name: str) -> tuple[float, float]:
        """Return the control range of an actuator; infinite without limits."""
        number = self._model.actuator(name).id
        if not self._model.actuator_ctrllimited[number]:
            return -math.inf, math.inf
        low, high = self._model.actuator_ctrlrange[number].tolist()
        return low, high

    def outline(self, arm: Sequence[str] = ()) -> tuple[float, float, float, float]:
        """Return the front, rear, left and right edges of all geoms with contacts [m].

        Parts that the joints `arm` move are left out.
        """
        model = self._model
        carried = np.zeros(model.nbody, bool)
        carried[[model.jnt_bodyid[model.joint(name).id] for name in arm]] = True
        for number in range(1, model.nbody):
            carried[number] |= carried[model.body_parentid[number]]
        touching = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        touching &= ~carried[model.geom_bodyid]
        geoms = np.flatnonzero(touching & (model.geom_rbound > 0.0))
        half = model.geom_aabb[geoms, 3:]
        axes = np.abs(self._axes.T @ self._data.geom_xmat[geoms].reshape(-1, 3, 3))
        reach = np.einsum("nij,nj->ni", axes, half)
        middle = np.array([self._placed(self._data.geom_xpos[geom]) for geom in geoms])
        high, low = (middle + reach).max(axis=0), (middle - reach).min(axis=0)
        return float(high[0]), float(low[0]), float(high[1]), float(low[1])

    def _placed(self, point: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(self._axes.T @ (point - self._origin))


def align(spec: mujoco.MjSpec, body: SimModel) -> None:
    """Align inertial sensors with the base, wheels' axes to the left, steering upwards.

    Raises ConfigError for an axis in another direction.
    """
    measures = ModelMeasures(spec)
    _level(spec, measures)
    if not isinstance(body, SimBody) or isinstance(body.base, Omni):
        return
    for name in body.wheels:
        joint = f"{name}_joint"
        along, called = (1, "y, to the left") if name in body.rolling else (2, "z, upwards")
        axis = measures.joint_axis(joint)
        if abs(axis[along]) < UPRIGHT:
            shown = ", ".join(f"{value:.2f}" for value in axis)
            given = body.names.get(name, body.named_by)
            raise ConfigError(
                f"{body.path}: the axis of {name} is ({shown}) in the base; expected {called}",
                value=given if isinstance(given, str) else given.joint,
            )
        if axis[along] < 0:
            spec.joint(joint).axis = -np.asarray(spec.joint(joint).axis)


def _level(spec: mujoco.MjSpec, measures: ModelMeasures) -> None:
    """Level inertial sensors that are mounted at an angle, at the same position."""
    for name in IMU_SENSORS:
        sensor = spec.sensor(name)
        if sensor.objtype != mujoco.mjtObj.mjOBJ_SITE or measures.is_level(sensor.objname):
            continue
        place = measures.place(sensor.objname)
        level = spec.body("base").add_site(name=f"{name}_level", pos=place)
        sensor.objname = level.name


def mismatches(spec: mujoco.MjSpec, body: SimModel) -> Iterator[str]:
    """Yield the differences between model and robot's file, with both numbers."""
    measures = ModelMeasures(spec)
    if isinstance(body, SimBody):
        yield from _wheels(measures, body)
    if body.lidar and body.lidar.mount:
        yield from _lidar(measures, body.lidar.mount)
    if body.footprint:
        x, y = zip(*body.footprint, strict=True)
        edges = ("front", max(x)), ("rear", min(x)), ("left side", max(y)), ("right side", min(y))
        outline = measures.outline([joint.name for joint in body.joints])
        for (edge, stated), is_in_model in zip(edges, outline, strict=True):
            if abs(is_in_model) > abs(stated) + MAX_ERROR_M:  # a larger footprint is safe
                yield _differs(f"the {edge} of the footprint", is_in_model, stated)


def _wheels(measures: ModelMeasures, body: SimBody) -> Iterator[str]:
    places = {name: measures.geom(name) for name in body.rolling}
    first, second, *_ = places.values()
    apart = math.dist(first[:2], second[:2])
    lengths = [("wheel_separation", body.wheel_separation, apart)]
    if body.wheel_scale == 1.0 and body.odometry_wheel_radius is None:  # else it is on purpose
        lengths.append(("wheel_radius", body.wheel_radius, measures.radius(body.wheels[0])))
    if body.wheel_base:
        along = [measures.body(name)[0] for name in body.wheels]
        lengths.append(("wheel_base", body.wheel_base, max(along) - min(along)))
    for name, stated, is_in_model in lengths:
        if abs(stated / is_in_model - 1.0) > MAX_RELATIVE_ERROR:
            yield _differs(name, is_in_model, stated)
    middle = float(np.mean([place[0] for place in places.values()]))
    if abs(middle) > MAX_ERROR_M:
        yield f"the wheels are {middle:.3f} m ahead of the base's origin; expected them at 0 m"
    for name in body.rolling:
        low, high = measures.reach(name)
        if body.needed_wheel_speed > min(-low, high) * (1 + MAX_RELATIVE_ERROR):
            yield (
                f"the actuator of {name} ends at {min(-low, high):.3g} rad/s, and the largest "
                f"speeds of the robot's file ask for {body.needed_wheel_speed:.3g} rad/s"
            )
            return


def _lidar(measures: ModelMeasures, mount: tuple[float, float, float]) -> Iterator[str]:
    x, y, yaw = measures.site("lidar")
    for name, stated, is_in_model in (("lidar: x", mount[0], x), ("lidar: y", mount[1], y)):
        if abs(stated - is_in_model) > MAX_ERROR_M:
            yield _differs(name, is_in_model, stated)
    if abs(math.remainder(mount[2] - yaw, math.tau)) > MAX_ERROR_RAD:
        yield _differs("lidar: yaw", yaw, mount[2], "rad")


def _differs(what: str, is_in_model: float, stated: float, unit: str = "m") -> str:
    return f"{what} is {is_in_model:.3f} {unit} here, and {stated:.3f} {unit} in the robot's file"
