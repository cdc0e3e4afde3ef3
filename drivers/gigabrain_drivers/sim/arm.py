"""The arm of a simulated body: position servos with encoders, and their wear."""

import math
from collections.abc import Mapping

import mujoco
import numpy as np

from gigabrain_drivers.sim import STEP_S
from gigabrain_drivers.sim.body import SimModel, SimServo
from gigabrain_drivers.sim.locomotion import Motor, MotorHeat
from gigabrain_drivers.sim.scene import ROBOT

SLIDES = mujoco.mjtJoint.mjJNT_SLIDE
METRES_PER_TICK = 1e-5  # encoder resolution of sliding joints


class SimArm:
    """Servos that hold their newest goals. They measure by their encoders only."""

    def __init__(self, body: SimModel, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self._data = data
        self.names = tuple(joint.name for joint in body.joints)
        joints = [model.joint(f"{ROBOT}{name}") for name in self.names]
        self._places = [int(joint.qposadr[0]) for joint in joints]
        self._dofs = [int(joint.dofadr[0]) for joint in joints]
        self._motors = [int(model.actuator(f"{ROBOT}{name}").id) for name in self.names]
        servos = [body.servos.get(name, SimServo()) for name in self.names]
        self._units = [
            METRES_PER_TICK if joint.type[0] == SLIDES else math.tau / servo.encoder_ticks
            for joint, servo in zip(joints, servos, strict=True)
        ]
        self._heat = [MotorHeat(servo) for servo in servos]
        step = model.opt.timestep
        self._smoothing = np.array(
            [math.exp(-step / s.smoothing) if s.smoothing else 0.0 for s in servos]
        )
        self._half_backlash = np.array([servo.backlash / 2 for servo in servos])
        self._amperes = [0.0] * len(joints)
        data.qpos[self._places] = body.posture
        self._now = self._before = self._measured()
        self._model = model
        ranges = model.actuator_forcerange[self._motors]
        self._max_efforts = dict(zip(self.names, ranges[:, 1].tolist(), strict=True))
        self._gains = model.actuator_gainprm[self._motors].copy()
        self._biases = model.actuator_biasprm[self._motors].copy()
        self._aims = dict(zip(self.names, self._at_rest(body.posture), strict=True))
        self._smoothed = np.array(self.targets)  # goals, as the motors get them
        self.limp = self._was_limp = False
        self.act()
        mujoco.mj_forward(model, data)  # computes the holding torques

    def restore(self, aims: tuple[float, ...], *, limp: bool) -> None:
        """Rest at the physics' joint positions, with the goals `aims` [rad] or [m]."""
        self._now = self._before = self._measured()
        self._aims = dict(zip(self.names, aims, strict=True))
        self._smoothed, self.limp = np.array(aims), limp
        self.act()

    @property
    def targets(self) -> tuple[float, ...]:
        """The servos' goals [rad] or [m], in the order of the description."""
        return tuple(self._aims[name] for name in self.names)

    def truth(self) -> tuple[list[float], list[float]]:
        """Return the true positions [rad] or [m] and speeds of the joints."""
        data = self._data
        return data.qpos[self._places].tolist(), data.qvel[self._dofs].tolist()

    def aim(self, positions: Mapping[str, float]) -> None:
        """Set goals of servos [rad] or [m]; switch on limp servos."""
        self._aims = {**self._aims, **positions}
        self.limp = False

    def limit(self, efforts: Mapping[str, float]) -> None:
        """Limit servos to `efforts` [N m] or [N], at most their own maximum."""
        for name, motor in zip(self.names, self._motors, strict=True):
            if name in efforts:
                limit = min(efforts[name], self._max_efforts[name])
                self._model.actuator_forcerange[motor] = -limit, limit

    def let_go(self) -> None:
        """Switch all servos off."""
        self.limp = True

    def act(self) -> None:
        """Set the servos for the next substep."""
        if self.limp != self._was_limp:
            self._was_limp = self.limp
            on = 0.0 if self.limp else 1.0
            self._model.actuator_gainprm[self._motors] = on * self._gains
            self._model.actuator_biasprm[self._motors] = on * self._biases
        now, goals = self._data.qpos[self._places], np.array(self.targets)
        self._smoothed = goals + self._smoothing * ((now if self.limp else self._smoothed) - goals)
        free = np.clip(self._smoothed - now, -self._half_backlash, self._half_backlash)
        self._data.ctrl[self._motors] = self._smoothed - free

    def sense(self) -> None:
        """Read the encoders after a step."""
        self._before, self._now = self._now, self._measured()

    def wear(self) -> float:
        """Heat the motors by the step's torque; return the current that it took [A]."""
        self._amperes = [
            heat.warm(0.0, effort) for heat, effort in zip(self._heat, self._efforts(), strict=True)
        ]
        return sum(self._amperes)

    def motors(self) -> tuple[Motor, ...]:
        """Return the servos' reports of all joints."""
        return tuple(
            Motor(name, now, (now - before) / STEP_S, effort, heat.celsius, amperes)
            for name, now, before, effort, heat, amperes in zip(
                self.names,
                self._now,
                self._before,
                self._efforts(),
                self._heat,
                self._amperes,
                strict=True,
            )
        )

    def _at_rest(self, posture: tuple[float, ...]) -> list[float]:
        """Return targets that hold a posture against gravity."""
        mujoco.mj_forward(self._model, self._data)
        weight = self._data.qfrc_bias[self._dofs]
        held: list[float] = (np.asarray(posture) + weight / self._gains[:, 0]).tolist()
        return held

    def _measured(self) -> tuple[float, ...]:
        places = zip(self._places, self._units, strict=True)
        return tuple(round(float(self._data.qpos[place]) / unit) * unit for place, unit in places)

    def _efforts(self) -> list[float]:
        return [float(self._data.actuator_force[motor]) for motor in self._motors]
