"""A model of the STS3215: control table, motion profile, protections; and a bus of servos.

It has no physics: `step` gets the joint's motion, and sets the angle and torque that the motor
holds.
"""

import math
from collections.abc import Sequence

from gigabrain_drivers.bodies.feetech import protocol as feetech
from gigabrain_drivers.bodies.feetech.protocol import RADIANS_PER_TICK, FeetechPacket, Register

TABLE_SIZE = 71
FIRMWARE = (3, 10)
READ_ONLY = (*range(5), *range(50, 55), *range(56, TABLE_SIZE))
VOLTAGES = {7.4: (80, 40), 12.0: (140, 95)}  # 0.1 V: maximum and minimum, by variant
VELOCITY_MODE = 1
NO_LOAD_SPEED = 4.7  # [rad/s]
DERIVATIVE_S = 0.02  # derivative gain / proportional gain of its position loop
MAX_LEAD = 0.15  # [rad] of the setpoint before the joint; the stall torque needs less
AMPERES_AT_STALL = 2.7
IDLE_AMPERES = 0.006
SUPPLY_OHMS = 0.05  # of the cable
BROWN_OUT_V = 4.0  # below it the processor restarts
AMBIENT = 25.0  # [deg C]
STALL_WARMING = 0.6  # [K/s] of the winding at the stall torque
COOLING_S = 180.0  # time constant
BACKLASH = math.radians(1.0)  # play of the gears
SUBSTEP_S = 0.001


