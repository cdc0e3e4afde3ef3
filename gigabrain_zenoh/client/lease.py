"""The lease that gives one commander the body."""

from gigabrain_schemas.body import GateStatus, RobotState
from gigabrain_zenoh.gate.state import BRAIN

MISSED_TICKS = 25  # without a state, so without a command: then the gate ended the lease


class ControlLease:
    """Tracks whether one commander has the body, from the gate's states.

    A temporary stop, as for an obstacle, does not end the lease. Nor does a pause of the script's
    process, even if the brain drives meanwhile. The lease is lost when another commander takes
    over, the gate latches, as by an e-stop, or the driver restarts. Then the script must ask again:
    it must not take the body back from the person who stopped it.
    """

    def __init__(self, source: str) -> None:
        self._source = source
        self._boot = self._enables = 0  # of the gate when it granted the body
        self._tick = self._latches = 0  # of the last state
        self._had_body = False  # in the last state
        self.lost = False

    def granted(self, boot: int, gate: GateStatus) -> None:
        """Record that the gate granted the body."""
        self._boot, self._enables, self._latches = boot, gate.enables, gate.latches
        self._had_body, self.lost = True, False

    def update(self, state: RobotState) -> None:
        """Record a state, unless it is older than the gate's reply."""
        if not self._boot or self._is_old(state):
            return
        has, gate = self.has(state), state.gate
        missed, self._tick = state.tick - self._tick > MISSED_TICKS, state.tick
        latched, self._latches = gate.latches > self._latches, gate.latches
        allowed = ("", self._source) if self._had_body and not missed else ("", self._source, BRAIN)
        taken = gate.commander not in allowed
        ended = taken or latched or gate.mode == "latched" or self.restarted(state)
        self.lost = not has and (self.lost or ended)
        self._had_body = has

    def has(self, state: RobotState) -> bool:
        """Return whether the body obeys this commander."""
        gate = state.gate
        mine = gate.mode == "enabled" and gate.commander == self._source
        return (mine and not self.restarted(state)) or (self._boot > 0 and self._is_old(state))

    def restarted(self, state: RobotState) -> bool:
        """Return whether the driver restarted after its gate granted the body."""
        return self._boot > 0 and state.boot != self._boot

    def _is_old(self, state: RobotState) -> bool:
        return state.boot == self._boot and state.gate.enables < self._enables
