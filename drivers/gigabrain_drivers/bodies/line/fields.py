"""What a line of text may say of a body: fields, their quantities, and the units of those."""

import math
import re

from gigabrain_drivers.kinematics import Ackermann, Differential, Mecanum, Omni

DRIVES = (Differential, Mecanum, Omni, Ackermann)
WHEELS = tuple(dict.fromkeys(name for drive in DRIVES for name in drive.wheels))
ANGLES = ("steering",)  # of WHEELS, those that are told an angle and not a speed
IGNORED = "_"  # a number in a state line that means nothing to us

UNITS = {
    "length": {"m": 1.0, "cm": 0.01, "mm": 0.001},
    "speed": {"m/s": 1.0, "cm/s": 0.01, "mm/s": 0.001},
    "angle": {
        "rad": 1.0, "mrad": 0.001, "deg": math.radians(1), "turn": math.tau, "tick": math.nan,
    },
    "turning speed": {
        "rad/s": 1.0, "mrad/s": 0.001, "deg/s": math.radians(1), "rpm": math.tau / 60,
        "tick/s": math.nan,
    },
    "torque": {"Nm": 1.0, "mNm": 0.001},
    "temperature": {"C": 1.0},
    "voltage": {"V": 1.0, "mV": 0.001},
    "current": {"A": 1.0, "mA": 0.001},
    "share": {"%": 1.0},
    "count": {"": 1.0},
    "flags": {"": 1.0},
    "number": {"": 1.0},
}  # fmt: skip
BODY = {"linear_x": "speed", "linear_y": "speed", "angular_z": "turning speed"}
COMMAND = {
    **BODY,
    "seq": "count",
    **{f"wheel_{name}": "angle" if name in ANGLES else "turning speed" for name in WHEELS},
}
STATE = {
    **BODY,
    "x": "length",
    "y": "length",
    "yaw": "angle",
    **{f"wheel_{name}_position": "angle" for name in WHEELS},
    **{f"wheel_{name}_velocity": "turning speed" for name in WHEELS},
    **{f"wheel_{name}_effort": "torque" for name in WHEELS},
    **{f"wheel_{name}_temperature": "temperature" for name in WHEELS},
    "battery_voltage": "voltage",
    "battery_current": "current",
    "battery_percentage": "share",
    "flags": "flags",
    IGNORED: "number",
}
DEFAULT_FORMATS = {"count": "d", "flags": "x"}

_UNIT = re.compile(r"\s*([-+]?[0-9]*\.?[0-9]*)\s*([A-Za-z%].*?)?\s*")


def factor(quantity: str, unit: str, ticks_per_turn: float | None) -> float:
    """What the number on the wire is multiplied with to get SI units (volts, degrees C, percent).

    A unit may have a number before it: in `0.1C` or `-tick`, the wire counts tenths of degrees,
    or ticks backwards. Raises ValueError saying what was expected.
    """
    known = UNITS[quantity]
    match = _UNIT.fullmatch(unit)
    name = (match[2] or "") if match else ""
    if match is None or (name not in known and not (name == "" and not unit.strip())):
        choices = " or ".join(filter(None, known)) or "no unit"
        raise ValueError(f"it is a {quantity}: expected {choices}, got {unit!r}")
    one = known[name] if name in known else next(iter(known.values()))
    if name.startswith("tick"):
        if not ticks_per_turn:
            raise ValueError(f"{name!r} needs `ticks_per_turn`")
        one = math.tau / ticks_per_turn
    number = match[1] + "1" if match[1] in ("", "+", "-") else match[1]
    try:
        scale = float(number)
    except ValueError:
        scale = 0.0
    if scale == 0.0:
        raise ValueError(f"expected a number other than 0 before the unit, got {unit!r}")
    return scale * one
