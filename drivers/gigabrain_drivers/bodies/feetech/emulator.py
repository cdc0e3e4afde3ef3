"""An arm on a servo bus, emulated: six or more servos, each with the joint that it moves."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from gigabrain_drivers.bodies.feetech import protocol as feetech
from gigabrain_drivers.bodies.feetech.calibration import (
    Calibration,
    calibration_path,
    load_calibration,
)
from gigabrain_drivers.bodies.feetech.driver import FeetechOptions
from gigabrain_drivers.bodies.feetech.protocol import FeetechDecoder
from gigabrain_drivers.bodies.feetech.servo import FreeJoint, ServoBus, ServoModel
from gigabrain_drivers.driver.robot import RobotFile
from gigabrain_drivers.emulators.base import Device, EmulatedBody, Wire

MAX_STEP_S = 0.1  # of time at once; a machine that was held up longer drops the rest
STOP_MARGIN = 0.02  # [rad] from a joint's limit to its mechanical stop


class FeetechArm(Device):
    """A bus of servos. They hold their last goals for ever: there is no watchdog."""

    Options = FeetechOptions
    baud = feetech.BAUD
    promised_in = "the STS3215, which holds its goal without a host"

    def __init__(self, body: EmulatedBody, options: FeetechOptions, wire: Wire) -> None:
        super().__init__(body, options, wire)
        self.joints = _joints(body.robot, feetech.STALL_TORQUE[options.voltage])
        self.servos = _servos(body.robot, options, body.run.folder)
        self.bus = ServoBus(list(self.servos.values()))
        self._decoder = FeetechDecoder()
        self._stepped_ns: int | None = None

    def reset(self) -> None:
        """Power on: no torque, and each joint where it was left."""
        self._decoder.clear()
        for name, servo in self.servos.items():
            joint = self.joints[name]
            servo.step(0.0, joint.position, 0.0, 0.0)
            servo.power_on()

    def place(self, ticks: Sequence[int]) -> None:
        """Put the joints, at rest, where their servos measure these ticks."""
        for joint, servo, at in zip(self.joints.values(), self.servos.values(), ticks, strict=True):
            joint.position, joint.velocity = servo.angle(at), 0.0
            servo.step(0.0, joint.position, 0.0, 0.0)

    def feed(self, data: bytes) -> None:
        """Execute instructions, and answer."""
        for packet in self._decoder.feed(data):
            if answers := self.bus.execute(packet):
                self.wire.write(answers)

    def step(self, now_ns: int) -> None:
        """Let all servos and joints go on."""
        before_ns = now_ns if self._stepped_ns is None else self._stepped_ns
        self._stepped_ns = now_ns
        seconds = min(MAX_STEP_S, (now_ns - before_ns) / 1e9)
        for name, servo in self.servos.items():
            joint = self.joints[name]
            servo.supply = max(0.0, self.options.voltage - self.sag_volts)
            servo.step(seconds, joint.position, joint.velocity, joint.effort)
            joint.step(seconds, servo.target, servo.max_effort)


def _joints(robot: RobotFile, stall: float) -> dict[str, FreeJoint]:
    """Return the joints at the arm's home."""
    home = robot.arm.home if robot.arm else [0.0] * len(robot.joints)
    return {
        joint.name: FreeJoint(
            joint.lower - STOP_MARGIN, joint.upper + STOP_MARGIN, position, stall_torque=stall
        )
        for joint, position in zip(robot.joints, home, strict=True)
    }


def _servos(robot: RobotFile, options: FeetechOptions, folder: Path) -> dict[str, ServoModel]:
    """Return servos as the calibration has left them, or as new ones where there is none."""
    path = calibration_path(robot.robot_type, options.calibration, folder)
    if path.exists():
        calibration = load_calibration(path, robot.robot_type, robot.joints, options.servos)
        return calibrated_servos(calibration, options.voltage)
    return new_servos(options.servos, options)


def new_servos(ids: Mapping[str, int], options: FeetechOptions) -> dict[str, ServoModel]:
    """Return servos as they leave the factory, each with its id."""
    return {
        name: ServoModel(servo, options.voltage, direction=-1 if name in options.inverted else 1)
        for name, servo in ids.items()
    }


def calibrated_servos(calibration: Calibration, voltage: float) -> dict[str, ServoModel]:
    """Return servos that keep what the calibration says, and are mounted so."""
    servos = {}
    for name, its in calibration.joints.items():
        centre = its.zero + its.offset
        servos[name] = ServoModel(its.id, voltage, centre=centre, direction=its.direction)
        servos[name].keep(feetech.OFFSET, its.offset)
        servos[name].keep(feetech.MIN_POSITION, its.min_position)
        servos[name].keep(feetech.MAX_POSITION, its.max_position)
    return servos
