"""How late and how slowly a body answers, learnt from commands and measured speeds while it drives.

Every pair of a delay and a first-order lag on a grid predicts the measured speed from the commands;
each axis has a gain of its own, and noise of a size that nobody knows. The answer is their mean,
each weighted by how likely it is: a Gaussian prior times the profile likelihood, whose logarithm is
-n/2 log(squared error / n) summed over the axes, with old errors forgotten. A body that is told the
same all the while says nothing of its response, and nothing is learnt from it.
"""

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.base import TICK_NS, Velocity
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import CmdVel, Response
from gigabrain_zenoh.freshness import LEAD_TICKS
from gigabrain_zenoh.gate_state import BRAIN

Floats = NDArray[np.float64]

TICK_S = TICK_NS / 1e9
PRIOR = Response(delay=0.04, lag=0.06)  # of a body of which nothing is known yet
DELAYS = 16  # candidates, a tick apart: 0 to 0.3 s
DELAYS_S = TICK_S * np.arange(DELAYS)
LAGS_S = 0.02 * np.arange(26)  # candidates: 0 to 0.5 s
LATE_TICKS = 5  # so long the messages of a tick may take; then no order of arrival matters
SILENT_TICKS = 5  # without a command the gate stops the body by itself
EXCITED_TICKS = 30  # a change of the command tells something of the response for so long
LEAST_CHANGE = (0.04, 0.15)  # [m/s], [rad/s], within that time; smaller ones drown in noise
NOISE = (0.004, 0.01)  # [m/s], [rad/s], at least; keeps an exact model from being too sure
MEMORY_TICKS = 1000  # excited ones, until a squared error has lost most of its weight
ENOUGH_TICKS = 40  # excited ones, before anything is believed
LOOK_TICKS = 5  # from one look at all candidates to the next
SPREAD_S = 0.1  # of the prior
ALIKE = 4.0  # neighbouring ticks err alike: so many of them count as one
GAINS = (0.5, 1.5)  # a body that is farther off than this is not driving freely


class Axis:
    """What every candidate predicts of one axis, and how well it did."""

    def __init__(self, least_change: float, noise: float) -> None:
        self._least_change, self._noise = least_change, noise
        # a candidate without any lag has reached what it was told by the next tick
        self._follows = 1.0 - np.exp(-TICK_S / np.maximum(LAGS_S, 1e-9))
        self._outputs = np.zeros((DELAYS, len(LAGS_S)))  # row 0 without delay, row 1 a tick ago, …
        self._told = [0.0] * EXCITED_TICKS
        self._model_model, self._model_measured = np.zeros((2, DELAYS, len(LAGS_S)))
        self._measured_measured = 0.0
        self.weight = 0.0  # of the ticks that count

    def rest(self, measured: float) -> None:
        """The body obeys nobody: all that is known of it is its speed."""
        self._outputs[:] = measured
        self._told = [measured] * EXCITED_TICKS

    def tick(self, told: float, measured: float) -> bool:
        """One tick: what was measured in it, and what was told then. Says whether it learnt."""
        excited = max(self._told) - min(self._told) > self._least_change
        if excited:
            keep = 1.0 - 1.0 / MEMORY_TICKS
            self._model_model = keep * self._model_model + self._outputs * self._outputs
            self._model_measured = keep * self._model_measured + self._outputs * measured
            self._measured_measured = keep * self._measured_measured + measured * measured
            self.weight = keep * self.weight + 1.0
        self._outputs[1:] = self._outputs[:-1]
        self._outputs[0] += self._follows * (told - self._outputs[0])
        self._told = [*self._told[1:], told]
        return excited

    def gains(self) -> Floats:
        """By how much each candidate's output has to be multiplied, (delays, lags)."""
        found: Floats = self._model_measured / np.maximum(self._model_model, 1e-12)
        return np.clip(found, *GAINS)

    def cost(self) -> Floats:
        """How unlikely each candidate is (negative log), (delays, lags)."""
        gains = self.gains()
        errors = self._measured_measured - gains * (
            2.0 * self._model_measured - gains * self._model_model
        )
        mean = np.maximum(errors, 0.0) / max(self.weight, 1.0)
        found: Floats = 0.5 * self.weight * np.log(mean + self._noise**2)
        return found


