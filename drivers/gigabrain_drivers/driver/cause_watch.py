"""Which causes come and go, and who raised them: each is audited when it comes and when it goes."""

from gigabrain_schemas.base import Cause
from gigabrain_zenoh.gate.gate import GateState
from gigabrain_zenoh.runtime.audit import AuditTrail

Raised = dict[str, tuple[str, Cause]]  # by its code: who raised it, and the cause


class CauseWatch:
    """Compares what holds the robot back now with what did so before."""

    def __init__(self, trail: AuditTrail) -> None:
        self._trail = trail
        self._known: Raised = {}

    def look(self, state: GateState) -> None:
        """Write down what is new, and what is gone."""
        before = self._known
        now = {code: before.get(code, found) for code, found in raised(state).items()}
        for code, (who, cause) in now.items():
            if code not in before:
                self._trail.note("raised", who, cause.text, code=code)
        for code, (who, cause) in before.items():
            if code not in now:
                self._trail.note("cleared", who, cause.text, code=code)
        self._known = now


def raised(state: GateState) -> Raised:
    """Every cause of this moment. What safety or the driver has found is not the gate's own."""
    safety = state.safety
    found: Raised = {cause.code: ("gate", cause) for cause in state.causes}
    found |= {cause.code: ("driver", cause) for cause in state.faults}
    for cause in (*safety.causes, *safety.warnings) if safety else ():
        found[cause.code] = ("safety", cause)
    return found
