"""Estimates of a body's delay and lag while it drives."""

import itertools
import math
from collections import deque

import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_schemas.body import GateStatus
from gigabrain_schemas.brain import ActuationModel, CmdVel
from gigabrain_zenoh.decision.actuation_model import PRIOR, ActuationEstimator
from gigabrain_zenoh.testing.samples import BOOT, DRIVING, state

PARTS = 4  # simulation steps per tick


class Plant:
    """A simulated body with delay, lag and noise, and its estimator."""

    def __init__(
        self,
        delay_s: float = 0.1,
        lag_s: float = 0.15,
        *,
        gain: tuple[float, float] = (0.9, 0.8),
        noise: tuple[float, float] = (0.01, 0.03),
    ) -> None:
        self.estimator, self.tick = ActuationEstimator(), 0
        self._random = np.random.default_rng(1)
        self._late = deque([(0.0, 0.0)] * round(delay_s / 0.02 * PARTS))
        self._follows = 1 - math.exp(-0.02 / PARTS / lag_s)
        self._gain, self._noise = gain, noise
        self.v = self.w = self.told_v = self.told_w = 0.0

    def drive(
        self, v: float, w: float, ticks: int, *, gate: GateStatus = DRIVING, source: str = "control"
    ) -> ActuationModel:
        """Drive towards a speed for some ticks, with ramps like those of control."""
        for _ in range(ticks):
            self.tick += 1
            measured_v = self.v + self._noise[0] * self._random.standard_normal()
            measured_w = self.w + self._noise[1] * self._random.standard_normal()
            self.estimator.add_state(state(self.tick, v=measured_v, w=measured_w, gate=gate))
            self.told_v += min(0.02, max(-0.02, v - self.told_v))
            self.told_w += min(0.06, max(-0.06, w - self.told_w))
            told = CmdVel(linear_x=self.told_v, angular_z=self.told_w, source=source)
            self.estimator.add_command(replace(told, boot=BOOT, tick=self.tick))
            for _ in range(PARTS):
                self._late.append((self.told_v, self.told_w))
                now_v, now_w = self._late.popleft()
                self.v += (self._gain[0] * now_v - self.v) * self._follows
                self.w += (self._gain[1] * now_w - self.w) * self._follows
        return self.estimator.response

    def wander(self, legs: int) -> ActuationModel:
        """Drive at another speed every half second."""
        wishes = itertools.cycle([(0.4, 0.0), (0.1, 0.9), (0.5, -0.5), (0.0, -0.9), (0.3, 0.4)])
        for v, w in itertools.islice(wishes, legs):
            self.drive(v, w, 25)
        return self.estimator.response


@pytest.mark.parametrize("delay", [0.0, 0.04, 0.1])
@pytest.mark.parametrize("lag", [0.05, 0.15])
def test_delay_and_lag_are_estimated_within_10_s_of_driving(delay: float, lag: float) -> None:
    plant = Plant(delay, lag)
    found = plant.wander(20)
    assert found.delay == pytest.approx(delay, abs=0.021)
    assert found.lag == pytest.approx(lag, abs=0.031)
    assert found.delay + found.lag == pytest.approx(delay + lag, abs=0.021)
    assert plant.estimator.response.turn_gain == pytest.approx(0.8, abs=0.04)


def test_the_driving_pattern_of_avoid_is_enough() -> None:
    plant = Plant(0.1, 0.15)
    for v, w in [(0.2, 0.0), (0.0, -0.5)] * 3:
        found = plant.drive(v, w, 150)
    assert found.delay + found.lag == pytest.approx(0.25, abs=0.021)


def test_the_estimate_of_a_very_slow_body_stays_within_bounds() -> None:
    found = Plant(0.5, 1.0).wander(40)
    assert found.delay <= 0.3
    assert found.lag <= 0.5


def test_a_body_at_rest_or_at_constant_speed_gives_no_information() -> None:
    plant = Plant(0.1, 0.15)
    assert plant.drive(0.0, 0.0, 500) == PRIOR
    plant.v = plant.told_v = 0.3
    assert plant.drive(0.3, 0.0, 29) == PRIOR
    plant.wander(20)
    learnt = plant.drive(0.3, 0.0, 100)  # the last change is evaluated
    assert learnt != PRIOR
    assert plant.drive(0.3, 0.0, 1500) == learnt


