"""Body settings that may be changed, but only to values safer than those in the body's file.

The driver publishes the changed description, so gate, safety, planner and control obey the same
values.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import msgspec
from msgspec import structs

from gigabrain_schemas.body import DEFAULT, BodyDescription, Thresholds


class BodySetting(NamedTuple):
    """Unit of a setting, and the direction in which its values are safer."""

    unit: str
    kind: str  # word for the bound in error texts
    at_least: bool = False  # the file's value is the minimum, otherwise the maximum
    live: bool = True  # may also be changed while the body runs


SETTINGS = {
    "max_linear_speed": BodySetting("m/s", "limit"),
    "max_lateral_speed": BodySetting("m/s", "limit"),
    "max_angular_speed": BodySetting("rad/s", "limit"),
    "max_linear_acceleration": BodySetting("m/s2", "limit"),
    "thresholds.stop_margin": BodySetting("m", "need", at_least=True),
    "thresholds.side_margin": BodySetting("m", "need", at_least=True),
    "thresholds.resume_margin": BodySetting("m", "need", at_least=True),
    "max_rim_speed": BodySetting("m/s", "limit", live=False),
    "max_linear_deceleration": BodySetting("m/s2", "limit", live=False),
    "max_angular_acceleration": BodySetting("rad/s2", "limit", live=False),
    "thresholds.reaction_time": BodySetting("s", "need", at_least=True, live=False),
}


def setting_of(body: BodyDescription, path: str) -> float:
    """Return the value of a field such as `thresholds.stop_margin`; inf for no limit."""
    value: Any = body
    for name in path.split("."):
        value = getattr(value, name)
    return math.inf if value is None else float(value)


def split(changes: Mapping[str, Any]) -> tuple[dict[str, float], dict[str, Any]]:
    """Split changes of a robot's file into live settings, by path, and all other changes."""
    settings: dict[str, float] = {}
    others = dict(changes)
    for path, setting in SETTINGS.items():
        if not setting.live:
            continue
        section, _, name = path.rpartition(".")
        values = others.get(section, {}) if section else others
        if name not in values:
            continue
        settings[path] = values[name]
        kept = {key: value for key, value in values.items() if key != name}
        others = {**others, section: kept} if section else kept
    return settings, others


def check_safe(file: BodyDescription, wanted: BodyDescription) -> None:
    """Raise ValueError for the first setting of `wanted` that is less safe than in `file`."""
    for path, setting in SETTINGS.items():
        bound, value = setting_of(file, path), setting_of(wanted, path)
        if value < bound if setting.at_least else value > bound:
            side = "below" if setting.at_least else "above"
            raise ValueError(
                f"{path}: {value:g} {setting.unit} is {side} the body's own {setting.kind}, "
                f"{bound:g} {setting.unit} in its file"
            )


def restricted(file: BodyDescription, settings: Mapping[str, float]) -> BodyDescription:
    """Return the body of a file with changed settings, by path. Raises ValueError if unsafe.

    A slower car keeps its turning radius: its yaw rate is reduced like its speed. The
    tolerances `follow_*` are limited to the new speeds, but not below their defaults.
    """
    top = {path: value for path, value in settings.items() if "." not in path}
    inner = {path.partition(".")[2]: settings[path] for path in settings if "." in path}
    linear = top.get("max_linear_speed", file.max_linear_speed)
    angular = top.get("max_angular_speed", file.max_angular_speed)
    if file.drive_type == "ackermann":
        angular = min(angular, file.max_angular_speed * linear / file.max_linear_speed)
    limits = file.thresholds
    inner["follow_linear"] = min(limits.follow_linear, max(linear, DEFAULT.follow_linear))
    inner["follow_angular"] = min(limits.follow_angular, max(angular, DEFAULT.follow_angular))
    values = structs.asdict(file) | top | {"max_angular_speed": angular}
    thresholds = msgspec.convert(structs.asdict(limits) | inner, Thresholds)
    wanted = msgspec.convert(values | {"thresholds": thresholds}, type(file))
    check_safe(file, wanted)
    return wanted