class ServoModel:
    """One servo. `centre` is its encoder's reading at the joint's zero, before any offset."""

    def __init__(
        self, servo: int, voltage: float = 7.4, *, centre: int = 2048, direction: int = 1
    ) -> None:
        self.stall_torque = feetech.STALL_TORQUE[voltage]  # [N m]
        self.target: float | None = None  # [rad], angle that the motor holds; None: no torque
        self.speed = 0.0  # [rad/s], in velocity mode
        self.max_effort = 0.0  # [N m]
        self.supply = voltage  # [V]
        self.goals = 0  # number of written goals
        self._centre, self._direction = centre, direction
        self._eeprom = bytearray(feetech.EEPROM_SIZE)
        self._table = bytearray(TABLE_SIZE)
        self._queued: tuple[int, bytes] | None = None
        self._position = self._velocity = self._effort = 0.0
        self._setpoint = self._setpoint_speed = 0.0
        self._heat = AMBIENT
        self._overloaded_s, self._latched = 0.0, False
        max_voltage, min_voltage = VOLTAGES[voltage]
        self._table[0:2] = bytes(FIRMWARE)
        for register, value in (
            (feetech.MODEL_NUMBER, feetech.MODEL),
            (feetech.ID, servo),
            (Register(7), 250),
            (Register(8), 1),
            (feetech.MAX_POSITION, feetech.TICKS - 1),
            (feetech.MAX_TEMPERATURE, 70),
            (feetech.MAX_VOLTAGE, max_voltage),
            (feetech.MIN_VOLTAGE, min_voltage),
            (feetech.MAX_TORQUE, 1000),
            (feetech.P_GAIN, 32),
            (Register(22), 32),
            (feetech.PROTECTIVE_TORQUE, 20),
            (feetech.PROTECTION_TIME, 200),
            (feetech.OVERLOAD_TORQUE, 80),
        ):
            self[register] = value
        self._eeprom[:] = self._table[: feetech.EEPROM_SIZE]
        self.power_on()

    def __getitem__(self, register: Register) -> int:
        at = register.address
        raw = int.from_bytes(self._table[at : at + register.size], "little")
        return feetech.signed(raw, register.sign)

    def __setitem__(self, register: Register, value: int) -> None:
        """Set an item without the firmware's checks."""
        data = register.encode(value)
        self._table[register.address : register.address + register.size] = data

    @property
    def id(self) -> int:
        """Its address on the bus."""
        return self[feetech.ID]

    @property
    def kept(self) -> bytes:
        """The stored content of the EEPROM."""
        return bytes(self._eeprom)

    def keep(self, register: Register, value: int) -> None:
        """Set an item of the EEPROM, as its maker or a calibration does."""
        self[register] = value
        self._eeprom[:] = self._table[: feetech.EEPROM_SIZE]
        self._measure()

    def power_on(self) -> None:
        """Start with the EEPROM's values, no torque, and the present position as goal."""
        self._table[: feetech.EEPROM_SIZE] = self._eeprom
        self._table[feetech.EEPROM_SIZE :] = bytes(TABLE_SIZE - feetech.EEPROM_SIZE)
        self[feetech.TORQUE_LIMIT] = self[feetech.MAX_TORQUE]
        self[feetech.LOCK] = 1
        self._latched, self._overloaded_s, self._queued = False, 0.0, None
        self.target, self.max_effort, self.speed = None, 0.0, 0.0
        self._measure()
        self[feetech.GOAL] = self[feetech.POSITION]

    def begin_holding(self, lead: float) -> None:
        """Hold the joint in a steady state, with the goal `lead` [rad] before the position."""
        lead += math.copysign(BACKLASH / 2, lead)
        self[feetech.GOAL] += round(self._direction * lead / RADIANS_PER_TICK)
        self.write(feetech.TORQUE.address, b"\1")
        self._setpoint += lead

    def read(self, address: int, length: int) -> bytes:
        """Return bytes of the table; beyond its end they are zero."""
        return bytes(self._table[address : address + length]).ljust(length, b"\0")

    def write(self, address: int, data: bytes) -> None:
        """Write bytes, except read-only ones."""
        torque = self[feetech.TORQUE]
        for place, value in enumerate(data, address):
            if place in READ_ONLY or place >= TABLE_SIZE:
                continue
            self._table[place] = value
            if place < feetech.EEPROM_SIZE and not self[feetech.LOCK]:
                self._eeprom[place] = value
        written = range(address, address + len(data))
        if feetech.GOAL.address in written:
            self.goals += 1
            if self._latched and (self.goal - self._position) * self._effort <= 0.0:
                self._latched = False  # a new goal ends the protection
        if not torque and self[feetech.TORQUE]:
            self._setpoint, self._setpoint_speed = self._position, 0.0
        if not self[feetech.TORQUE]:
            self._latched = False

    def queue(self, address: int, data: bytes) -> None:
        """Keep a write until the action comes."""
        self._queued = (address, data)

    def act(self) -> None:
        """Execute the queued write."""
        if self._queued:
            self.write(*self._queued)
        self._queued = None

    def step(self, seconds: float, position: float, velocity: float, effort: float) -> None:
        """Run the firmware for `seconds`, with the joint's motion [rad, rad/s, N m]."""
        self._position, self._velocity, self._effort = position, velocity, effort
        load = abs(effort) / self.stall_torque
        self._heat += seconds * (STALL_WARMING * load**2 - (self._heat - AMBIENT) / COOLING_S)
        self._measure()
        if self.supply < BROWN_OUT_V:
            self.power_on()
            return
        self._watch_load(load, seconds)
        if not self[feetech.TORQUE]:
            self.target, self.max_effort, self.speed = None, 0.0, 0.0
            return
        if self[feetech.MODE] == VELOCITY_MODE:
            self._follow_speed()
            return
        self._follow_profile(seconds)
        share = self[feetech.TORQUE_LIMIT] / 1000
        if self._latched:
            share = min(share, self[feetech.PROTECTIVE_TORQUE] / 100)
        off = self._setpoint - position
        play = math.copysign(min(abs(off), BACKLASH / 2), off)
        damps = DERIVATIVE_S * (self._setpoint_speed - velocity)
        self.target, self.max_effort = self._setpoint - play + damps, share * self.stall_torque

    def _watch_load(self, load: float, seconds: float) -> None:
        """Latch the overload protection after its time above its torque."""
        if load < self[feetech.OVERLOAD_TORQUE] / 100:
            self._overloaded_s = 0.0
            return
        self._overloaded_s += seconds
        if self._overloaded_s >= self[feetech.PROTECTION_TIME] / 100:
            self._latched = True

    @property
    def goal(self) -> float:
        """The goal [rad], within the limits of its EEPROM."""
        lower, upper = self[feetech.MIN_POSITION], self[feetech.MAX_POSITION]
        ticks = self[feetech.GOAL]
        ticks = max(lower, min(upper, ticks)) if lower < upper else ticks
        return self.angle(ticks)

    def angle(self, ticks: int) -> float:
        """Return the angle of the joint [rad] for `ticks`."""
        return (ticks + self[feetech.OFFSET] - self._centre) * RADIANS_PER_TICK * self._direction

    def _follow_profile(self, seconds: float) -> None:
        """Move the setpoint towards the goal, within speed and acceleration."""
        goal, at, speed = self.goal, self._setpoint, self._setpoint_speed
        if at == goal and not speed:
            return
        units = self[feetech.ACCELERATION] or feetech.MAX_ACCELERATION
        acceleration = units * feetech.ACCELERATION_UNIT * RADIANS_PER_TICK
        max_speed = abs(self[feetech.GOAL_VELOCITY]) * RADIANS_PER_TICK or NO_LOAD_SPEED
        max_speed, step = min(max_speed, NO_LOAD_SPEED), acceleration * SUBSTEP_S
        for _ in range(round(seconds / SUBSTEP_S)):
            left = goal - at
            if abs(left) <= step * SUBSTEP_S and abs(speed) <= 2 * step:
                at, speed = goal, 0.0
                break
            wanted = math.copysign(min(max_speed, math.sqrt(2 * acceleration * abs(left))), left)
            speed += max(-step, min(step, wanted - speed))
            at += speed * SUBSTEP_S if abs(speed * SUBSTEP_S) < abs(left) else left
        lead = max(-MAX_LEAD, min(MAX_LEAD, at - self._position))
        self._setpoint, self._setpoint_speed = self._position + lead, speed

    def _follow_speed(self) -> None:
        """Turn at the goal's speed, without a ramp: the simulated body has its own."""
        wanted = self._direction * self[feetech.GOAL_VELOCITY] * RADIANS_PER_TICK
        wanted = 0.0 if self._latched else wanted
        self.target, self.max_effort = None, self.stall_torque
        self.speed = max(-NO_LOAD_SPEED, min(NO_LOAD_SPEED, wanted))

    def _measure(self) -> None:
        ticks = self._direction * self._position / RADIANS_PER_TICK
        encoder = round(ticks) + self._centre
        speed = self._direction * self._velocity / RADIANS_PER_TICK
        load = self._direction * self._effort / self.stall_torque
        amperes = IDLE_AMPERES + abs(load) * AMPERES_AT_STALL
        self[feetech.POSITION] = (encoder - self[feetech.OFFSET]) % feetech.TICKS
        self[feetech.VELOCITY] = round(max(-9999, min(9999, speed)))
        self[feetech.LOAD] = round(max(-1.0, min(1.0, load)) * 1000)
        self[feetech.CURRENT] = round(amperes / feetech.CURRENT_UNIT)
        self[feetech.VOLTAGE] = round(max(0.0, self.supply - amperes * SUPPLY_OHMS) * 10)
        self[feetech.TEMPERATURE] = round(self._heat)
        self[feetech.MOVING] = abs(speed) > 20
        self[feetech.STATUS] = self._status()

    def _status(self) -> int:
        """Return the bits of the present faults."""
        voltage = self[feetech.VOLTAGE]
        wrong = 0x20 if self._latched else 0
        if not self[feetech.MIN_VOLTAGE] <= voltage <= self[feetech.MAX_VOLTAGE] + 5:
            wrong |= 0x01
        if self._heat > self[feetech.MAX_TEMPERATURE]:
            wrong |= 0x04
        return wrong


