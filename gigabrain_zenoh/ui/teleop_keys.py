"""Interprets an operator's keys in a terminal, which reports presses and no releases. Pure."""

import re
from typing import Final

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import BodyDescription
from gigabrain_zenoh.geometry.limits import ZERO

# A terminal repeats a held key first after 0.25 to 0.6 s, then every 30 to 50 ms.
TAP_S = 0.4  # how long a first press counts as held
HELD_S = 0.15  # the same for a repeated press: after release, the robot brakes this late
SHARES = (0.25, 0.5, 0.75, 1.0)  # speed steps, as fractions of the body's limits

Axes = tuple[int, int, int]  # ahead, left, counter-clockwise: -1, 0 or 1
MOVES: Final[dict[str, Axes]] = {
    "w": (1, 0, 0), "up": (1, 0, 0),
    "s": (-1, 0, 0), "down": (-1, 0, 0),
    "a": (0, 0, 1), "left": (0, 0, 1),
    "d": (0, 0, -1), "right": (0, 0, -1),
    "q": (0, 1, 0), "e": (0, -1, 0),
}  # fmt: skip
ARROWS = {"A": "up", "B": "down", "C": "right", "D": "left"}
KEY = re.compile(r"\x1b[\[O](?:\d+(?:;\d+)*)?([A-Za-z~])|(.)", re.DOTALL)


def keys_of(typed: str) -> list[str]:
    """Return the keys in a terminal's input; arrows by name, other escape sequences are dropped."""
    found = []
    for sequence, plain in KEY.findall(typed):
        name = ARROWS.get(sequence, "") if sequence else plain.lower()
        if name and name != "\x1b":
            found.append(name)
    return found


class HeldKeys:
    """Keys that count as held, and the speed that the operator has chosen."""

    def __init__(self) -> None:
        self._until_s: dict[str, float] = {}
        self._share = 0

    @property
    def share(self) -> float:
        """Return the chosen fraction of the body's limits."""
        return SHARES[self._share]

    def press(self, key: str, now_s: float) -> bool:
        """Process a key press; return whether the key is one of those for driving."""
        if key in ("+", "-"):
            step = 1 if key == "+" else -1
            self._share = max(0, min(len(SHARES) - 1, self._share + step))
        elif key in MOVES:
            repeated = now_s < self._until_s.get(key, now_s)
            held_s = HELD_S if repeated else TAP_S
            self._until_s[key] = now_s + held_s
        else:
            return False
        return True

    def let_go(self) -> None:
        """Count all keys as released."""
        self._until_s.clear()

    def velocity(self, body: BodyDescription, now_s: float) -> Velocity:
        """Return the velocity for the keys that are held now."""
        held = [MOVES[key] for key, until_s in self._until_s.items() if now_s < until_s]
        if not held:
            return ZERO
        x, y, z = (max(-1, min(1, sum(axis))) for axis in zip(*held, strict=True))
        return Velocity(
            linear_x=x * self.share * body.max_linear_speed,
            linear_y=y * self.share * body.max_lateral_speed,
            angular_z=z * self.share * body.max_angular_speed,
        )
