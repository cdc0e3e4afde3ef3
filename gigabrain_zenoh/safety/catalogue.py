"""What safety can find: a code for programs, a sentence and advice for people."""

from msgspec.structs import replace

from gigabrain_schemas.base import Cause

LIDAR = "look at the lidar's power and cable"
MAKE_ROOM = "turn or back away, or clear the way"
AGAIN = "then release the robot"


def _silent(name: str) -> Cause:
    return Cause(
        code=f"{name}_silent",
        text=f"{name} is silent",
        remedy=f"start {name}, or read its log to see why it is silent",
    )


def _zone(code: str, where: str) -> Cause:
    return Cause(code=f"zone_{code}", text=f"obstacle {where}", remedy=MAKE_ROOM)


CAUSES: dict[str, Cause] = {
    one.code: one
    for one in (
        Cause(
            code="starting",
            text="safety has only just begun to look",
            remedy="wait for the second scan",
        ),
        Cause(code="scan_lost", text="no scan has come for too long", remedy=LIDAR),
        Cause(
            code="scan_blind",
            text="the scan cannot be believed",
            remedy="clean and uncover the lidar, or move the robot to where it sees walls",
        ),
        _silent("perception"),
        _silent("decision"),
        _silent("control"),
        Cause(
            code="battery_empty",
            text="the battery is empty",
            remedy=f"charge it, {AGAIN}",
            latching=True,
        ),
        Cause(
            code="battery_unknown",
            text="the battery's charge is no longer measured",
            remedy="look at the battery's sensor and its cable",
        ),
        Cause(
            code="motor_hot",
            text="a motor is too hot",
            remedy=f"let it cool, {AGAIN}",
            latching=True,
        ),
        Cause(
            code="motor_unknown",
            text="a motor's temperature is no longer measured",
            remedy="look at that motor and its cable",
        ),
        Cause(
            code="runaway",
            text="the body moves or turns more than it was told",
            remedy=f"cut its power if it still moves, look at motors and encoders, {AGAIN}",
            latching=True,
        ),
        Cause(
            code="not_following",
            text="the body moves less than it was told",
            remedy="look whether something holds it, at its motors and its encoders",
        ),
        Cause(
            code="stuck",
            text="the body does not move although it was told to",
            remedy="see what holds it, and free it",
        ),
        Cause(
            code="telemetry_frozen",
            text="the body repeats the same values although it should move",
            remedy="look at its link, then restart its controller or push it until a value changes",
        ),
        Cause(
            code="tilted",
            text="the body is tilted too far",
            remedy=f"set it upright, {AGAIN}",
            latching=True,
        ),
        Cause(
            code="collision",
            text="the body has hit something",
            remedy=f"see what it has hit, free it, {AGAIN}",
            latching=True,
        ),
        Cause(
            code="round_trip",
            text="commands take too long; half speed",
            remedy="bring whoever drives nearer, or relieve the network or the computer",
        ),
        Cause(
            code="body_late",
            text="what the body reports is late",
            remedy="look at its cable, its network and how busy the computer is",
        ),
        Cause(
            code="lidar_late",
            text="what the lidar reports is late",
            remedy="look at its cable, its adapter and how busy the computer is",
        ),
        _zone("ahead", "ahead of the body"),
        _zone("behind", "behind the body"),
        _zone("left", "to the left of the body"),
        _zone("right", "to the right of the body"),
        _zone("turn_left", "where the body would turn left"),
        _zone("turn_right", "where the body would turn right"),
    )
}

WARNINGS: dict[str, Cause] = {
    one.code: one
    for one in (
        Cause(code="battery_low", text="the battery is low", remedy="charge it soon"),
        Cause(
            code="battery_return",
            text="the battery is nearly empty; the robot comes to rest",
            remedy="charge it now",
        ),
        Cause(
            code="motor_warm", text="a motor is warm", remedy="drive more gently, or let it rest"
        ),
        Cause(
            code="disk_low",
            text="the disk is nearly full",
            remedy="delete old recordings and logs",
        ),
        Cause(
            code="cpu_busy",
            text="the computer has no time to spare",
            remedy="end what need not run on it",
        ),
        Cause(
            code="memory_low",
            text="the computer's memory is nearly full",
            remedy="end what need not run on it",
        ),
    )
}


def cause(code: str, text: str = "") -> Cause:
    """The cause or warning called `code`, with figures in its sentence where there are any."""
    known = CAUSES.get(code) or WARNINGS[code]
    return replace(known, text=text) if text else known
