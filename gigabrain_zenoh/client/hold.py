"""Whether a script has the body, as far as the gate's states tell. Pure."""

from gigabrain_schemas.body import GateStatus, RobotState


class Hold:
    """One commander's hold on the body.

    A stop that passes (a late command, something in the way) does not end it. It is lost when
    somebody else takes the body over, or when the gate latches: then the script has to ask anew,
    so that it does not take the body back from the person who has just stopped it.
    """

    def __init__(self, source: str) -> None:
        self._source = source
        self._boot = self._enables = 0  # of the gate when it granted the body
        self._had = False  # in the last state
        self.lost = False

    def granted(self, boot: int, gate: GateStatus) -> None:
        """The gate has given the body to this commander."""
        self._boot, self._enables = boot, gate.enables
        self._had, self.lost = True, False

    def see(self, state: RobotState) -> None:
        """Take note of a state; one from before the gate's answer says nothing."""
        if not self._boot or self._is_old(state):
            return
        has, gate = self.has(state), state.gate
        taken = self._had and gate.commander not in ("", self._source)
        self.lost = not has and (self.lost or taken or gate.mode == "latched")
        self._had = has

    def has(self, state: RobotState) -> bool:
        """Whether the body obeys this commander."""
        gate = state.gate
        mine = gate.mode == "enabled" and gate.commander == self._source
        return mine or (self._boot > 0 and self._is_old(state))

    def _is_old(self, state: RobotState) -> bool:
        return state.boot == self._boot and state.gate.enables < self._enables
