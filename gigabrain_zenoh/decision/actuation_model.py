"""Estimates a body's response delay and lag from commands and measured speeds while it drives.

Each candidate is a pair of a delay and a first-order lag on a grid. It predicts the measured speed
from the commands. Each axis has its own gain, and noise of unknown size. The estimate is the mean
of all candidates, weighted by posterior: a Gaussian prior times the profile likelihood. The log
likelihood is -n/2 log(squared error / n), summed over the axes, with exponential forgetting. A
constant command carries no information about the response, so it is ignored.
"""

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import TICK_S, Velocity
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import ActuationModel, CmdVel
from gigabrain_zenoh.bus.freshness import LEAD_TICKS
from gigabrain_zenoh.gate.state import BRAIN
from gigabrain_zenoh.geometry.pose import velocity_of

PRIOR = ActuationModel(delay=0.04, lag=0.06)  # used until there is an estimate
DELAYS = 16  # candidates, a tick apart: 0 to 0.3 s
DELAYS_S = TICK_S * np.arange(DELAYS)
LAGS_S = TICK_S * np.arange(26)  # candidates: 0 to 0.5 s
LATE_TICKS = 5  # messages of a tick may arrive so late without affecting the result
SILENT_TICKS = 5  # after this long without a command, the gate stops the body
EXCITED_TICKS = 30  # a change of the command is informative for so long
MIN_CHANGE = (0.04, 0.15)  # [m/s], [rad/s], within EXCITED_TICKS; smaller changes drown in noise
NOISE = (0.004, 0.01)  # [m/s], [rad/s], minimum; prevents overconfidence in an exact model
MEMORY_TICKS = 1000  # excited ticks; time constant with which squared errors are forgotten
ENOUGH_TICKS = 40  # excited ticks before the estimate is used
EVALUATION_TICKS = 5  # between evaluations of all candidates
SPREAD_S = 0.1  # standard deviation of the prior
CORRELATED_TICKS = 4.0  # count as one sample: errors of neighbouring ticks correlate
GAINS = (0.5, 1.5)  # range of plausible gains; outside it the body is not driving freely


class Axis:
    """Predictions and accumulated squared errors of all candidates, for one axis."""

    def __init__(self, min_change: float, noise: float) -> None:
        self._min_change, self._noise = min_change, noise
        # a candidate with zero lag reaches the commanded speed by the next tick
        self._follows = 1.0 - np.exp(-TICK_S / np.maximum(LAGS_S, 1e-9))
        self._outputs = np.zeros((DELAYS, len(LAGS_S)))  # row 0: no delay, row 1: one tick, …
        self._commanded = [0.0] * EXCITED_TICKS
        self._model_model, self._model_measured = np.zeros((2, DELAYS, len(LAGS_S)))
        self._measured_measured = 0.0
        self.weight = 0.0  # discounted number of excited ticks

    def reset(self, measured: float) -> None:
        """Reset the predictions to the measured speed, while the body follows no command."""
        self._outputs[:] = measured
        self._commanded = [measured] * EXCITED_TICKS

    def update(self, commanded: float, measured: float) -> bool:
        """Process one tick's commanded and measured speed; return whether it was informative."""
        excited = max(self._commanded) - min(self._commanded) > self._min_change
        if excited:
            keep = 1.0 - 1.0 / MEMORY_TICKS
            self._model_model = keep * self._model_model + self._outputs * self._outputs
            self._model_measured = keep * self._model_measured + self._outputs * measured
            self._measured_measured = keep * self._measured_measured + measured * measured
            self.weight = keep * self.weight + 1.0
        self._outputs[1:] = self._outputs[:-1]
        self._outputs[0] += self._follows * (commanded - self._outputs[0])
        self._commanded = [*self._commanded[1:], commanded]
        return excited

    def gains(self) -> Floats:
        """Return the gain that fits each candidate's output best, within GAINS, (delays, lags)."""
        ratio: Floats = self._model_measured / np.maximum(self._model_model, 1e-12)
        return np.clip(ratio, *GAINS)

    def cost(self) -> Floats:
        """Return each candidate's negative log likelihood, (delays, lags)."""
        gains = self.gains()
        errors = self._measured_measured - gains * (
            2.0 * self._model_measured - gains * self._model_model
        )
        mean = np.maximum(errors, 0.0) / max(self.weight, 1.0)
        cost: Floats = 0.5 * self.weight * np.log(mean + self._noise**2)
        return cost


