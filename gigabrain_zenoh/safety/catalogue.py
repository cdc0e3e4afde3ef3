"""Causes and warnings that safety reports, and how to count the ticks of a fault."""

import math

from msgspec.structs import replace

from gigabrain_schemas.base import TICK_NS, Cause

MAX_STEP_TICKS = 5  # maximum that one state counts for, after any gap


def _causes(*rows: tuple[str, str, str], latching: bool = False) -> dict[str, Cause]:
    """Return causes by code; a row has the code, the text and the remedy."""
    return {
        code: Cause(code=code, text=text, remedy=remedy, latching=latching)
        for code, text, remedy in rows
    }


_CHECK_LIDAR = "check the lidar's power and cable"
_MAKE_ROOM = "turn or back away, or clear the way"
_MOVE_AWAY = "move the arm away from it, or clear the way"
_LOOK_AT_SERVO = "check that servo and its cable, then release the robot"
_FREE_ARM = (
    "remove what blocks it (`gigabrain arm limp` switches torque off), then release the robot"
)
_CLOSE_PROGRAMS = "close programs that need not run on it"

CAUSES = _causes(
    ("starting", "safety is starting", "wait for the second scan"),
    ("scan_lost", "no scan for too long", _CHECK_LIDAR),
    (
        "scan_blind",
        "the scan is not plausible",
        "clean and uncover the lidar, or move the robot to where it sees walls",
    ),
    *(
        (f"{name}_silent", f"{name} is silent", f"start {name}, or read its log")
        for name in ("perception", "decision", "control")
    ),
    (
        "battery_unknown",
        "the battery's charge is no longer measured",
        "check the battery's sensor and its cable",
    ),
    (
        "motor_unknown",
        "a motor's temperature is no longer measured",
        "check that motor and its cable",
    ),
    (
        "not_following",
        "the body moves less than commanded",
        "check whether something holds it; check its motors and encoders",
    ),
    (
        "stuck",
        "the body does not move although it is commanded to",
        "find what holds it, and free it",
    ),
    (
        "telemetry_frozen",
        "the body repeats the same values although it should move",
        "check its link, then restart its controller or push it until its pose changes",
    ),
    (
        "round_trip",
        "commands take too long; half speed",
        "move the operator nearer, or reduce network or computer load",
    ),
    (
        "body_late",
        "the body's data are late",
        "check its cable, its network and the computer's load",
    ),
    (
        "lidar_late",
        "the lidar's data are late",
        "check its cable, its adapter and the computer's load",
    ),
    (
        "camera_lost",
        "no image from a camera for too long; no motion in its direction",
        "check that the camera process runs, its log, and the camera's cable",
    ),
    (
        "camera_blind",
        "a camera sees nothing; no motion in its direction",
        "uncover and clean it, light the room, or back away from the obstacle",
    ),
    (
        "camera_frozen",
        "a camera repeats one image; no motion in its direction",
        "start the camera process again, or plug the camera in again",
    ),
    (
        "camera_wrong",
        "a camera's images do not match the body's file",
        "correct the camera in the body's file, or its image source",
    ),
    ("zone_ahead", "obstacle ahead of the body", _MAKE_ROOM),
    ("zone_behind", "obstacle behind the body", _MAKE_ROOM),
    ("zone_left", "obstacle to the left of the body", _MAKE_ROOM),
    ("zone_right", "obstacle to the right of the body", _MAKE_ROOM),
    ("zone_turn_left", "obstacle where the body would turn left", _MAKE_ROOM),
    ("zone_turn_right", "obstacle where the body would turn right", _MAKE_ROOM),
    (
        "arm_model",
        "safety has no model of the arm",
        "correct the model beside the body's file, and start the driver again",
    ),
    (
        "joint_frozen",
        "a joint repeats the same values although it should move",
        "check the cable of the servos, then restart the driver or move the joint by hand",
    ),
    ("arm_self", "parts of the arm are too near each other", "move them apart"),
    ("arm_floor", "the arm is too near the floor", _MOVE_AWAY),
    ("arm_keep_out", "the arm is too near a keep-out box", _MOVE_AWAY),
) | _causes(
    ("joint_lost", "a joint is no longer reported", _LOOK_AT_SERVO),
    ("joint_jump", "a joint jumped farther than it can move", _LOOK_AT_SERVO),
    ("joint_off", "a joint is not at its setpoint", _FREE_ARM),
    ("joint_overload", "a joint has been at its greatest effort for too long", _FREE_ARM),
    (
        "voltage_low",
        "the supply's voltage is too low for the servos",
        "check the power supply and its cable, then release the robot",
    ),
    (
        "voltage_high",
        "the supply's voltage is too high for the servos",
        "unplug it, take the right power supply, then release the robot",
    ),
    ("battery_empty", "the battery is empty", "charge it, then release the robot"),
    ("motor_hot", "a motor is too hot", "let it cool, then release the robot"),
    (
        "runaway",
        "the body moves or turns more than commanded",
        "cut its power if it still moves; check motors and encoders, then release the robot",
    ),
    ("tilted", "the body is tilted too far", "set it upright, then release the robot"),
    (
        "collision",
        "the body has hit something",
        "find what it has hit, free it, then release the robot",
    ),
    latching=True,
)

WARNINGS = _causes(
    ("battery_low", "the battery is low", "charge it soon"),
    ("battery_return", "the battery is nearly empty; the robot stops", "charge it now"),
    ("motor_warm", "a motor is warm", "drive slower, or let it cool"),
    ("disk_low", "the disk is nearly full", "delete old recordings and logs"),
    ("cpu_busy", "the computer is overloaded", _CLOSE_PROGRAMS),
    ("memory_low", "the computer's memory is nearly full", _CLOSE_PROGRAMS),
)


def cause(code: str, text: str = "") -> Cause:
    """Return the cause or warning `code`; a `text` replaces its own, for example with figures."""
    known = CAUSES.get(code) or WARNINGS[code]
    return replace(known, text=text) if text else known


def ticks_of(seconds: float) -> int:
    """Return `seconds` in ticks, rounded up."""
    return math.ceil(seconds * 1e9 / TICK_NS - 1e-9)


def lasting(ticks: int, wrong: bool, elapsed: int) -> int:
    """Return the ticks of a fault after `elapsed` more; 0 unless it is still `wrong`."""
    return ticks + elapsed if wrong else 0
