"""A gate that is open, fed event by event: where a million tries take a minute."""

from collections.abc import Callable

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import BodyDescription
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.safety import SafetyState
from gigabrain_zenoh.gate import gate
from gigabrain_zenoh.geometry.limits import limits_of
from gigabrain_zenoh.qa.faults.fault import Failed

BOOT, COMMANDER = 7, "script"
FIRST_TICKS = 30  # until it may be released, and is calm


class OpenGate:
    """The gate of `body`, let in by a person."""

    def __init__(self, body: BodyDescription) -> None:
        self._config = gate.GateConfig(limits=limits_of(body))
        self.state = gate.GateState(boot=BOOT)
        self.tick(FIRST_TICKS)
        self._ask(gate.Release(0))
        self.open()

    def open(self) -> None:
        """Let the commander in, once nothing speaks against it."""
        while self.state.mode == "stopping":
            self.tick()
        self._ask(gate.Enable(COMMANDER))

    def tick(self, count: int = 1, seq: Callable[[], int] | None = None) -> None:
        """Let time pass; with `seq` the commander asks for rest in each tick."""
        for _ in range(count):
            self.feed(gate.Tick(Velocity()))
            said = SafetyState(verdict="ok", boot=self.state.boot, tick=self.state.tick)
            self.feed(gate.Safety(said))
            if seq:
                self.feed(gate.Command(self.command(0.0, seq())))

    def command(self, linear_x: float, seq: int, angular_z: float = 0.0) -> CmdVel:
        """One that echoes the newest tick."""
        return CmdVel(
            linear_x=linear_x,
            angular_z=angular_z,
            source=COMMANDER,
            boot=self.state.boot,
            tick=self.state.tick,
            seq=seq,
        )

    def feed(self, event: gate.Event) -> gate.Outcome:
        """One event; what came of it."""
        self.state, outcome = gate.step(self._config, self.state, event)
        return outcome

    def _ask(self, event: gate.Event) -> None:
        outcome = self.feed(event)
        if not outcome.ok:
            raise Failed(f"the gate does not open: {outcome.text}")
