"""AgileX Piper's controller and drives, firmware V1.8, as seen by its driver and the SDK.

Its servos follow their targets within speed and acceleration. It has no watchdog: without commands
it goes to its last targets and stays there. It starts as an arm that is already switched on and
holds; after a restart it falls.
"""

import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gigabrain_drivers.bodies.piper import protocol as piper
from gigabrain_drivers.bodies.piper.driver import PiperOptions
from gigabrain_drivers.bodies.piper.protocol import JOINTS, ArmStatus, Drive, Gripper, Motor
from gigabrain_drivers.emulators.base import Device, EmulatedBody, Port, Wire
from gigabrain_drivers.emulators.can_port import CanPort
from gigabrain_drivers.links.can_link import CanDecoder, CanFrame, records

STEP_S = 0.01  # of the physics; the real arm reports twice as often
MAX_STEPS = 10  # simulated at once after a delay of the host
DRIVES_EVERY = 3  # steps between two slow reports
LIMITS = (  # [rad], of the vendor's SDK
    (-2.6179, 2.6179), (0.0, 3.14), (-2.967, 0.0), (-1.745, 1.745), (-1.22, 1.22),
    (-2.09439, 2.09439),
)  # fmt: skip
MAX_WIDTH = 0.07  # [m]
MAX_SPEED, GRIPPER_SPEED = 3.0, 0.15  # [rad/s], [m/s] of a finger
ACCELERATION, GRIPPER_ACCELERATION = 20.0, 2.0  # [rad/s2], [m/s2]
SINK_SPEED = 0.3  # [rad/s], with the motors' damping alone
SAGGING = (1, 2)  # joints that gravity moves
NOMINAL_V, LOW_V, OFF_V = 24.0, 20.0, 14.0
INERTIA = 0.1  # [kg m2], of a joint
FINGER_LEVER = 0.02  # [m], from the gripper's torque to the force of a finger
HOMED = 0x80  # bit of the gripper's status
ASK_VERSION = bytes((1, *[0] * 7))
VERSION = b"HW-V1.0\0S-V1.8-1"


class Servo:
    """A motor that follows its target, within speed and acceleration."""

    def __init__(self, max_speed: float, acceleration: float) -> None:
        self.position = self.speed = self.target = 0.0
        self.on = True
        self._max_speed, self._acceleration = max_speed, acceleration

    def follow(self, share: float = 1.0) -> None:
        """Move for a step, at most at a share of the maximal speed."""
        error = self.target - self.position
        braking = math.sqrt(1.8 * self._acceleration * abs(error))  # brakes a little early
        wanted = min(self._max_speed * share, braking, abs(error) / STEP_S)
        most = self._acceleration * STEP_S
        change = math.copysign(wanted, error) - self.speed
        self._move(self.speed + max(-most, min(most, change)))

    def push(self, torque: float) -> None:
        """Move for a step by a torque [N m]."""
        self._move(self.speed + torque / INERTIA * STEP_S)

    def sink(self) -> None:
        """Slow down for a step, braked only by the motor's damping."""
        self._move(math.copysign(min(SINK_SPEED, abs(self.position) / STEP_S), -self.position))

    def stay(self, position: float) -> None:
        """Set the position, at rest."""
        self.position, self.speed = position, 0.0

    def _move(self, speed: float) -> None:
        self.speed = speed
        self.position += speed * STEP_S