@pytest.mark.parametrize(
    ("gate", "source"),
    [
        (GateStatus(mode="idle"), "control"),
        (GateStatus(mode="stopping", commander="control"), "control"),
        (DRIVING, "somebody"),
    ],
)
def test_commands_that_the_gate_blocks_give_no_information(gate: GateStatus, source: str) -> None:
    plant = Plant(0.1, 0.15)
    for v in (0.4, 0.0, 0.3, 0.1):
        assert plant.drive(v, 0.0, 50, gate=gate, source=source) == PRIOR


def test_the_estimate_follows_a_body_that_becomes_slower() -> None:
    plant = Plant(0.02, 0.06)
    assert plant.wander(40).lag == pytest.approx(0.06, abs=0.021)
    plant._follows = 1 - math.exp(-0.02 / PARTS / 0.25)
    assert plant.wander(160).lag == pytest.approx(0.25, abs=0.041)


def test_a_restart_of_the_driver_resets_the_estimate() -> None:
    plant = Plant(0.1, 0.15)
    assert plant.wander(20) != PRIOR
    plant.estimator.add_state(state(1, boot=8))
    assert plant.estimator.response == PRIOR


def test_the_order_of_messages_within_a_few_ticks_does_not_matter() -> None:
    early, late = Plant(), Plant()
    held: list[CmdVel] = []
    take = late.estimator.add_command

    def hold_back(command: CmdVel) -> None:
        held.append(command)
        if len(held) > 3:
            take(held.pop(0))

    late.estimator.add_command = hold_back  # type: ignore[method-assign]
    assert early.wander(13) == late.wander(13)
    assert early.estimator.response.turn_gain == late.estimator.response.turn_gain


def test_it_remembers_recent_commands() -> None:
    plant = Plant()
    plant.drive(0.5, 0.0, 20)
    sent = plant.estimator.sent(17, 19)
    assert [(tick, round(told.linear_x, 2)) for tick, told in sent] == [(18, 0.36), (19, 0.38)]


def test_occasional_missing_states_and_commands_do_no_harm() -> None:
    plant = Plant(0.1, 0.15)
    state_of, count = plant.estimator.add_state, itertools.count()

    def lossy(measured: object) -> None:
        if next(count) % 7:
            state_of(measured)  # type: ignore[arg-type]

    plant.estimator.add_state = lossy  # type: ignore[method-assign]
    found = plant.wander(30)
    assert found.delay + found.lag == pytest.approx(0.25, abs=0.041)


def told(tick: int, v: float = 0.0, source: str = "control", seq: int = 0) -> CmdVel:
    return CmdVel(linear_x=v, source=source, boot=BOOT, tick=tick, seq=seq)


def test_commands_of_others_than_the_commander_are_ignored() -> None:
    estimator = ActuationEstimator()
    estimator.add_state(state(10))
    estimator.add_command(told(10, 0.2))
    estimator.add_command(told(10, -2.0, source="stranger"))
    assert [speed.linear_x for _, speed in estimator.sent(0, 10)] == [0.2]


def test_a_client_with_the_commanders_name_is_treated_as_by_the_gate() -> None:
    estimator = ActuationEstimator()
    estimator.add_state(state(11))
    for command in (told(10, -2.0), told(10, 0.2, seq=7), told(11, 0.3, seq=8), told(11, -2.0)):
        estimator.add_command(command)
    assert [speed.linear_x for _, speed in estimator.sent(0, 11)] == [0.2, 0.3]


def test_after_a_change_of_commander_the_new_ones_commands_count() -> None:
    estimator = ActuationEstimator()
    estimator.add_state(state(10))
    estimator.add_command(told(10, 0.2))
    estimator.add_state(state(11, gate=GateStatus(mode="enabled", commander="script")))
    estimator.add_command(told(11, 0.1, source="script"))
    estimator.add_command(told(11, 0.2))
    assert [speed.linear_x for tick, speed in estimator.sent(10, 11)] == [0.1]


def test_commands_of_distant_ticks_are_not_stored() -> None:
    estimator = ActuationEstimator()
    estimator.add_state(state(10))
    for tick in range(10, 20_000):
        estimator.add_command(told(tick))
    assert [tick for tick, _ in estimator.sent(0, 2**40)] == [10, 11, 12, 13, 14, 15]


def test_the_number_of_stored_commands_is_limited() -> None:
    estimator = ActuationEstimator()
    for tick in range(1, 200):
        estimator.add_state(state(tick))
        for n in range(50):
            estimator.add_command(told(tick + n, source=f"stranger {n}"))
            estimator.add_command(told(tick + n))
    assert len(estimator._commands) + len(estimator._past) < 40
