"""The hand of a person who holds the limp joints of an emulated arm, and moves them."""

import math
from collections.abc import Iterable, Mapping, Sequence

from gigabrain_drivers.sim import STEP_S
from gigabrain_schemas.body import JointDescription
from gigabrain_zenoh.errors import ConfigError, unknown

SPEED = 1.0  # [rad/s]; of a joint that slides, a tenth of it in [m/s]
SLIDING_SPEED = 0.1


class Hand:
    """Brings joints to where they are wanted, and holds all of them meanwhile."""

    def __init__(self, joints: Sequence[JointDescription]) -> None:
        self._speeds = {j.name: SLIDING_SPEED if j.unit == "m" else SPEED for j in joints}
        self._wanted: Mapping[str, float] = {}
        self._held: dict[str, float] = {}

    def move(self, positions: Mapping[str, float]) -> None:
        """Bring joints to positions [rad] or [m] from the next step on; none lets go of all."""
        self._wanted = {**self._wanted, **positions} if positions else {}

    def step(self, measured: Mapping[str, float], limp: bool) -> Mapping[str, float]:
        """Return where it holds all joints after a step of 10 ms; none where it holds nothing."""
        wanted = self._wanted
        if not limp or not wanted:
            self._held = {}
            return {}
        held = self._held or dict(measured)
        for name, place in wanted.items():
            most = self._speeds[name] * STEP_S
            held[name] += max(-most, min(most, place - held[name]))
        self._held = held
        return held


def posture_in(words: Iterable[str], joints: Sequence[JointDescription]) -> dict[str, float]:
    """Return positions [rad] or [m] of words such as `elbow_flex=30`, in degrees or millimetres.

    `off`, or nothing, is none. Raises ConfigError.
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
