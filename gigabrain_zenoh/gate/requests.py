"""What people ask of the gate beside the body itself: to stop, and to let go of what latched it."""

from msgspec.structs import replace

from gigabrain_zenoh.gate import causes as why
from gigabrain_zenoh.gate.state import Estop, GateState, Outcome, Release
from gigabrain_zenoh.geometry.limits import ZERO

STILL_TICKS = 25  # 0.5 s at rest before a release


def estop(state: GateState, event: Estop) -> tuple[GateState, Outcome]:
    """Zero at once and latched, whatever the gate was doing."""
    generation = state.estop_generation + 1
    state = replace(
        state,
        mode="latched",
        causes=why.merge(why.latching(state.causes), (why.estop(event.source),)),
        estop_generation=generation,
        commander="",
        before=ZERO,
    )
    return state, Outcome(text=f"stopped and latched; e-stop number {generation}")


def release(state: GateState, event: Release) -> tuple[GateState, Outcome]:
    """Idle, where the body rests and nothing latches it any more."""
    if state.mode == "stopping":
        return no(state, "still stopping; try again when the body is at rest")
    if state.mode != "latched":
        return state, Outcome(text="not latched, nothing to release")
    if event.estop_generation != state.estop_generation:
        newest = state.estop_generation
        return no(state, f"e-stop number {newest} is the newest; look at it before you release")
    if state.still_ticks < STILL_TICKS:
        return no(state, "the body is not at rest yet; wait half a second")
    held = why.latching(state.faults + (state.safety.causes if state.safety else ()))
    if held:
        return no(state, f"what latched it still holds: {why.in_words(held)}")
    by_hand = bool(why.latching(state.causes))
    state = replace(state, mode="idle", causes=(), by_hand=by_hand)
    return state, Outcome(text="released; enable it to move")


def no(state: GateState, text: str) -> tuple[GateState, Outcome]:
    """A refusal, and why."""
    return state, Outcome(ok=False, text=text)
