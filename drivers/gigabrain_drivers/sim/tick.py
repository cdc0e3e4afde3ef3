"""The simulation's own clock: whole ticks, so that time never drifts."""

TICK_NS = 10_000_000  # one advance of the simulation
TICK_S = TICK_NS / 1e9
