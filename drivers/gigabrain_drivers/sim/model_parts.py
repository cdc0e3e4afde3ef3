"""Fits a robot's MJCF model to the simulator: finds parts by name, adds missing ones.

The simulator has its own names for parts (`base`, `wheel_left_joint`). The table `names` of a
robot's file maps them to the names in the model. The file of the model is not changed.
"""

import difflib
import math
from collections.abc import Iterable, Iterator
from typing import Any

import mujoco
import numpy as np

from gigabrain_drivers.sim.body import PartNames, SimBody, SimModel
from gigabrain_zenoh.errors import ConfigError, listed

OBJECTS = {
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "joint": mujoco.mjtObj.mjOBJ_JOINT,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "site": mujoco.mjtObj.mjOBJ_SITE,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
    "sensor": mujoco.mjtObj.mjOBJ_SENSOR,
}
TARGETS = {
    mujoco.mjtTrn.mjTRN_SITE: "site",
    mujoco.mjtTrn.mjTRN_BODY: "body",
    mujoco.mjtTrn.mjTRN_TENDON: "tendon",
}
IMU_SENSORS = {
    "gyro": mujoco.mjtSensor.mjSENS_GYRO,
    "accelerometer": mujoco.mjtSensor.mjSENS_ACCELEROMETER,
    "attitude": mujoco.mjtSensor.mjSENS_FRAMEQUAT,
}
ROBOT_GROUP = 2  # of geoms that the lidar does not see
HULL = "hull_"
HULL_BOTTOM_M, HULL_TOP_M = 0.02, 0.4  # above the floor, of a hull made of the footprint
SERVO_GAIN, GRIP = 100.0, 0.8  # [1/s] of a wheel's servo, and friction that its torque overcomes
GRAVITY = 9.81  # [m/s2]
SHARE_AT_FULL_TORQUE = 0.1  # speed error at full torque, as a share of the largest wheel speed
UPRIGHT = 0.7  # minimal cosine between parallel axes


