"""Execution of phases, tick by tick."""

import numpy as np

from gigabrain_zenoh.manipulation.joint_trajectory import TimeParametrization
from gigabrain_zenoh.manipulation.phases import Phase, PhaseRun
from tests.unit.manipulation.arms import arm

END = (0.4, -0.2, 0.1, 0.0, 0.3)


def moved() -> Phase:
    """Return a phase that moves the arm to END."""
    postures = np.stack((np.zeros(5), np.array(END)))
    return Phase(name="move", arm=TimeParametrization(arm().joints).trajectory(postures))


def test_after_the_last_phase_the_arm_stays_at_the_end_of_its_trajectory() -> None:
    run = PhaseRun((moved(),), "gripper", 100)
    tick = 100
    while run.phase:
        tick += 1
        run.advance(tick)
    for late in (0, 1, 50):
        targets, window = run.wish(tick + late)
        assert targets == ()
        assert window
        assert window.start == tick + late + 1
        assert np.allclose(window.array(), END)


def test_after_the_last_phase_a_gripper_stays_at_its_goal() -> None:
    run = PhaseRun((moved(), Phase(name="grip", gripper=0.7)), "gripper", 0)
    for tick in range(1000):
        run.advance(tick)
    assert run.phase is None
    ((target,), window) = run.wish(1000)
    assert (target.name, target.position, window) == ("gripper", 0.7, None)
