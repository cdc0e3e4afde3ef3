"""What a body does with the commands that it is given, as heard on the bus."""

import statistics

from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.safety import Health
from gigabrain_schemas.topics import CMD_VEL, HEALTH, STATE
from gigabrain_zenoh.bus.bus import Bus

LEVELS = (("linear_x", 0.05), ("angular_z", 0.2))  # [m/s], [rad/s]: what counts as motion


class Onlooker:
    """Compares commands and motion, tick by tick, while the gate is open."""

    def __init__(self, bus: Bus) -> None:
        self.enabled_ticks = self.stops = 0
        self.state: RobotState | None = None
        self.latencies: list[int] = []
        self.driver_cpu: list[float] = []  # of a core, each second
        self._commanded: list[float] = []
        self._measured: list[float] = []
        self._command: CmdVel | None = None
        self._begun: dict[str, int | None] = {}  # tick of a command of motion not yet followed
        self._was: dict[str, bool] = {}
        self._open = False
        bus.subscribe(STATE, self._see)
        bus.subscribe(CMD_VEL, self._hear)
        bus.subscribe(HEALTH, self._note_cpu)

    @property
    def commanded(self) -> float:
        """Mean of the commanded speed forward [m/s]."""
        return statistics.fmean(self._commanded) if self._commanded else 0.0

    @property
    def measured(self) -> float:
        """Mean of the measured speed forward [m/s]."""
        return statistics.fmean(self._measured) if self._measured else 0.0

    def _note_cpu(self, _key: str, health: Health) -> None:
        if self._open and health.process == "driver":
            self.driver_cpu.append(health.cpu)

    def _hear(self, _key: str, command: CmdVel) -> None:
        self._command = command
        for axis, level in LEVELS:
            moves = abs(getattr(command, axis)) >= level
            if moves and not self._was.get(axis, False):
                self._begun[axis] = None if self._moves(axis, level) else command.tick
            elif not moves:
                self._begun[axis] = None
            self._was[axis] = moves

    def _see(self, _key: str, state: RobotState) -> None:
        self.state = state
        opened = state.gate.mode == "enabled"
        self.stops += self._open and not opened
        self._open = opened
        if not opened or self._command is None or self._command.boot != state.boot:
            return
        self.enabled_ticks += 1
        self._commanded.append(self._command.linear_x)
        self._measured.append(state.velocity.linear_x)
        for axis, level in LEVELS:
            begun = self._begun.get(axis)
            if begun is not None and self._moves(axis, level):
                self.latencies.append(state.tick - begun)
                self._begun[axis] = None

    def _moves(self, axis: str, level: float) -> bool:
        return self.state is not None and abs(getattr(self.state.velocity, axis)) >= level
