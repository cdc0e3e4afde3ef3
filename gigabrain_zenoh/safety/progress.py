"""Whether perception, decision and control work, judged by what they say and not by their being.

Each must answer what the one before it has said: a world per scan, an intent that rests on the
newest world, a command that rests on the newest intent. One that repeats itself is missed as one
that is silent, however alive the rest of its process is.
"""

import msgspec

from gigabrain_schemas.base import Cause
from gigabrain_schemas.body import RobotState, Thresholds
from gigabrain_zenoh.gate.state import BRAIN
from gigabrain_zenoh.safety.sustain import held, ticks_of
from gigabrain_zenoh.safety.words import say

SYSTEMS = ("perception", "decision", "control")


class Bases(msgspec.Struct, frozen=True, kw_only=True):
    """The ticks of the sensor data that the newest messages rest on; 0 for none."""

    scan: int = 0
    world: int = 0
    intent: int = 0
    command: int = 0


class Progress(msgspec.Struct, frozen=True, kw_only=True):
    """What is remembered of who has answered whom."""

    bases: Bases = Bases()
    behind_ticks: tuple[int, int, int] = (0, 0, 0)  # since each of the systems last went on


def look(before: Progress, bases: Bases, elapsed: int) -> Progress:
    """One state more."""
    chain, last = _chain(bases), _chain(before.bases)
    perception, decision, control = (
        held(
            before.behind_ticks[i], chain[i + 1] < chain[i] and chain[i + 1] == last[i + 1], elapsed
        )
        for i in range(len(SYSTEMS))
    )
    return Progress(bases=bases, behind_ticks=(perception, decision, control))


def _chain(bases: Bases) -> tuple[int, int, int, int]:
    return bases.scan, bases.world, bases.intent, bases.command


def causes(
    limits: Thresholds,
    now: Progress,
    state: RobotState,
    silent: tuple[str, ...],
    *,
    first: bool,
) -> tuple[Cause, ...]:
    """Why the body must stop; `silent` are the systems of which nothing is heard.

    The brain's processes matter while the brain drives; a person or a script looks itself. While
    nobody drives they matter too, since the brain would be next; but where all three are silent
    there is no brain, and a script need not wait for one. Only with the `first` scan it cannot be
    known yet whether there is one; who waits for it is told.
    """
    commander = state.gate.commander
    brainless = not commander and len(silent) == len(SYSTEMS) and not first
    if commander not in ("", BRAIN) or brainless:
        return ()
    found = [say(f"{name}_silent") for name in silent]
    for name, ticks in zip(SYSTEMS, now.behind_ticks, strict=True):
        if name not in silent and ticks >= ticks_of(limits.heartbeat):
            found.append(say(f"{name}_silent", f"{name} takes no notice of what is new"))
    return tuple(found)
