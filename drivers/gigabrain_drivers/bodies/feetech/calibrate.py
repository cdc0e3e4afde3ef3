"""The guided calibration of an arm: a person moves its joints, while its motors are off.

Nothing is written into a servo's EEPROM unless the person agrees to it.
"""

import asyncio
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from msgspec.structs import replace

from gigabrain_drivers.bodies.feetech import protocol as feetech
from gigabrain_drivers.bodies.feetech.bus import ATTEMPTS, HostBus
from gigabrain_drivers.bodies.feetech.calibration import (
    MAX_OFFSET,
    Calibration,
    JointRange,
    ServoCalibration,
    check_writable,
    save_calibration,
)
from gigabrain_drivers.bodies.feetech.driver import FeetechOptions, refuse_incomplete, until_open
from gigabrain_drivers.bodies.feetech.protocol import TICKS, Register, ServoMemory
from gigabrain_drivers.driver.robot import RobotFile
from gigabrain_drivers.links.serial_link import SerialLink
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.errors import ConfigError

SAMPLE_S = 0.02
MIDDLE = TICKS // 2
HELD_TICKS = 12  # 1 deg, largest difference between two readings of a joint that is held still
LIMIT_MARGIN_TICKS = 12  # 1 deg, of a servo's limits beyond the measured range


class Dialogue(Protocol):
    """The person at the arm."""

    async def ask(self, text: str) -> str:
        """Print a request, and return the line that the person types."""

    def show(self, ranges: Mapping[str, JointRange]) -> None:
        """Show the range through which each joint was moved."""


async def calibrate(
    robot: RobotFile,
    options: FeetechOptions,
    path: Path,
    dialogue: Dialogue,
    *,
    leader: bool = False,
) -> None:
    """Calibrate the arm on the port of the options, and write the calibration to `path`.

    The gripper of a `leader` is a trigger with its own range. Raises ConfigError.
    """
    check_writable(path)
    link = SerialLink(options.port, feetech.BAUD, clock := Clock())
    bus = HostBus(link, clock)
    try:
        await until_open(link)
        calibrator = Calibrator(robot, options, bus, dialogue, leader=leader)
        save_calibration(path, await calibrator.run())
    finally:
        await link.close()