class ActuationEstimator:
    """Estimates a body's response from its commands and states."""

    def __init__(self, prior: ActuationModel = PRIOR) -> None:
        self._prior, self._newest = prior, 0  # tick of the newest state
        self._begin(0)

    @property
    def response(self) -> ActuationModel:
        """The current estimate; the prior until there are ENOUGH_TICKS."""
        return self._response

    def add_command(self, command: CmdVel) -> None:
        """Add a command of the commander or the brain; for each tick, keep the highest `seq`.

        The gate uses `seq` as well, because other clients may publish under the commander's name.
        """
        in_time = self._done < command.tick <= self._newest + LEAD_TICKS
        known = command.source in (BRAIN, self._commander)
        if command.boot != self._boot or not in_time or not known:
            return
        key = command.tick, command.source
        if key not in self._commands or command.seq >= self._commands[key].seq:
            self._commands[key] = command

    def add_state(self, state: RobotState) -> None:
        """Add a robot state, to be evaluated LATE_TICKS later, when its commands have arrived."""
        if state.boot != self._boot:
            self._begin(state.boot)
        if state.tick <= self._done:
            return
        self._newest = max(self._newest, state.tick)
        self._commander = state.gate.commander or BRAIN
        self._states[state.tick] = state
        for tick in sorted(self._states):
            if tick <= state.tick - LATE_TICKS:
                self._process(self._states.pop(tick))

    def sent(self, after: int, until: int) -> tuple[tuple[int, Velocity], ...]:
        """Return the commander's commands with their ticks, for `after` < tick <= `until`.

        The command of a tick may still be in transit when the state of the next tick arrives.
        """
        pending = {
            tick: command
            for (tick, source), command in self._commands.items()
            if source == self._commander
        }
        recent = {**self._past, **pending}
        return tuple(
            (tick, velocity_of(recent[tick])) for tick in sorted(recent) if after < tick <= until
        )

    def _begin(self, boot: int) -> None:
        self._boot, self._done = boot, 0
        self._newest = 0
        self._commander = BRAIN
        self._commands: dict[tuple[int, str], CmdVel] = {}  # by tick and source
        self._past: dict[int, CmdVel] = {}  # the commander's, already evaluated
        self._states: dict[int, RobotState] = {}
        self._command: CmdVel | None = None
        self._axes = tuple(Axis(*limits) for limits in zip(MIN_CHANGE, NOISE, strict=True))
        self._response = self._prior

    def _process(self, state: RobotState) -> None:
        informative = False
        for tick in range(max(self._done + 1, state.tick - SILENT_TICKS), state.tick + 1):
            # a missed state is assumed to equal the next one
            informative |= self._process_tick(tick, state)
        self._done = state.tick
        for tick, source in [key for key in self._commands if key[0] <= self._done]:
            command = self._commands.pop((tick, source))
            if source == (state.gate.commander or BRAIN):
                self._past[tick] = command
        for tick in [tick for tick in self._past if tick <= self._done - DELAYS]:
            del self._past[tick]
        if informative and self._done % EVALUATION_TICKS == 0:
            self._evaluate()

    def _process_tick(self, tick: int, state: RobotState) -> bool:
        gate, measured = state.gate, state.velocity
        self._command = command = self._commands.get((tick, gate.commander), self._command)
        x, z = self._axes
        obeyed = command and gate.mode == "enabled" and command.source == gate.commander
        if not command or not obeyed or command.tick < tick - SILENT_TICKS:
            x.reset(measured.linear_x)
            z.reset(measured.angular_z)
            return False
        forward = x.update(command.linear_x, measured.linear_x)
        turn = z.update(command.angular_z, measured.angular_z)
        return forward or turn

    def _evaluate(self) -> None:
        """Set the response to the mean of all candidates, weighted by their likelihood."""
        x, z = self._axes
        if x.weight + z.weight < ENOUGH_TICKS:
            return
        distance = (DELAYS_S[:, None] - self._prior.delay) ** 2 + (LAGS_S - self._prior.lag) ** 2
        cost = (x.cost() + z.cost()) / CORRELATED_TICKS + distance / (2 * SPREAD_S**2)
        weights = np.exp(cost.min() - cost)
        weights /= weights.sum()
        has_turned = z.weight >= ENOUGH_TICKS
        self._response = ActuationModel(
            delay=float((weights * DELAYS_S[:, None]).sum()),
            lag=float((weights * LAGS_S).sum()),
            turn_gain=float((weights * z.gains()).sum()) if has_turned else self._prior.turn_gain,
        )