class PartFinder:
    """Finds the parts of one model, and collects the missing ones."""

    def __init__(self, spec: mujoco.MjSpec, body: SimModel) -> None:
        self._spec, self._body = spec, body
        self._unchanged = spec.copy()
        self._problems: list[str] = []
        self._value = ""  # the first name in the robot's file that is wrong

    def fit(self) -> None:
        """Rename the parts to our names. Raises ConfigError listing all missing parts."""
        spec, body = self._spec, self._body
        _leave_out_scene(spec)
        self._check_keys()
        base = self._base()
        for key in self._moving():
            self._moving_part(key)
        if base is not None:
            self._sensors(base)
            self._lidar(base)
        self._finish()
        assert base is not None
        _hide(spec)
        if not any(geom.name.startswith(HULL) for geom in spec.geoms) and body.footprint:
            _add_hull(base, body.footprint)

    def _finish(self) -> None:
        if self._problems:
            text = f"{self._body.path}: the model has {'; '.join(self._problems)}"
            raise ConfigError(text, value=self._value or self._body.named_by)

    def _missing(self, kind: str, name: str, key: str, known: Iterable[str]) -> None:
        names = sorted(filter(None, known))
        near = difflib.get_close_matches(name, names, 1, 0.5)
        if near:
            hint = f"; did you mean {near[0]!r}?"
        elif key in self._body.names:
            hint = f", it has {listed(names)}"
        else:
            has = listed(names) if names else "it has none"
            hint = f", name it in `names: {{{key}: …}}`: {has}"
        self._problem(f"no {kind} {name!r} ({key}){hint}", name if key in self._body.names else "")

    def _problem(self, text: str, value: str = "") -> None:
        self._problems.append(text)
        self._value = self._value or value

    def _named(self, key: str) -> PartNames:
        """Return a part's names in the model, from the robot's file or by default."""
        given = self._body.names.get(key)
        if isinstance(given, str):
            return PartNames(joint=given)
        if given:
            return given
        joint = next(
            name for kind, name in self._body.parts() if kind == "joint" and _of(name, key)
        )
        return PartNames(joint=joint)

    def _moving(self) -> list[str]:
        return [name for kind, name in self._body.parts() if kind == "actuator"]

    def _others(self) -> list[str]:
        contacts = [name for kind, name in self._body.parts() if kind == "sensor"]
        return ["base", "lidar", *IMU_SENSORS, *contacts]

    def _check_keys(self) -> None:
        known = [*self._others(), *self._moving()]
        for key, given in self._body.names.items():
            if key not in known:
                near = difflib.get_close_matches(key, known, 1, 0.5)
                hint = f"; did you mean {near[0]!r}?" if near else ";"
                value = given if isinstance(given, str) else given.joint
                self._problem(f"no part {key!r}{hint} parts: {listed(known)}", value)
            elif not isinstance(given, str) and key in self._others():
                self._problem(f"one name for {key}, not a joint and an actuator", given.joint)

    def _base(self) -> Any:
        """Return the body of the base, which has a free joint."""
        spec, top = self._spec, list(self._spec.worldbody.bodies)
        name = self._text("base")
        base = spec.body(name)
        if base is None and "base" not in self._body.names and len(top) == 1:
            base = top[0]
        if base is None:
            self._missing("body", name, "base", (one.name for one in top))
            return None
        if base.name not in [one.name for one in top]:
            around = " or ".join(repr(one.name) for one in top)
            self._problem(f"{name!r} (base) inside another body; expected {around}", name)
            return None
        self._rename("body", base, "base")
        joints = list(base.joints)
        free = [one for one in joints if one.type == mujoco.mjtJoint.mjJNT_FREE]
        if joints and not free:
            kinds = ", ".join(one.name or "a joint" for one in joints)
            self._problem(f"a base that moves on rails ({kinds}); remove its joints", name)
            return None
        if not self._body.fixed:
            self._rename("joint", free[0] if free else base.add_freejoint(), "free")
        elif free:
            self._spec.delete(free[0])
        return base

    def _text(self, key: str) -> str:
        given = self._body.names.get(key, key)
        return given if isinstance(given, str) else given.joint

    def _moving_part(self, key: str) -> None:
        """Find joint, body, geom and actuator of a wheel, a steered wheel or a leg's joint."""
        spec, part = self._spec, self._named(key)
        joint = spec.joint(part.joint)
        if joint is None:
            self._missing("joint", part.joint, key, (one.name for one in spec.joints))
            return
        needed = {kind for kind, name in self._body.parts() if _of(name, key)}
        wheel = "geom" in needed
        if wheel:
            geom = self._geom(part, joint, key)
            if geom is None:
                return
        actuator = self._actuator(part, joint, key, wheel=wheel)
        if actuator is None:
            return
        if wheel:
            self._rename("geom", geom, key)
        if "body" in needed:
            self._rename("body", joint.parent, key)
        self._rename("actuator", actuator, key)
        self._rename("joint", joint, f"{key}_joint" if "body" in needed else key)

    def _geom(self, part: PartNames, joint: Any, key: str) -> Any:
        """Return a wheel's geom on the floor: the named one, or the only one with contacts."""
        geoms = list(joint.parent.geoms)
        named = {one.name: one for one in geoms if one.name}
        if part.geom or key in named:
            geom = named.get(part.geom or key)
            if geom is None:
                self._missing("geom", part.geom, key, named)
            return geom
        touching = [one for one in geoms if one.contype or one.conaffinity]
        if not touching and geoms and joint.parent.bodies:  # its rollers have the contacts
            return max(geoms, key=lambda one: float(one.size[0]))
        if len(touching) != 1:
            what = "several geoms that touch" if touching else "no geom that touches"
            name = joint.parent.name
            self._problem(f"{what} in body {name!r} ({key}); name its `geom`", part.joint)
            return None
        return touching[0]

    def _actuator(self, part: PartNames, joint: Any, key: str, *, wheel: bool) -> Any:
        spec = self._spec
        if part.actuator or spec.actuator(key):
            found = spec.actuator(part.actuator or key)
            if found is None:
                self._missing("actuator", part.actuator, key, (a.name for a in spec.actuators))
                return None
        else:
            found = next((one for one in spec.actuators if one.target == joint.name), None)
        if found is None and not wheel:
            self._problem(f"no actuator on joint {joint.name!r} ({key})", part.joint)
            return None
        if found is None:
            found = spec.add_actuator(target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        if wheel:
            self._drive(found)
        return found

    def _drive(self, actuator: Any) -> None:
        """Turn a wheel's actuator into a velocity servo of the same torque, unless it is one."""
        gear = float(actuator.gear[0]) or 1.0
        gain, bias = float(actuator.gainprm[0]), float(actuator.biasprm[2])
        low, high = map(float, actuator.forcerange)
        if gain > 0.0 and math.isclose(bias, -gain) and not actuator.biasprm[1]:
            if gear == 1.0:
                return
            gain *= gear * gear
            torque = high * abs(gear) if high > low else 0.0
        else:
            min_control, max_control = map(float, actuator.ctrlrange)
            torque = min(high, max_control * abs(gear)) if high > low else max_control * abs(gear)
            torque = torque if max_control > min_control else 0.0
            fastest = self._body.max_wheel_speed if isinstance(self._body, SimBody) else 1.0
            gain = torque / (SHARE_AT_FULL_TORQUE * fastest) if torque else 0.0
        if not gain:
            weight, radius = self._spec_mass(), self._wheel_radius()
            gain, torque = SERVO_GAIN * weight * radius**2, GRIP * weight * GRAVITY * radius
        actuator.set_to_velocity(gain)
        actuator.gear = np.array((1.0, 0, 0, 0, 0, 0))
        actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
        actuator.ctrlrange = np.zeros(2)
        limited = mujoco.mjtLimited.mjLIMITED_TRUE if torque else mujoco.mjtLimited.mjLIMITED_FALSE
        actuator.forcelimited, actuator.forcerange = limited, np.array((-torque, torque))

    def _wheel_radius(self) -> float:
        return self._body.wheel_radius if isinstance(self._body, SimBody) else 0.05

    def _spec_mass(self) -> float:
        return float(self._unchanged.compile().body_mass.sum())

    def _sensors(self, base: Any) -> None:
        """Find the sensors; add a missing inertial unit to the base."""
        spec, body = self._spec, self._body
        for key in [one for one in self._others() if one not in ("base", "lidar")]:
            name = self._text(key)
            sensor = spec.sensor(name)
            if sensor is not None:
                self._rename("sensor", sensor, key)
            elif key in IMU_SENSORS and key not in body.names:
                site = spec.site("imu") or base.add_site(name="imu")
                spec.add_sensor(
                    name=key, type=IMU_SENSORS[key], objtype=OBJECTS["site"], objname=site.name
                )
            else:
                self._missing("sensor", name, key, (one.name for one in spec.sensors))

    def _lidar(self, base: Any) -> None:
        """Find the lidar's site, or make one from a body or a height above the floor."""
        body, spec, name = self._body, self._spec, self._text("lidar")
        lidar = body.lidar
        if lidar is None:
            return
        site, carrier = spec.site(name), spec.body(name)
        if site is not None:
            self._rename("site", site, "lidar")
        elif carrier is not None:
            carrier.add_site(name="lidar")
        elif "lidar" not in body.names and lidar.height is not None:
            x, y, yaw = lidar.mount or (0.0, 0.0, 0.0)
            turn = (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))
            base.add_site(name="lidar", pos=(x, y, lidar.height - base.pos[2]), quat=turn)
        else:
            known = [one.name for one in spec.sites] + [one.name for one in spec.bodies]
            self._missing("site", name, "lidar", known)
            if "lidar" not in body.names:
                self._problem("no height for it either: `lidar_height`, above the floor, adds it")

    def _rename(self, kind: str, element: Any, name: str) -> None:
        """Rename an element, and all references to it."""
        if element.name == name:
            return
        other = getattr(self._spec, kind)(name)
        if other is not None:
            self._rename(kind, other, f"{name}_of_model")
        before = element.name
        if before:
            _check_tendons(self._spec, before, name)
        element.name = name
        if before:
            _refer(self._spec, kind, before, name)