class Calibrator:
    """One calibration on an open bus."""

    def __init__(
        self,
        robot: RobotFile,
        options: FeetechOptions,
        bus: HostBus,
        dialogue: Dialogue,
        *,
        leader: bool,
    ) -> None:
        self._leader = leader
        self._joints = {joint.name: joint for joint in robot.joints}
        self._options, self._bus, self._dialogue = options, bus, dialogue
        self._servos = {name: options.servos[name] for name in self._joints}

    async def run(self) -> Calibration:
        """Guide the person through it. Raises ConfigError."""
        found = {f"servo {n} ({name})": await self._bus.find(n) for name, n in self._servos.items()}
        refuse_incomplete(str(self._bus.link), found)
        ask = self._dialogue.ask
        await ask("Hold the arm: its motors are switched off now, and it falls. Press Enter.")
        for servo in self._servos.values():
            await self._write(servo, feetech.TORQUE, 0)
        await ask(
            "Move every joint to the middle of its range, the gripper half open. Press Enter."
        )
        answer = await ask(
            "May offsets and limits be written into the servos (EEPROM), so that the middle is "
            f"{MIDDLE} ticks? It is needed once for a new arm. Type y for yes, Enter for no."
        )
        consents = answer.strip().lower() in ("y", "yes")
        if consents:
            for servo in self._servos.values():
                await self._centre(servo)
        ranges = await self._ranges()
        joints = {}
        for name, its in ranges.items():
            joints[name] = await self._finish(self._servos[name], its, consents=consents)
        return Calibration(joints=joints)

    async def _ranges(self) -> dict[str, JointRange]:
        """Watch while the person moves each joint through its whole range."""
        now = {name: await self._held(servo) for name, servo in self._servos.items()}
        ranges = {
            name: JointRange(
                self._joints[name],
                ticks,
                trigger=self._leader and self._joints[name].part == "gripper",
            )
            for name, ticks in now.items()
        }
        text = (
            "Move each joint from one end of its range to the other. Press Enter when all are done."
        )
        while text:
            asking = asyncio.ensure_future(self._dialogue.ask(text))
            try:
                while not asking.done():
                    for name, ticks in (await self._positions()).items():
                        ranges[name].add(ticks)
                    if not asking.done():
                        self._dialogue.show(ranges)
                    await asyncio.wait((asking,), timeout=SAMPLE_S)
            finally:
                asking.cancel()
            short = ", ".join(name for name, its in ranges.items() if its.missing)
            text = (
                f"Not moved far enough: {short}. Go on, and press Enter when done." if short else ""
            )
        return ranges

    async def _finish(self, servo: int, its: JointRange, *, consents: bool) -> ServoCalibration:
        """Return the calibration of a servo; with consent, write its limits."""
        name = its.joint.name
        if its.wraps and not its.endless:
            raise ConfigError(
                f"servo {servo} ({name}) begins to count again inside its range; "
                "calibrate once more, and agree to writing offsets into the servos"
            )
        made = its.calibrated(servo, -1 if name in self._options.inverted else 1)
        if consents:
            lower, upper = made.lower - LIMIT_MARGIN_TICKS, made.upper + LIMIT_MARGIN_TICKS
            await self._keep(servo, feetech.MIN_POSITION, max(0, lower))
            await self._keep(servo, feetech.MAX_POSITION, min(TICKS - 1, upper))
        memory = await self._memory(servo)
        return replace(
            made,
            offset=memory.offset,
            min_position=memory.min_position,
            max_position=memory.max_position,
        )

    async def _centre(self, servo: int) -> None:
        """Set a servo's offset, so that it counts from the middle posture."""
        await self._keep(servo, feetech.MIN_POSITION, 0)
        await self._keep(servo, feetech.MAX_POSITION, TICKS - 1)
        memory, now = await self._memory(servo), await self._held(servo)
        offset = (memory.offset + now - MIDDLE + TICKS // 2) % TICKS - TICKS // 2
        await self._keep(servo, feetech.OFFSET, max(-MAX_OFFSET, offset))

    async def _keep(self, servo: int, register: Register, value: int) -> None:
        """Write into the EEPROM."""
        await self._write(servo, feetech.LOCK, 0)
        try:
            await self._write(servo, register, value)
        finally:
            await self._write(servo, feetech.LOCK, 1)

    async def _write(self, servo: int, register: Register, value: int) -> None:
        if not await self._bus.write(servo, register, value):
            raise ConfigError(
                f"servo {servo} accepts no value at {register.address}: check its cable and power"
            )

    async def _memory(self, servo: int) -> ServoMemory:
        data = await self._bus.confirm(servo, 0, feetech.EEPROM_SIZE)
        return feetech.decode_memory(_answered(servo, data))

    async def _held(self, servo: int) -> int:
        """Return the position at which two readings in a row agree."""
        before = await self._position(servo)
        for _ in range(ATTEMPTS):
            now = await self._position(servo)
            if abs((now - before + MIDDLE) % TICKS - MIDDLE) <= HELD_TICKS:
                return now
            before = now
        raise ConfigError(
            f"servo {servo} reports another position each time: hold the arm still, and check "
            "its cable"
        )

    async def _position(self, servo: int) -> int:
        data = await self._bus.read(servo, feetech.POSITION.address, feetech.POSITION.size)
        return feetech.POSITION.decode(_answered(servo, data))

    async def _positions(self) -> dict[str, int]:
        return {name: await self._position(servo) for name, servo in self._servos.items()}


def _answered(servo: int, data: bytes | None) -> bytes:
    if data is None:
        raise ConfigError(f"servo {servo} no longer answers: check its cable and power")
    return data