class Piper(Device):
    """Reports its joints 100 times a second; obeys targets, modes and its stop."""

    Options = PiperOptions
    period_s = STEP_S
    promised_in = "no watchdog: it goes to its last targets"

    def __init__(self, body: EmulatedBody, options: Any, wire: Wire) -> None:
        super().__init__(body, options, wire)
        self.faults = [0] * JOINTS  # bits of FAULT_TEXTS, by drive
        self.joints = [Servo(MAX_SPEED, ACCELERATION) for _ in range(JOINTS)]
        self.gripper = Servo(GRIPPER_SPEED, GRIPPER_ACCELERATION)
        self._servos = (*self.joints, self.gripper)
        for servo, motor in zip(self._servos, body.joints, strict=True):
            servo.position = servo.target = motor.position
        self._handlers: dict[int, Callable[[bytes], None]] = {
            piper.STOP: self._stop,
            piper.MODE: self._set_mode,
            piper.MOVE_GRIPPER: self._move_gripper,
            piper.ENABLE: self._enable,
            piper.ASK_LIMITS: self._send_limits,
            piper.CONFIGURE: self._configure,
            piper.FIRMWARE: self._send_version,
        }
        self._started = body.resumed
        self._forget()

    @classmethod
    def port(cls, options: Any) -> Port:
        """Return the bus that it is plugged into."""
        return CanPort(Path(options.port))

    def reset(self) -> None:
        """Power on. After a restart the motors are off, and earlier commands are forgotten."""
        if self._started:
            self._power_off()
        self._started = True
        self._forget()

    def _forget(self) -> None:
        self.status = ArmStatus()
        self._speed_share, self._by_torque = 1.0, False
        self._swallowed = 0  # number of commands to switch on that it will still ignore
        self._mit: dict[int, piper.MitCommand] = {}
        self._steps, self._stepped_ns = 0, 0

    def feed(self, data: bytes) -> None:
        """Obey frames."""
        for id_, payload in CanDecoder().feed(data):
            if len(payload) != 8:
                continue
            if id_ in self._handlers:
                self._handlers[id_](payload)
            elif 0 <= id_ - piper.MOVE < JOINTS // 2:
                self._move(2 * (id_ - piper.MOVE), payload)
            elif 0 <= id_ - piper.MIT < JOINTS and (command := piper.decode_mit(payload)):
                self._mit[id_ - piper.MIT] = command

    def step(self, now_ns: int) -> None:
        """Simulate the elapsed time, and report."""
        since = now_ns - self._stepped_ns if self._stepped_ns else 0
        due = max(1, min(MAX_STEPS, round(since / 1e9 / STEP_S)))
        self._stepped_ns = now_ns
        voltage = max(NOMINAL_V - self.sag_volts, 0.0)
        if voltage < OFF_V:
            self._power_off()
        for _ in range(due):
            self._advance()
        if voltage >= OFF_V:
            self._report(voltage)

    def _power_off(self) -> None:
        for servo in self._servos:
            servo.on = False

    def _advance(self) -> None:
        measured = self.body.joints
        for at, servo in enumerate(self.joints):
            self._advance_joint(at, servo, measured[at].position)
        if self.gripper.on:
            self.gripper.follow()
        else:
            self.gripper.stay(measured[-1].position)
        if any(servo.on for servo in self._servos):
            names = (motor.name for motor in measured)
            places = (servo.position for servo in self._servos)
            self.body.aim(dict(zip(names, places, strict=True)))
        else:
            self.body.let_go()

    def _advance_joint(self, at: int, servo: Servo, measured: float) -> None:
        obeys = self.status.control == piper.BY_CAN and self.status.state != piper.STOPPED
        if not servo.on:
            servo.stay(measured)
        elif obeys and self._by_torque and at in self._mit:
            servo.push(_torque(servo, self._mit[at]))
        elif obeys:
            servo.follow(self._speed_share)
        elif self.status.state == piper.STOPPED and at in SAGGING:
            servo.sink()
        else:
            servo.stay(servo.position)

    def _report(self, voltage: float) -> None:
        self._steps += 1
        *arm, hand = self.body.joints
        off = any(abs(s.target - s.position) > 10 * piper.ANGLE_UNIT for s in self.joints)
        frames = [piper.encode_status(self.status._replace(moving=int(off)))]
        frames += piper.pairs(piper.POSITIONS, [motor.position for motor in arm])
        bits = piper.ENABLED * self.gripper.on | HOMED | (voltage < LOW_V)
        frames.append(
            piper.encode_gripper(Gripper(2 * hand.position, hand.effort * FINGER_LEVER, bits))
        )
        for at, motor in enumerate(arm):
            current = motor.effort / piper.TORQUE_PER_AMPERE[at] if self.joints[at].on else 0.0
            frames.append(piper.encode_motor(at, Motor(motor.velocity, current)))
        if self._steps % DRIVES_EVERY == 0:
            for at, motor in enumerate(arm):
                bits = self.faults[at] | piper.ENABLED * self.joints[at].on | (voltage < LOW_V)
                heat = motor.temperature
                frames.append(piper.encode_drive(at, Drive(voltage, heat, heat, bits, 0.0)))
        self._send(*frames)

    def _send(self, *frames: CanFrame) -> None:
        self.wire.write(records(frames))

    def _stop(self, data: bytes) -> None:
        if data[0] == piper.SINK:
            self.status = self.status._replace(state=piper.STOPPED)
        elif data[0] == piper.RESET:
            self._power_off()
            self.status, self._swallowed = ArmStatus(), 1

    def _set_mode(self, data: bytes) -> None:
        control, move, speed, kind = data[:4]
        if control in (piper.STANDBY, piper.BY_CAN) and speed <= piper.FULL_SPEED:
            self.status = self.status._replace(control=control, move=move)
            self._speed_share, self._by_torque = speed / piper.FULL_SPEED, kind == piper.MIT_MODE

    def _move(self, first: int, data: bytes) -> None:
        """Store two targets, in any mode."""
        wrong = 0
        for at, angle in enumerate(piper.decode_pair(data), first):
            lower, upper = LIMITS[at]
            if lower - piper.ANGLE_UNIT <= angle <= upper + piper.ANGLE_UNIT:
                self.joints[at].target = angle
            else:
                wrong |= 0x100 << at
        faults = self.status.faults & ~(0x300 << first) | wrong
        state = piper.OUT_OF_LIMITS if faults else piper.NORMAL
        if self.status.state in (piper.NORMAL, piper.OUT_OF_LIMITS):
            self.status = self.status._replace(state=state, faults=faults)

    def _move_gripper(self, data: bytes) -> None:
        width, _, state, _ = piper.decode_gripper_command(data)
        self.gripper.on = bool(state & 1)
        self.gripper.target = max(0.0, min(MAX_WIDTH, width)) / 2

    def _enable(self, data: bytes) -> None:
        motor, on = data[0], data[1] == 2
        if on and self._swallowed:
            self._swallowed -= 1
            return
        for at, servo in enumerate(self.joints):
            if motor in (at + 1, piper.ALL_MOTORS, 0xFF):
                servo.on = on
        self._send(CanFrame(piper.ANSWER, bytes((piper.ENABLE & 0xFF, *[0] * 7))))

    def _configure(self, data: bytes) -> None:
        """Clear the faults of one motor or of all."""
        if data[5] == piper.CLEAR:
            for at in range(JOINTS):
                if data[0] in (at + 1, piper.ALL_MOTORS):
                    self.faults[at] = 0
        self._send(CanFrame(piper.ANSWER, bytes((piper.CONFIGURE & 0xFF, *[0] * 7))))

    def _send_limits(self, data: bytes) -> None:
        motor, what = data[0], data[1]
        if not 1 <= motor <= JOINTS:
            return
        if what == 1:
            tenths = [round(math.degrees(limit) * 10) for limit in LIMITS[motor - 1]]
            speed = round(MAX_SPEED / piper.SPEED_UNIT)
            raw = struct.pack(">BhhHx", motor, tenths[1], tenths[0], speed)
            self._send(CanFrame(piper.LIMITS, raw))
        elif what == 2:
            raw = struct.pack(">BH5x", motor, round(ACCELERATION / 0.001))
            self._send(CanFrame(piper.MAX_ACCELERATION, raw))

    def _send_version(self, data: bytes) -> None:
        """Answer a question; ignore an own answer that the bus returns."""
        if data != ASK_VERSION:
            return
        parts = (VERSION[at : at + 8] for at in range(0, len(VERSION), 8))
        self._send(*(CanFrame(piper.FIRMWARE, part.ljust(8, b"\0")) for part in parts))


def _torque(servo: Servo, wanted: piper.MitCommand) -> float:
    return (
        wanted.kp * (wanted.position - servo.position)
        + wanted.kd * (wanted.speed - servo.speed)
        + wanted.torque
    )
