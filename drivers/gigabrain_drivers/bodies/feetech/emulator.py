"""A servo bus, emulated: six or more servos, each with the joint or the wheel that it moves."""

from collections.abc import Mapping
from pathlib import Path

from gigabrain_drivers.bodies.feetech import protocol as feetech
from gigabrain_drivers.bodies.feetech.calibration import (
    Calibration,
    calibration_path,
    load_calibration,
)
from gigabrain_drivers.bodies.feetech.driver import FeetechOptions
from gigabrain_drivers.bodies.feetech.protocol import FeetechDecoder
from gigabrain_drivers.bodies.feetech.servo import ServoBus, ServoModel
from gigabrain_drivers.driver.robot import RobotFile
from gigabrain_drivers.emulators.base import Device, EmulatedBody, Wire
from gigabrain_drivers.kinematics.wheels import Twist, wheels_of
from gigabrain_drivers.sim.locomotion import Motor

MAX_STEP_S = 0.1  # of simulated time at once; after a longer delay, the rest is dropped
STIFFNESS = 17.8  # [N m/rad], of the position servos in the model


class FeetechArm(Device):
    """A bus of servos that move the joints and wheels of the simulated body.

    It starts as an arm that is already switched on and holds; after a restart it is limp. There is
    no watchdog: servos keep their last goals for ever, including the speeds of wheels.
    """

    Options = FeetechOptions
    baud = feetech.BAUD
    goes_on = True
    promised_in = "the STS3215, which keeps its goal without a host"

    def __init__(self, body: EmulatedBody, options: FeetechOptions, wire: Wire) -> None:
        super().__init__(body, options, wire)
        self.servos = _servos(body.robot, options, body.run.folder)
        self.wheels = new_servos(options.wheels, options)
        self._base = wheels_of(body.robot) if self.wheels else None
        self.bus = ServoBus([*self.servos.values(), *self.wheels.values()])
        self._decoder = FeetechDecoder()
        self._stepped_ns: int | None = None
        self._started = body.resumed

    def reset(self) -> None:
        """Power on. After a restart there is no torque, and joints stay where they were."""
        self._decoder.clear()
        for servo, motor in zip(self.servos.values(), self.body.joints, strict=True):
            servo.step(0.0, motor.position, 0.0, 0.0)
            servo.power_on()
            if not self._started:
                servo.begin_holding(motor.effort / STIFFNESS)
        self._started = True
        for servo in self.wheels.values():
            servo.power_on()
        self._drive()

    def feed(self, data: bytes) -> None:
        """Execute instructions, and answer."""
        self.bus.silent = self.silent_servo
        for packet in self._decoder.feed(data):
            if answers := self.bus.execute(packet):
                self.wire.write(answers)

    def step(self, now_ns: int) -> None:
        """Simulate all servos."""
        before_ns = now_ns if self._stepped_ns is None else self._stepped_ns
        self._stepped_ns = now_ns
        seconds, aims, efforts = min(MAX_STEP_S, (now_ns - before_ns) / 1e9), {}, {}
        for servo, motor in zip(self.servos.values(), self.body.joints, strict=True):
            servo.supply = max(0.0, self.options.voltage - self.sag_volts)
            pull = 0.0 if servo.target is None else motor.effort  # a hand's effort is not its
            servo.step(seconds, motor.position, motor.velocity, pull)
            aims[motor.name] = motor.position if servo.target is None else servo.target
            efforts[motor.name] = servo.max_effort
        for name, servo in self.wheels.items():
            motor = self._wheel(name)
            servo.supply = max(0.0, self.options.voltage - self.sag_volts)
            servo.step(seconds, motor.position, motor.velocity, motor.effort)
        self._drive()
        if any(servo.target is not None for servo in self.servos.values()):
            self.body.aim(aims, efforts)
        else:
            self.body.let_go()

    def _wheel(self, name: str) -> Motor:
        joint = f"wheel_{name}_joint"
        return next(one for one in self.body.wheels if one.name == joint)

    def _drive(self) -> None:
        """Set the body's velocity from the speeds of its wheels' servos."""
        if self._base:
            speeds = tuple(self.wheels[name].speed for name in self._base.wheels)
            twist = self._base.to_body(speeds) if any(speeds) else Twist(0.0, 0.0, 0.0)
            self.body.command(*twist)


def _servos(robot: RobotFile, options: FeetechOptions, folder: Path) -> dict[str, ServoModel]:
    """Return calibrated servos, or factory-new ones without a calibration."""
    path = calibration_path(robot.robot_type, options.calibration, folder)
    if path.exists():
        calibration = load_calibration(path, robot.robot_type, robot.joints, options.servos)
        return calibrated_servos(calibration, options.voltage)
    return new_servos(options.servos, options)


def new_servos(ids: Mapping[str, int], options: FeetechOptions) -> dict[str, ServoModel]:
    """Return factory-new servos, each with its id."""
    return {
        name: ServoModel(servo, options.voltage, direction=-1 if name in options.inverted else 1)
        for name, servo in ids.items()
    }


def calibrated_servos(calibration: Calibration, voltage: float) -> dict[str, ServoModel]:
    """Return servos with the EEPROM values and mounting of a calibration."""
    servos = {}
    for name, its in calibration.joints.items():
        centre = its.zero + its.offset
        servos[name] = ServoModel(its.id, voltage, centre=centre, direction=its.direction)
        servos[name].keep(feetech.OFFSET, its.offset)
        servos[name].keep(feetech.MIN_POSITION, its.min_position)
        servos[name].keep(feetech.MAX_POSITION, its.max_position)
    return servos
