"""Monitors of the brain: whether perception, decision and control work, and how late commands are.

Each process must answer the one before it: a world per scan, an intent per world, a command per
intent. A process that only repeats itself counts as silent.
"""

from msgspec import Struct

from gigabrain_schemas.base import TICK_NS, Cause
from gigabrain_schemas.body import BodyDescription, RobotState, Thresholds
from gigabrain_schemas.safety import SpeedCaps
from gigabrain_zenoh.gate.state import BRAIN
from gigabrain_zenoh.host.bounded import percentile
from gigabrain_zenoh.safety.catalogue import cause
from gigabrain_zenoh.safety.debounce import lasting, ticks_of

SYSTEMS = ("perception", "decision", "control")
COMMANDS = 100  # the newest, of two seconds
SHARE = 0.99  # percentile of their ages
HALF_SPEED = 0.5


class Bases(Struct, frozen=True, kw_only=True):
    """Ticks of the sensor data that the newest messages rest on; 0 for none."""

    scan: int = 0
    world: int = 0
    intent: int = 0
    command: int = 0

    @property
    def chain(self) -> tuple[int, int, int, int]:
        """The ticks from scan to command."""
        return self.scan, self.world, self.intent, self.command


class Progress(Struct, frozen=True, kw_only=True):
    """Monitors whether each system answers the one before it."""

    bases: Bases = Bases()
    behind_ticks: tuple[int, int, int] = (0, 0, 0)  # since the last progress of each system

    def then(self, bases: Bases, elapsed: int) -> "Progress":
        """Return the monitor after one more state."""
        chain, last = bases.chain, self.bases.chain
        perception, decision, control = (
            lasting(ticks, chain[i + 1] < chain[i] and chain[i + 1] == last[i + 1], elapsed)
            for i, ticks in enumerate(self.behind_ticks)
        )
        return Progress(bases=bases, behind_ticks=(perception, decision, control))

    def causes(
        self, limits: Thresholds, state: RobotState, silent: tuple[str, ...], *, first: bool
    ) -> tuple[Cause, ...]:
        """Return why the body must stop; `silent` names the systems without fresh messages.

        The brain matters only while it drives, or may drive next. If nobody drives and all three
        systems are silent, there is no brain, and a script need not wait for one. With the `first`
        scan that cannot be known yet.
        """
        commander = state.gate.commander
        brainless = not commander and len(silent) == len(SYSTEMS) and not first
        if commander not in ("", BRAIN) or brainless:
            return ()
        found = [cause(f"{name}_silent") for name in silent]
        for name, ticks in zip(SYSTEMS, self.behind_ticks, strict=True):
            if name not in silent and ticks >= ticks_of(limits.heartbeat):
                found.append(cause(f"{name}_silent", f"{name} takes no notice of what is new"))
        return tuple(found)


class RoundTrip(Struct, frozen=True, kw_only=True):
    """Monitors the age of commands: from the tick that they echo to their arrival."""

    ages: tuple[int, ...] = ()  # of the newest commands [ticks]
    late_ticks: int = 0

    def then(self, limits: Thresholds, ages: tuple[int, ...], elapsed: int) -> "RoundTrip":
        """Return the monitor after one more state, with the ages of new commands [ticks]."""
        newest = (*self.ages, *ages)[-COMMANDS:]
        slowest = percentile(sorted(newest), SHARE) or 0
        late = slowest * TICK_NS > limits.round_trip * 1e9
        return RoundTrip(ages=newest, late_ticks=lasting(self.late_ticks, late, elapsed))

    def causes(self, limits: Thresholds) -> tuple[Cause, ...]:
        """Return why the body must go at half speed."""
        if self.late_ticks < ticks_of(limits.round_trip_sustain):
            return ()
        text = f"commands take more than {limits.round_trip * 1e3:.0f} ms"
        return (cause("round_trip", text),)


def halved(body: BodyDescription, caps: SpeedCaps) -> SpeedCaps:
    """Return `caps`, limited to half the body's speed in each direction."""

    def least(cap: float | None, most: float) -> float:
        return HALF_SPEED * most if cap is None else min(cap, HALF_SPEED * most)

    return SpeedCaps(
        forward=least(caps.forward, body.max_linear_speed),
        backward=least(caps.backward, body.max_linear_speed),
        left=least(caps.left, body.max_lateral_speed),
        right=least(caps.right, body.max_lateral_speed),
        rotation=least(caps.rotation, body.max_angular_speed),
        turn_left=caps.turn_left,
        turn_right=caps.turn_right,
    )