class ServoBus:
    """The servos on one line, with their answers and collisions."""

    def __init__(self, servos: Sequence[ServoModel]) -> None:
        self.servos = list(servos)
        self.silent = 0  # id of a servo that neither receives nor answers

    def execute(self, packet: FeetechPacket) -> bytes:
        """Execute an instruction; return the answers."""
        kind, params = packet.instruction, packet.params
        if kind == feetech.SYNC_WRITE and len(params) > 2:
            for servo, data in feetech.sync_items(params):
                for model in self._at(servo):
                    model.write(params[0], data)
            return b""
        if kind == feetech.SYNC_READ and len(params) > 2:
            read = FeetechPacket(0, feetech.READ, params[:2])
            return b"".join(self._asked(servo, read) for servo in params[2:])
        if packet.id == feetech.BROADCAST:
            for model in self.servos:
                if model.id != self.silent:
                    _executed(model, packet)
            return b""
        return self._asked(packet.id, packet)

    def _at(self, servo: int) -> list[ServoModel]:
        return [model for model in self.servos if model.id == servo != self.silent]

    def _asked(self, servo: int, packet: FeetechPacket) -> bytes:
        """Return the answer of a servo; of two with one id, the collision of both."""
        answer = b""
        for model in self._at(servo):
            data = _executed(model, packet)
            if data is None:
                continue
            its = feetech.status(servo, data, model[feetech.STATUS])
            answer = bytes(a & b for a, b in zip(answer, its, strict=False)) if answer else its
        return answer


def _executed(model: ServoModel, packet: FeetechPacket) -> bytes | None:
    """Return the parameters of the answer, or None without an answer."""
    kind, params = packet.instruction, packet.params
    if kind == feetech.PING:
        return b""
    if kind == feetech.READ and len(params) == 2:
        return model.read(params[0], params[1])
    if kind == feetech.WRITE and len(params) > 1:
        model.write(params[0], params[1:])
        return b""
    if kind == feetech.REG_WRITE and len(params) > 1:
        model.queue(params[0], params[1:])
        return b""
    if kind == feetech.ACTION:
        model.act()
        return b""
    return None