class ResponseEstimator:
    """Learns a body's response from the stream of its commands and states."""

    def __init__(self, prior: Response = PRIOR) -> None:
        self._prior, self._newest = prior, 0  # tick of the newest state
        self._begin(0)

    @property
    def response(self) -> Response:
        """What it has learnt; the prior until it has learnt anything."""
        return self._response

    @property
    def turn_gain(self) -> float:
        """Measured over commanded turn rate, as in `response`."""
        return self._response.turn_gain

    def command(self, command: CmdVel) -> None:
        """Take a command of the commander or the brain; of a tick, the one of the highest `seq`.

        The gate too goes by `seq`: others may publish under the commander's name.
        """
        in_time = self._done < command.tick <= self._newest + LEAD_TICKS
        known = command.source in (BRAIN, self._commander)
        if command.boot != self._boot or not in_time or not known:
            return
        key = command.tick, command.source
        if key not in self._commands or command.seq >= self._commands[key].seq:
            self._commands[key] = command

    def state(self, state: RobotState) -> None:
        """Take what the body did. It is looked at once the commands of its time are known too."""
        if state.boot != self._boot:
            self._begin(state.boot)
        if state.tick <= self._done:
            return
        self._newest = max(self._newest, state.tick)
        self._commander = state.gate.commander or BRAIN
        self._states[state.tick] = state
        for tick in sorted(self._states):
            if tick <= state.tick - LATE_TICKS:
                self._look(self._states.pop(tick))

    def sent(self, after: int, until: int) -> tuple[tuple[int, Velocity], ...]:
        """What the body was told after one tick and until another, with the tick of each command.

        The command of a tick may still be on its way when the state of the next one is here.
        """
        mine = self._commander
        coming = {tick: told for (tick, source), told in self._commands.items() if source == mine}
        recent = {**self._past, **coming}
        return tuple(
            (tick, velocity_of(recent[tick])) for tick in sorted(recent) if after < tick <= until
        )

    def _begin(self, boot: int) -> None:
        self._boot, self._done = boot, 0
        self._newest = 0
        self._commander = BRAIN
        self._commands: dict[tuple[int, str], CmdVel] = {}  # by tick and source
        self._past: dict[int, CmdVel] = {}  # the commander's, that have been looked at
        self._states: dict[int, RobotState] = {}
        self._told: CmdVel | None = None
        self._axes = tuple(Axis(*each) for each in zip(LEAST_CHANGE, NOISE, strict=True))
        self._response = self._prior

    def _look(self, state: RobotState) -> None:
        learnt = False
        for tick in range(max(self._done + 1, state.tick - SILENT_TICKS), state.tick + 1):
            # a state that was missed is taken to be like the next one
            learnt |= self._one_tick(tick, state)
        self._done = state.tick
        for tick, source in [key for key in self._commands if key[0] <= self._done]:
            told = self._commands.pop((tick, source))
            if source == (state.gate.commander or BRAIN):
                self._past[tick] = told
        for tick in [tick for tick in self._past if tick <= self._done - DELAYS]:
            del self._past[tick]
        if learnt and self._done % LOOK_TICKS == 0:
            self._weigh()

    def _one_tick(self, tick: int, state: RobotState) -> bool:
        gate, measured = state.gate, state.velocity
        self._told = told = self._commands.get((tick, gate.commander), self._told)
        x, z = self._axes
        obeyed = told and gate.mode == "enabled" and told.source == gate.commander
        if not told or not obeyed or told.tick < tick - SILENT_TICKS:
            x.rest(measured.linear_x)
            z.rest(measured.angular_z)
            return False
        forward = x.tick(told.linear_x, measured.linear_x)
        turn = z.tick(told.angular_z, measured.angular_z)
        return forward or turn

    def _weigh(self) -> None:
        """The mean of all candidates, by how likely each is."""
        x, z = self._axes
        if x.weight + z.weight < ENOUGH_TICKS:
            return
        off = (DELAYS_S[:, None] - self._prior.delay) ** 2 + (LAGS_S - self._prior.lag) ** 2
        cost = (x.cost() + z.cost()) / ALIKE + off / (2 * SPREAD_S**2)
        likely = np.exp(cost.min() - cost)
        likely /= likely.sum()
        known = z.weight >= ENOUGH_TICKS
        self._response = Response(
            delay=float((likely * DELAYS_S[:, None]).sum()),
            lag=float((likely * LAGS_S).sum()),
            turn_gain=float((likely * z.gains()).sum()) if known else self._prior.turn_gain,
        )


def velocity_of(command: CmdVel) -> Velocity:
    """The velocity that `command` asks for."""
    return Velocity(
        linear_x=command.linear_x, linear_y=command.linear_y, angular_z=command.angular_z
    )
