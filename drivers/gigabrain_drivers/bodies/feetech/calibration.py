"""The calibration of an arm: from the ticks of its servos to the angles of its joints, and back.

It is made by `gigabrain driver calibrate`, and kept in a YAML file. The servos' own offsets and
limits are in it too, as the mark by which the arm is known again.
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
from gigabrain_zenoh.host.files import expanded, make_folder, replace_file
from gigabrain_zenoh.host.run_folders import state_dir

Tick = Annotated[int, Meta(ge=0, le=TICKS - 1)]
CALIBRATION_BYTES = 4096  # for which the disk has to have room
MAX_OFFSET = 2047  # ticks, in 11 bits
SPAN_TOLERANCE = 0.17  # [rad], by which a joint's range may differ from that in the robot's file
TRIGGER_SPAN = 0.35  # [rad], the least range of a leader's trigger
OUTSIDE = 0.17  # [rad], by which a joint may be outside its range as it is switched on


class ServoCalibration(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One joint: the servo that moves it, and what its ticks mean."""

    id: Annotated[int, Meta(ge=0, le=MAX_ID)]
    direction: Literal[1, -1] = 1  # of the joint as the ticks go up
    zero: Annotated[int, Meta(ge=-TICKS, le=2 * TICKS)]  # ticks at which the joint is at 0 rad
    lower: Tick  # ticks, the range through which it was moved
    upper: Tick
    offset: Annotated[int, Meta(ge=-MAX_OFFSET, le=MAX_OFFSET)]  # that the servo keeps, and
    min_position: Tick  # its limits: both as read when the calibration was made
    max_position: Tick

    def __post_init__(self) -> None:
        if self.upper <= self.lower:
            raise ValueError("upper: expected more than lower")

    def to_radians(self, ticks: int) -> float:
        """Return the angle of the joint [rad]."""
        return self.direction * (ticks - self.zero) * RADIANS_PER_TICK

    def to_ticks(self, radians: float) -> int:
        """Return the nearest place of the servo within the calibrated range."""
        ticks = round(self.zero + self.direction * radians / RADIANS_PER_TICK)
        return max(self.lower, min(self.upper, ticks))

    def is_of(self, memory: ServoMemory) -> bool:
        """Return whether a servo keeps what the calibrated one kept."""
        here = (memory.offset, memory.min_position, memory.max_position)
        return here == (self.offset, self.min_position, self.max_position)


class Calibration(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole arm, by the names of its joints."""

    joints: dict[str, ServoCalibration]


def calibration_path(robot_type: str, name: str, folder: Path) -> Path:
    """Return the file that a robot's file names, or the one where calibrations are kept.

    Raises ConfigError without a home folder.
    """
    if name:
        return folder / expanded(name)
    return state_dir() / "calibration" / f"{robot_type}.yaml"


def load_calibration(
    path: Path, robot_type: str, joints: Sequence[JointDescription], servos: Mapping[str, int]
) -> Calibration:
    """Read the calibration of an arm with these joints on these servos.

    Raises ConfigError, also for that of another kind of arm.
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
    """Raise ConfigError where no calibration can be written; call this before one is made."""
    try:
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        make_folder(path.parent)
        with tempfile.TemporaryFile(dir=path.parent) as draft:
            draft.write(bytes(CALIBRATION_BYTES))
    except OSError as error:
        raise _unwritable(path, error) from None


def save_calibration(path: Path, calibration: Calibration) -> None:
    """Write the file, durably. Raises ConfigError."""
    text = yaml.safe_dump(msgspec.to_builtins(calibration), sort_keys=False)
    try:
        make_folder(path.parent)
        replace_file(path, text.encode())
    except OSError as error:
        raise _unwritable(path, error) from None


def _unwritable(path: Path, error: OSError) -> ConfigError:
    return ConfigError(f"cannot write {path}: {error.strerror}")


class JointRange:
    """The range of one joint while a person moves it, unwrapped from its middle posture on."""

    def __init__(self, joint: JointDescription, middle: int, *, trigger: bool = False) -> None:
        """The range of a `trigger` is its own, and not that of the gripper that it leads."""
        self.joint, self._trigger = joint, trigger
        self.middle = self.ticks = self.lower = self.upper = self._newest = middle

    def add(self, ticks: int) -> None:
        """Take a reading; from one to the next it turns less than a quarter of a turn.

        The range reaches as far as two readings in a row do: a sum of 8 bits lets some wrong ones
        through.
        """
        half = TICKS // 2
        before, now = self._newest, self.ticks + (ticks - self.ticks + half) % TICKS - half
        self.ticks = min(before, now, key=lambda its: abs(its - self.ticks))
        self._newest = now
        self.lower = min(self.lower, max(before, now))
        self.upper = max(self.upper, min(before, now))

    @property
    def missing(self) -> float:
        """The rest of its range that it has not been moved through [rad]; 0 for none."""
        whole = self.joint.upper - self.joint.lower - SPAN_TOLERANCE
        return max(0.0, (TRIGGER_SPAN if self._trigger else whole) - self._span)

    @property
    def _span(self) -> float:
        return (self.upper - self.lower) * RADIANS_PER_TICK

    @property
    def wraps(self) -> bool:
        """True where the servo's count jumps inside the range."""
        return self.lower < 0 or self.upper >= TICKS

    @property
    def endless(self) -> bool:
        """True where it turned further than the robot's file says, so that it has no ends."""
        whole = self.joint.upper - self.joint.lower + SPAN_TOLERANCE
        return not self._trigger and self._span > whole

    def calibrated(self, servo: int, direction: Literal[1, -1]) -> ServoCalibration:
        """Return the calibration of a servo that keeps no offset and has no limits.

        The middle between both ends is that of the robot's file; of an endless joint, the middle
        posture is.
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
