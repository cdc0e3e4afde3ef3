"""Settings of a body that may change while it runs: each only makes it safer than its file says.

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
    """One setting, and which of its values are safe."""

    unit: str
    kind: str  # of the bound, in words
    at_least: bool = False  # the file's value is the least one; otherwise the greatest
    live: bool = True  # may change while the body runs; otherwise at the start only


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
    """Return the live settings in changes of a robot's file, by path, and all other changes."""
    settings: dict[str, float] = {}
    rest = dict(changes)
    for path, one in SETTINGS.items():
        if not one.live:
            continue
        section, _, name = path.rpartition(".")
        place = rest.get(section, {}) if section else rest
        if name not in place:
            continue
        settings[path] = place[name]
        kept = {key: value for key, value in place.items() if key != name}
        rest = {**rest, section: kept} if section else kept
    return settings, rest


def check_safe(file: BodyDescription, wanted: BodyDescription) -> None:
    """Raise ValueError for the first setting of `wanted` that is less safe than in `file`."""
    for path, one in SETTINGS.items():
        bound, value = setting_of(file, path), setting_of(wanted, path)
        if value < bound if one.at_least else value > bound:
            side = "below" if one.at_least else "above"
            raise ValueError(
                f"{path}: {value:g} {one.unit} is {side} the body's own {one.kind}, "
                f"{bound:g} {one.unit} in its file"
            )


def restricted(file: BodyDescription, settings: Mapping[str, float]) -> BodyDescription:
    """Return the body of a file with other settings, by path. Raises ValueError if unsafe.

    A slower car turns as tightly as before, so its yaw rate falls with its speed. Tolerances of
    `thresholds` are never above what the slower body can be off.
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
