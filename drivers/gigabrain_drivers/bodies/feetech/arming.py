"""Switches on an arm's servos after checking that they are the right ones. Nothing moves."""

import math
from collections.abc import Collection

from gigabrain_drivers.bodies.feetech import protocol as feetech
from gigabrain_drivers.bodies.feetech.bus import HostBus
from gigabrain_drivers.bodies.feetech.calibration import OUTSIDE
from gigabrain_drivers.bodies.feetech.joint import JUMP_SLACK, ServoJoint
from gigabrain_drivers.bodies.feetech.protocol import (
    FIRST,
    LENGTH,
    RADIANS_PER_TICK,
    ServoMemory,
    ServoReadings,
)
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.errors import ConfigError

SETTLED_TICKS = 6  # 0.5 deg, largest motion of a servo while it is switched on
ARM_ATTEMPTS = 10
VOLTS = {7.4: (4.5, 8.7), 12.0: (9.0, 14.5)}  # range of the supply, by the servos' variant
VARIANT_LIMIT = 100  # 0.1 V, between the maximal voltages of the two variants


class Arming:
    """Checks servos, and switches them on where they are."""

    def __init__(self, bus: HostBus, clock: Clock, calibrated: str, voltage: float) -> None:
        """`voltage` is that of the servos' variant, 7.4 or 12.

        `calibrated` is the argument of `gigabrain driver calibrate` for them.
        """
        self._bus, self._clock = bus, clock
        self._calibrated, self._voltage = calibrated, voltage

    async def check(self, joint: ServoJoint) -> None:
        """Raise ConfigError if the servo is not the calibrated one, or another variant."""
        memory, voltage = await self.recognise(joint), self._voltage
        if (memory.max_voltage > VARIANT_LIMIT) != (voltage > VARIANT_LIMIT / 10):
            raise ConfigError(
                f"{self._bus.link}: {joint} takes up to {memory.max_voltage / 10:g} V, but the "
                f"robot's file has servos of {voltage:g} V; change voltage there"
            )

    async def recognise(self, joint: ServoJoint) -> ServoMemory:
        """Return a servo's EEPROM values. Raises ConfigError if it is not the calibrated one."""
        data = await self._bus.confirm(joint.id, 0, feetech.EEPROM_SIZE)
        if data is None:
            raise ConfigError(f"{self._bus.link}: {joint} does not answer any more")
        memory = feetech.decode_memory(data)
        if memory.model != feetech.MODEL or memory.mode:
            raise ConfigError(
                f"{self._bus.link}: {joint} is of model {memory.model} in mode {memory.mode}; "
                f"expected an STS3215 (model {feetech.MODEL}) in mode 0, position"
            )
        if not joint.calibration.is_of(memory):
            raise ConfigError(_other_arm(self._calibrated, joint, memory))
        return memory

    async def arm(self, joints: Collection[ServoJoint]) -> str:
        """Switch on all servos without motion; return why that failed, or an empty text.

        Raises ConfigError if the supply's voltage does not fit the servos.
        """
        for joint in joints:
            first, now = await self.block(joint.id), await self.block(joint.id)
            if first is None or now is None:
                return f"{joint} answers only at times"
            if abs(first.position - now.position) * RADIANS_PER_TICK > 2 * JUMP_SLACK:
                return f"{joint} is being moved: let go of the arm"
            self._check_supply(joint, now)
            if outside := _outside(joint, now):
                return (
                    f"{joint} is {math.degrees(outside):.0f} deg outside its calibrated range: "
                    "move it back by hand, or calibrate again"
                )
            joint.begin(now, self._clock.now_ns())
        for _ in range(ARM_ATTEMPTS):
            if await self._switched_on(joints):
                return ""
        return "the arm moves while it is switched on: let go of it"

    async def measure(self, joints: Collection[ServoJoint]) -> str:
        """Read positions without switching on; return why that failed, or an empty text."""
        for joint in joints:
            if (now := await self.block(joint.id)) is None:
                return f"{joint} answers only at times"
            joint.begin(now, self._clock.now_ns())
        return ""

    async def _switched_on(self, joints: Collection[ServoJoint]) -> bool:
        """Send each servo its goal, and then switch on its torque."""
        now_ns = self._clock.now_ns()
        parts = {j.id: j.settings(now_ns).frame_part(j.goal) for j in joints}
        await self._bus.send(feetech.sync_write(feetech.ACCELERATION.address, parts))
        for joint in joints:
            now = await self.block(joint.id)
            if now is None:
                return False
            if not now.torque and abs(now.position - now.goal) > SETTLED_TICKS:
                joint.begin(now, self._clock.now_ns())
                return False
            if now.goal != joint.goal:
                return False
            locked = now.lock == 1 or await self._bus.write(joint.id, feetech.LOCK, 1)
            if not locked or not await self._bus.write(joint.id, feetech.TORQUE, 1):
                return False
            if on := await self.block(joint.id):
                joint.begin(on, self._clock.now_ns())
        return True

    async def block(self, servo: int) -> ServoReadings | None:
        """Read the block of a cycle; None without an answer."""
        data = await self._bus.read(servo, FIRST, LENGTH)
        return feetech.decode_readings(data) if data else None

    def _check_supply(self, joint: ServoJoint, now: ServoReadings) -> None:
        volts, voltage = now.voltage * feetech.VOLTAGE_UNIT, self._voltage
        least, most = VOLTS[voltage]
        if not least <= volts <= most:
            raise ConfigError(
                f"{self._bus.link}: {joint} measures {volts:.1f} V; expected {least:g} to "
                f"{most:g} V for servos of {voltage:g} V: wrong supply, "
                "or wrong voltage in the robot's file"
            )


def _other_arm(calibrated: str, joint: ServoJoint, memory: ServoMemory) -> str:
    its = joint.calibration
    return (
        f"{joint} keeps offset {memory.offset} and limits {memory.min_position} to "
        f"{memory.max_position}, its calibration has {its.offset} and {its.min_position} to "
        f"{its.max_position}: this is another arm; run gigabrain driver calibrate {calibrated}"
    )


def _outside(joint: ServoJoint, now: ServoReadings) -> float:
    """Return how far it is outside the range, so that switching on would move it [rad]; or 0."""
    its, at = joint.calibration, now.position
    slack = round(OUTSIDE / RADIANS_PER_TICK)
    lower = max(its.min_position - SETTLED_TICKS, its.lower - slack)
    upper = min(its.max_position + SETTLED_TICKS, its.upper + slack)
    return max(lower - at, at - upper, 0) * RADIANS_PER_TICK
