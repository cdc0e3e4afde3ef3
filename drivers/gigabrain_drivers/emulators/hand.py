"""The hand of a person who holds and moves the limp joints of an emulated arm."""

import math
from collections.abc import Iterable, Mapping, Sequence

from gigabrain_drivers.sim import STEP_S
from gigabrain_schemas.body import JointDescription
from gigabrain_zenoh.errors import ConfigError, unknown

SPEED = 1.0  # [rad/s]
SLIDING_SPEED = 0.1  # [m/s]


class Hand:
    """Moves some joints to their targets, and holds all others."""

    def __init__(self, joints: Sequence[JointDescription]) -> None:
        self._speeds = {j.name: SLIDING_SPEED if j.unit == "m" else SPEED for j in joints}
        self._wanted: Mapping[str, float] = {}
        self._held: dict[str, float] = {}

    def move(self, positions: Mapping[str, float]) -> None:
        """Set target positions [rad] or [m]; an empty mapping releases all joints."""
        self._wanted = {**self._wanted, **positions} if positions else {}

    def step(self, measured: Mapping[str, float], limp: bool) -> Mapping[str, float]:
        """Return the positions of all joints after a step of 10 ms; empty if it holds none."""
        wanted = self._wanted
        if not limp or not wanted:
            self._held = {}
            return {}
        held = self._held or dict(measured)
        for name, target in wanted.items():
            max_step = self._speeds[name] * STEP_S
            held[name] += max(-max_step, min(max_step, target - held[name]))
        self._held = held
        return held


def posture_in(words: Iterable[str], joints: Sequence[JointDescription]) -> dict[str, float]:
    """Parse words such as `elbow_flex=30` (degrees or mm) to positions [rad] or [m].

    `off`, or no word, gives no positions. Raises ConfigError.
    """
    known = {joint.name: joint for joint in joints}
    found = {}
    for word in words:
        name, _, value = word.partition("=")
        if word == "off":
            continue
        if name not in known:
            raise unknown("joint", name, [*known, "off"])
        joint = known[name]
        scale, unit = (1e-3, "mm") if joint.unit == "m" else (math.radians(1.0), "deg")
        low, high = joint.lower / scale, joint.upper / scale
        try:
            place = float(value)
        except ValueError:
            place = math.nan
        if not low <= place <= high:
            raise ConfigError(f"{name}: expected {low:.0f} to {high:.0f} {unit}, such as {name}=10")
        found[name] = place * scale
    return found
