"""Whether a robot drove on, as the robot's own ticks have it and not a busy machine."""

import itertools

from gigabrain_schemas.body import RobotState
from gigabrain_zenoh.faults.onlooker import Onlooker

NO_GAP_TICKS = 5  # up to which the gate waits for a command
FRESH_TICKS = 6  # echoes that are older than 120 ms are this machine's doing


def stops(onlooker: Onlooker, start: RobotState) -> list[int]:
    """The ticks since `start` in which the gate has left `enabled`."""
    states = (s for s in onlooker.states if s.boot == start.boot and s.tick >= start.tick)
    pairs = itertools.pairwise(states)
    return [b.tick for a, b in pairs if a.gate.mode == "enabled" != b.gate.mode]


def starts(onlooker: Onlooker, start: RobotState, ticks: int) -> int:
    """How often the gate has begun to let commands through, within so many ticks of `start`."""
    end = start.tick + ticks
    states = [s for s in onlooker.states if s.boot == start.boot and start.tick <= s.tick <= end]
    pairs = itertools.pairwise(states)
    return sum(a.gate.mode != "enabled" == b.gate.mode for a, b in pairs)


def stops_in_time(onlooker: Onlooker, start: RobotState) -> int:
    """How often it stopped since `start` though its commands came in time."""
    heard = list(zip(onlooker.arrivals, (c.tick for c in onlooker.commands), strict=True))
    return sum(_in_time(heard, tick) for tick in stops(onlooker, start))


def _in_time(heard: list[tuple[int, int]], stop: int) -> bool:
    """Whether the commands before a stop had no gap, and none echoed an old tick."""
    recent = [(came, echo) for came, echo in heard if stop - 3 * NO_GAP_TICKS <= came <= stop]
    gaps = [b - a for (a, _), (b, _) in itertools.pairwise([*recent, (stop, stop)])]
    old = any(came - echo > FRESH_TICKS for came, echo in recent)
    return bool(recent) and max(gaps) <= NO_GAP_TICKS and not old
