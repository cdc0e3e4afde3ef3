"""TurtleBot3's OpenCR board with the firmware of `turtlebot3_ros2`, version 5."""

import math
import struct
from collections.abc import Mapping
from typing import Any

from gigabrain_drivers.bodies.turtlebot3 import protocol as opencr
from gigabrain_drivers.bodies.turtlebot3.driver import OpenCrOptions
from gigabrain_drivers.bodies.turtlebot3.protocol import DynamixelPacket
from gigabrain_drivers.emulators.base import Device, EmulatedBody, Wire

FIRMWARE = 5
BUFFER_BYTES = 1024  # of the slave library; longer packets are not answered
CALIBRATION_NS = 5_000_000_000  # meanwhile the board does nothing else
BROWN_OUT_V = 7.0  # below it the board is off
MODELS = {"turtlebot3_burger": (1, 61), "turtlebot3_waffle": (2, 77)}  # number, maximal rpm
WHEEL_RADIUS = 0.033  # [m], in the firmware
WHEEL_UNITS = 1263.632956882  # of the motors per [m/s]
MAX_UNITS = 337
AMPERES_PER_NM = 1 / 1.07
FIRST_TICKS = (1234, 3210)  # a motor's absolute encoder does not start at 0
MODEL, MODEL_INFO, MILLIS, DEBUG, HOST, STATUS = 0, 2, 10, 14, 15, 18
BUMPERS, VOLTAGE, PERCENTAGE, CALIBRATE = 28, 42, 46, 59
GYRO, ACCELERATION, ORIENTATION = 60, 72, 96
CURRENT, SPEED, POSITION, MOTORS, TORQUE = 120, 128, 136, 148, 149
FORWARD, TURN = 150, 170
ITEMS = {  # address -> type
    **dict.fromkeys((6, 7, 8, 9, opencr.HEARTBEAT, 50), "B"),
    **dict.fromkeys((DEBUG, HOST, 16, *range(20, 24), *range(26, 30)), "?"),
    **dict.fromkeys((CALIBRATE, MOTORS, TORQUE), "?"),
    **dict.fromkeys((MODEL_INFO, MILLIS, 34, VOLTAGE, PERCENTAGE, 174, 178), "I"),
    **dict.fromkeys((38, *range(GYRO, 112, 4)), "f"),
    **dict.fromkeys((*range(CURRENT, 144, 4), *range(FORWARD, 174, 4)), "i"),
    STATUS: "b",
    MODEL: "H",
    30: "H",
}


class ControlTable:
    """Reads and writes like the vendor's slave library: only whole items; gaps are zero."""

    def __init__(self, items: Mapping[int, str]) -> None:
        """`items` by address, each a `struct` code of one value."""
        self._codes = {address: struct.Struct("<" + code) for address, code in items.items()}
        self._data = bytearray(max(address + code.size for address, code in self._codes.items()))

    def __getitem__(self, address: int) -> float:
        return float(self._codes[address].unpack_from(self._data, address)[0])

    def __setitem__(self, address: int, value: float) -> None:
        code = self._codes[address]
        code.pack_into(self._data, address, value if code.format[-1:] in "fd" else round(value))

    def put(self, address: int, code: str, *values: float) -> None:
        """Set items of the same type in a row."""
        size = struct.calcsize(code)
        for place, value in enumerate(values):
            self[address + place * size] = value

    def read(self, address: int, length: int) -> bytes:
        """Return the answer to a READ of this range."""
        answer = bytearray(length)
        for at in self._inside(address, length):
            size = self._codes[at].size
            answer[at - address : at - address + size] = self._data[at : at + size]
        return bytes(answer)

    def write(self, address: int, data: bytes) -> list[int]:
        """Execute a WRITE; return the addresses of the written items."""
        reached = self._inside(address, len(data))
        for at in reached:
            size = self._codes[at].size
            self._data[at : at + size] = data[at - address : at - address + size]
        return reached

    def _inside(self, address: int, length: int) -> list[int]:
        """Return the items that are wholly in a range."""
        end = address + length
        return [at for at, code in self._codes.items() if address <= at and at + code.size <= end]


