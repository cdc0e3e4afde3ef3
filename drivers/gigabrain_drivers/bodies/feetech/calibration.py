"""The calibration of an arm: converts between ticks of servos and angles of joints.

`gigabrain driver calibrate` creates it, as a YAML file. It also contains the servos' own offsets
and limits, which identify the arm.
"""

import errno
import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import yaml
from msgspec import Meta, Struct

from gigabrain_drivers.bodies.feetech.protocol import MAX_ID, RADIANS_PER_TICK, TICKS, ServoMemory
from gigabrain_schemas.body import JointDescription
from gigabrain_zenoh.config import loading
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import cannot_write, expanded, make_folder, replace_file
from gigabrain_zenoh.host.run_folders import state_dir

Tick = Annotated[int, Meta(ge=0, le=TICKS - 1)]
CALIBRATION_BYTES = 4096  # free space that the disk must have
MAX_OFFSET = 2047  # ticks, in 11 bits
SPAN_TOLERANCE = 0.17  # [rad], between a joint's measured range and that in the robot's file
TRIGGER_SPAN = 0.35  # [rad], the least range of a leader's trigger
OUTSIDE = 0.17  # [rad], how far outside its range a joint may be switched on


class ServoCalibration(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One joint: its servo, and the conversion of its ticks."""

    id: Annotated[int, Meta(ge=0, le=MAX_ID)]
    direction: Literal[1, -1] = 1  # of the joint while the ticks increase
    zero: Annotated[int, Meta(ge=-TICKS, le=2 * TICKS)]  # ticks at which the joint is at 0 rad
    lower: Tick  # ticks, the range through which the person moved it
    upper: Tick
    # the servo's own offset and limits, as read at the calibration:
    offset: Annotated[int, Meta(ge=-MAX_OFFSET, le=MAX_OFFSET)]
    min_position: Tick
    max_position: Tick

    def __post_init__(self) -> None:
        if self.upper <= self.lower:
            raise ValueError("upper: expected more than lower")

    def to_radians(self, ticks: int) -> float:
        """Return the angle of the joint [rad]."""
        return self.direction * (ticks - self.zero) * RADIANS_PER_TICK

    def to_ticks(self, radians: float) -> int:
        """Return the servo's nearest position within the calibrated range."""
        ticks = round(self.zero + self.direction * radians / RADIANS_PER_TICK)
        return max(self.lower, min(self.upper, ticks))

    def is_of(self, memory: ServoMemory) -> bool:
        """Return whether a servo has the offset and limits of the calibrated one."""
        here = (memory.offset, memory.min_position, memory.max_position)
        return here == (self.offset, self.min_position, self.max_position)


class Calibration(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The calibration of an arm, by joint."""

    joints: dict[str, ServoCalibration]


def calibration_path(robot_type: str, name: str, folder: Path) -> Path:
    """Return the file that a robot's file names, or the default one.

    Raises ConfigError without a home folder.
    """
    if name:
        return folder / expanded(name)
    return state_dir() / "calibration" / f"{robot_type}.yaml"


def load_calibration(
    path: Path, robot_type: str, joints: Sequence[JointDescription], servos: Mapping[str, int]
) -> Calibration:
    """Read the calibration of an arm with these joints on these servos.

    Raises ConfigError, also for a calibration of another kind of arm.
    """
    if not path.exists():
        raise ConfigError(
            f"{path}: no such file: {robot_type} is not calibrated; "
            f"run gigabrain driver calibrate {robot_type}"
        )
    calibration = loading.load(path, Calibration)
    names = [joint.name for joint in joints]
    if set(calibration.joints) != set(names):
        there = ", ".join(calibration.joints) or "none"
        raise ConfigError(f"{path}: joints: {there}; expected those of {robot_type}: {names}")
    for name, its in calibration.joints.items():
        if its.id != servos[name]:
            raise ConfigError(
                f"{path}: joints.{name}.id: {its.id}, but the robot's file has {servos[name]}: "
                "this is the calibration of another arm"
            )
    return calibration


def check_writable(path: Path) -> None:
    """Raise ConfigError if no calibration can be written. Call this before calibrating."""
    try:
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        make_folder(path.parent)
        with tempfile.TemporaryFile(dir=path.parent) as draft:
            draft.write(bytes(CALIBRATION_BYTES))
    except OSError as error:
        raise cannot_write(path, error) from None


def save_calibration(path: Path, calibration: Calibration) -> None:
    """Write the file, durably. Raises ConfigError."""
    text = yaml.safe_dump(msgspec.to_builtins(calibration), sort_keys=False)
    try:
        make_folder(path.parent)
        replace_file(path, text.encode())
    except OSError as error:
        raise cannot_write(path, error) from None


class JointRange:
    """The range of a joint that a person moves, unwrapped from the middle posture."""

    def __init__(self, joint: JointDescription, middle: int, *, trigger: bool = False) -> None:
        """A `trigger` has its own range, not that of the gripper that it leads."""
        self.joint, self._trigger = joint, trigger
        self.middle = self.ticks = self.lower = self.upper = self._newest = middle

    def add(self, ticks: int) -> None:
        """Add a reading, less than a quarter of a turn after the last one.

        Only two readings in a row extend the range, because a checksum of 8 bits does not detect
        all wrong ones.
        """
        half = TICKS // 2
        before, now = self._newest, self.ticks + (ticks - self.ticks + half) % TICKS - half
        self.ticks = min(before, now, key=lambda its: abs(its - self.ticks))
        self._newest = now
        self.lower = min(self.lower, max(before, now))
        self.upper = max(self.upper, min(before, now))

    @property
    def missing(self) -> float:
        """The part of its range that it has not passed yet [rad]; 0 if none."""
        whole = self.joint.upper - self.joint.lower - SPAN_TOLERANCE
        return max(0.0, (TRIGGER_SPAN if self._trigger else whole) - self._span)

    @property
    def _span(self) -> float:
        return (self.upper - self.lower) * RADIANS_PER_TICK

    @property
    def wraps(self) -> bool:
        """True if the servo's count wraps inside the range."""
        return self.lower < 0 or self.upper >= TICKS

    @property
    def endless(self) -> bool:
        """True if it turned further than the robot's file says: it has no end stops."""
        whole = self.joint.upper - self.joint.lower + SPAN_TOLERANCE
        return not self._trigger and self._span > whole

    def calibrated(self, servo: int, direction: Literal[1, -1]) -> ServoCalibration:
        """Return the calibration of a servo without its own offset and limits.

        The middle of the range is that of the robot's file; for an endless joint it is the middle
        posture.
        """
        centre = (self.joint.lower + self.joint.upper) / 2
        middle = self.middle if self.endless else (self.lower + self.upper) / 2
        zero = round(middle - direction * centre / RADIANS_PER_TICK)
        lower, upper = self.lower, self.upper
        if self.endless:
            half = round((self.joint.upper - self.joint.lower) / 2 / RADIANS_PER_TICK)
            lower, upper = self.middle - half, self.middle + half
        return ServoCalibration(
            id=servo,
            direction=direction,
            zero=zero,
            lower=max(0, lower),
            upper=min(TICKS - 1, upper),
            offset=0,
            min_position=0,
            max_position=TICKS - 1,
        )
