"""An arm in MuJoCo goes to random goals near its body, past a shelf, and touches nothing."""

import pytest

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.qa.bench.reach import measure_reach


@pytest.mark.parametrize(
    ("body", "goals"),
    [
        ("so101", 10),
        pytest.param("so101", 60, marks=pytest.mark.slow),
        pytest.param("piper", 60, marks=pytest.mark.slow),
    ],
)
def test_an_arm_comes_to_each_goal_that_it_has_a_posture_for(body: str, goals: int) -> None:
    result = measure_reach(body, goals, 1, lambda _: None)
    assert result.touched == ()
    assert result.no_way == {}
    assert result.held == 0
    assert result.reached == result.solved.n > goals / 6
    assert sum(result.refused.values()) == result.unsolved.n == goals - result.solved.n
    assert result.off_p95_m < 0.03


@pytest.mark.parametrize("body", ["turtlebot3_burger", "lekiwi"])
def test_a_body_without_an_arm_that_stands_is_refused(body: str) -> None:
    with pytest.raises(ConfigError, match=f"{body} has no arm that stands in MuJoCo"):
        measure_reach(body, 1, 0, lambda _: None)