def _of(name: str, key: str) -> bool:
    """Return whether a required name belongs to a part."""
    return name in (key, f"{key}_joint")


def _refer(spec: mujoco.MjSpec, kind: str, before: str, now: str) -> None:
    """Change a name in all references of a model to it."""
    for element, field in _references(spec, kind):
        if getattr(element, field) == before:
            setattr(element, field, now)


def _check_tendons(spec: mujoco.MjSpec, before: str, now: str) -> None:
    """Raise ValueError for a tendon over an element, whose references cannot be renamed."""
    for tendon in spec.tendons:
        wraps = [tendon.path[i] for i in range(len(tendon.path))]
        if any(getattr(wrap.target, "name", None) == before for wrap in wraps):
            raise ValueError(f"tendon {tendon.name!r} runs over {before!r}; call that {now!r}")


def _references(spec: mujoco.MjSpec, kind: str) -> Iterator[tuple[Any, str]]:
    """Yield elements that may refer to one of `kind`, and the field with that name."""
    for actuator in spec.actuators:
        if TARGETS.get(actuator.trntype, "joint") == kind:
            yield actuator, "target"
        if kind == "site":
            yield from ((actuator, "refsite"), (actuator, "slidersite"))
    for sensor in spec.sensors:
        if sensor.objtype == OBJECTS[kind]:
            yield sensor, "objname"
        if sensor.reftype == OBJECTS[kind]:
            yield sensor, "refname"
    for equality in spec.equalities:
        if (equality.type == mujoco.mjtEq.mjEQ_JOINT) == (kind == "joint"):
            yield from ((equality, "name1"), (equality, "name2"))
    for exclude in spec.excludes if kind == "body" else ():
        yield from ((exclude, "bodyname1"), (exclude, "bodyname2"))
    for pair in spec.pairs if kind == "geom" else ():
        yield from ((pair, "geomname1"), (pair, "geomname2"))