class OpenCr(Device):
    """Answers ping, read and write; moves the wheels while the heartbeat changes."""

    Options = OpenCrOptions
    period_s = 0.02  # of the table's refresh, and of the motors' control
    watchdog_ns = 500_000_000  # after the heartbeat's last change
    promised_in = "OpenCR's firmware"

    def __init__(self, body: EmulatedBody, options: Any, wire: Wire) -> None:
        super().__init__(body, options, wire)
        self._model, rpm = MODELS.get(body.robot.robot_type, MODELS["turtlebot3_burger"])
        self._separation = body.robot.wheel_separation
        self._max_linear = WHEEL_RADIUS * math.tau * rpm / 60
        self._max_angular = self._max_linear / (self._separation / 2)
        self.reset()

    def reset(self) -> None:
        """Start as after power-on; it never sends by itself."""
        self._decoder = opencr.DynamixelDecoder(BUFFER_BYTES)
        self._table = ControlTable(ITEMS)
        self._goal = (0.0, 0.0)
        self._on = True
        self._began_ns: int | None = None
        self._changed_ns = 0  # last change of the heartbeat
        self._beat = 0.0
        self._calibrating_ns = 0  # end of the calibration
        self._waiting = bytearray()  # received during the calibration
        table = self._table
        table[MODEL], table[MODEL_INFO], table[6] = opencr.MODEL, self._model, FIRMWARE
        table[7], table[8], table[9] = opencr.ID, 3, 2
        table[STATUS], table[MOTORS], table[TORQUE] = opencr.RUNNING, True, True
        self._refresh(0)
        self.body.command(0.0, 0.0, 0.0)

    def feed(self, data: bytes) -> None:
        """Execute instructions; while it calibrates they wait."""
        if not self._on:
            return
        if self._calibrating_ns:
            self._waiting += data[: BUFFER_BYTES - len(self._waiting)]
            return
        for packet in self._decoder.feed(data):
            if packet.id == opencr.ID:
                self._execute(packet)

    def step(self, now_ns: int) -> None:
        """Do one pass of the firmware's main loop."""
        on = self.body.snapshot.battery.voltage - self.sag_volts >= BROWN_OUT_V
        if on != self._on:
            self.reset()
            self._on = on
        if not on:
            return
        if self._began_ns is None:
            self._began_ns = self._changed_ns = now_ns
        if self._calibrating_ns:
            self._calibrate(now_ns)
            return
        self._watch_host(now_ns)
        self._refresh(now_ns - self._began_ns)
        self._drive()

    def _execute(self, packet: DynamixelPacket) -> None:
        kind, params = packet.instruction, packet.params
        if kind == opencr.PING:
            self._answer(opencr.MODEL.to_bytes(2, "little") + bytes([FIRMWARE]))
        elif kind == opencr.READ and len(params) == 4:
            address, length = params[0] | params[1] << 8, params[2] | params[3] << 8
            if length + 11 <= BUFFER_BYTES:
                self._answer(self._table.read(address, length))
        elif kind == opencr.WRITE and len(params) > 2:
            reached = self._table.write(params[0] | params[1] << 8, params[2:])
            if CALIBRATE in reached and self._table[CALIBRATE]:
                self._calibrating_ns = -1  # begins in the next pass; the answer follows at its end
                return
            self._written(reached)
            self._answer()

    def _written(self, reached: list[int]) -> None:
        forward, turn = self._goal
        if FORWARD in reached:
            forward = _clamp(self._table[FORWARD] * 0.01, self._max_linear)
        if TURN in reached:
            turn = _clamp(self._table[TURN] * 0.01, self._max_angular)
        self._goal = (forward, turn)

    def _answer(self, data: bytes = b"") -> None:
        self.wire.write(opencr.status(opencr.ID, data))

    def _watch_host(self, now_ns: int) -> None:
        """Watch the heartbeat; without a host the goal is zero."""
        table = self._table
        if table[opencr.HEARTBEAT] != self._beat:
            self._beat, self._changed_ns = table[opencr.HEARTBEAT], now_ns
            table[HOST] = True
        elif now_ns - self._changed_ns >= self.watchdog_ns:
            table[HOST] = False
        if not table[HOST] and not table[DEBUG]:
            self._goal = (0.0, 0.0)

    def _drive(self) -> None:
        forward, turn = self._goal if self._table[TORQUE] else (0.0, 0.0)
        offset = turn * self._separation / 2
        left, right = _units(forward - offset), _units(forward + offset)
        speed = (left + right) / 2 / WHEEL_UNITS
        self.body.command(speed, 0.0, (right - left) / WHEEL_UNITS / self._separation)

    def _calibrate(self, now_ns: int) -> None:
        """Block the main loop during a calibration; the wheels keep their speed."""
        if self._calibrating_ns < 0:
            self._calibrating_ns = now_ns + CALIBRATION_NS
        elif now_ns >= self._calibrating_ns:
            self._calibrating_ns, self._table[CALIBRATE] = 0, False
            self._changed_ns = now_ns
            self._answer()
            waited, self._waiting = bytes(self._waiting), bytearray()
            self.feed(waited)

    def _refresh(self, since_ns: int) -> None:
        table, now = self._table, self.body.snapshot
        table[MILLIS] = since_ns // 1_000_000
        table.put(BUMPERS, "?", now.bumper, now.bumper)
        voltage = max(now.battery.voltage - self.sag_volts, 0.0)
        table[VOLTAGE] = math.floor(voltage * 100)
        if voltage >= opencr.EMPTY_VOLTAGE:
            share = (voltage - opencr.EMPTY_VOLTAGE) / (12.3 - opencr.EMPTY_VOLTAGE)
            table[PERCENTAGE] = math.floor(share * 10_000)
        x, y, z, w = now.imu.orientation
        table.put(GYRO, "f", *now.imu.angular_velocity)
        table.put(ACCELERATION, "f", *now.imu.linear_acceleration)
        table.put(ORIENTATION, "f", w, x, y, z)
        wheels = list(zip(now.wheels, FIRST_TICKS, strict=True))
        amperes = (wheel.effort * AMPERES_PER_NM for wheel, _ in wheels)
        table.put(CURRENT, "i", *(value / opencr.CURRENT_UNIT for value in amperes))
        table.put(SPEED, "i", *(wheel.velocity / opencr.VELOCITY_UNIT for wheel, _ in wheels))
        ticks = (round(wheel.position / opencr.RADIANS_PER_TICK) + at for wheel, at in wheels)
        table.put(POSITION, "i", *ticks)


def _clamp(value: float, most: float) -> float:
    return max(-most, min(most, value))


def _units(speed: float) -> int:
    """Return a wheel's speed [m/s] in the motors' units, truncated as by the firmware."""
    return int(_clamp(speed * WHEEL_UNITS, MAX_UNITS))
