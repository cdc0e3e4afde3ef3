"""Whether a robot drove on, by its own ticks."""

import itertools

from gigabrain_schemas.body import RobotState
from gigabrain_zenoh.qa.faults.onlooker import Onlooker


def stops(onlooker: Onlooker, start: RobotState) -> list[int]:
    """The ticks since `start` in which the gate has left `enabled`."""
    states = (s for s in onlooker.states if s.boot == start.boot and s.tick >= start.tick)
    pairs = itertools.pairwise(states)
    return [b.tick for a, b in pairs if a.gate.mode == "enabled" != b.gate.mode]


def starts_and_stops(onlooker: Onlooker, start: RobotState, ticks: int) -> int:
    """Count each start and each stop within `ticks` of `start`, as a person would who looks on."""
    end = start.tick + ticks
    states = [s for s in onlooker.states if s.boot == start.boot and start.tick <= s.tick <= end]
    pairs = itertools.pairwise(states)
    return sum((a.gate.mode == "enabled") != (b.gate.mode == "enabled") for a, b in pairs)