def _leave_out_scene(spec: mujoco.MjSpec) -> None:
    """Remove what belongs to a world: keyframes and the floor."""
    for key in list(spec.keys):
        spec.delete(key)
    for geom in list(spec.worldbody.geoms):
        spec.delete(geom)


def _hide(spec: mujoco.MjSpec) -> None:
    """Put all geoms into the robot's group; hide collision geoms if there are visual ones."""
    geoms = list(spec.geoms)
    if all(geom.group == ROBOT_GROUP for geom in geoms):
        return
    has_visuals = any(not one.contype and not one.conaffinity for one in geoms)
    for geom in geoms:
        if has_visuals and (geom.contype or geom.conaffinity):
            geom.rgba = np.zeros(4, np.float32)
        geom.group = ROBOT_GROUP


def _add_hull(base: Any, footprint: tuple[tuple[float, float], ...]) -> None:
    """Add a box round the footprint, for distances only: it touches nothing."""
    x, y = zip(*footprint, strict=True)
    middle = (HULL_BOTTOM_M + HULL_TOP_M) / 2 - base.pos[2]
    base.add_geom(
        name=f"{HULL}footprint",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=((max(x) + min(x)) / 2, (max(y) + min(y)) / 2, middle),
        size=((max(x) - min(x)) / 2, (max(y) - min(y)) / 2, (HULL_TOP_M - HULL_BOTTOM_M) / 2),
        rgba=(0, 0, 0, 0), mass=0, contype=0, conaffinity=0, group=ROBOT_GROUP,
    )  # fmt: skip
