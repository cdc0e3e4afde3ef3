"""In the physics, each joint of a stretched arm follows, with a load and with backlash."""

import pytest

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.qa.bench.joints import measure_joints


@pytest.mark.parametrize("body", ["so101", pytest.param("piper", marks=pytest.mark.slow)])
def test_joints_follow_a_sine_within_a_degree_and_overshoot_a_step_by_2_percent(body: str) -> None:
    result = measure_joints(body, 0.1, 1.0, lambda _: None)
    assert len(result.joints) == {"so101": 5, "piper": 6}[body]
    for joint in result.joints:
        assert joint.amplitude_deg > 20.0
        assert joint.rms_deg < 1.0, joint
        assert joint.overshoot < 0.02, joint
        assert joint.rest_deg < 0.5, joint


def test_a_body_without_an_arm_is_refused() -> None:
    with pytest.raises(ConfigError, match="turtlebot3_burger has no arm in MuJoCo"):
        measure_joints("turtlebot3_burger", 0.1, 1.0, lambda _: None)
