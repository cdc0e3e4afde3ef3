"""The lease by which one commander has the body."""

from gigabrain_schemas.body import GateStatus, RobotState


class ControlLease:
    """Tracks whether one commander has the body, from the gate's states.

    A passing stop, as for an obstacle, does not end the lease. It is lost when another commander
    takes over, the gate latches or the driver restarts. Then the script must ask again: it must not
    take the body back from the person who has just stopped it.
    """

    def __init__(self, source: str) -> None:
        self._source = source
        self._boot = self._enables = 0  # of the gate when it granted the body
        self._had = False  # in the last state
        self.lost = False

    def granted(self, boot: int, gate: GateStatus) -> None:
        """Record that the gate has granted the body."""
        self._boot, self._enables = boot, gate.enables
        self._had, self.lost = True, False

    def update(self, state: RobotState) -> None:
        """Record a state, unless it is from before the gate's answer."""
        if not self._boot or self._is_old(state):
            return
        has, gate = self.has(state), state.gate
        taken = self._had and gate.commander not in ("", self._source)
        ended = taken or gate.mode == "latched" or self.restarted(state)
        self.lost = not has and (self.lost or ended)
        self._had = has

    def has(self, state: RobotState) -> bool:
        """Return whether the body obeys this commander."""
        gate = state.gate
        mine = gate.mode == "enabled" and gate.commander == self._source
        return (mine and not self.restarted(state)) or (self._boot > 0 and self._is_old(state))

    def restarted(self, state: RobotState) -> bool:
        """Return whether the driver has restarted since its gate granted the body."""
        return self._boot > 0 and state.boot != self._boot

    def _is_old(self, state: RobotState) -> bool:
        return state.boot == self._boot and state.gate.enables < self._enables
