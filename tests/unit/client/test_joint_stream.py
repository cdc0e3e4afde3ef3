"""A script's commands for joints that follow a posture which changes all the time."""

import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_schemas.base import TICK_S
from gigabrain_schemas.body import Joint, RobotState
from gigabrain_schemas.brain import JointCommand
from gigabrain_schemas.examples import example
from gigabrain_zenoh.client.arm import JointPath, JointStream, checked_positions
from gigabrain_zenoh.errors import BodyLost, ConfigError
from gigabrain_zenoh.geometry.joints import JointMotion, approach, braked

ARM = load_robot("so101").description()
PAN, LIFT = 0, 1


class Arm:
    """A simulated gate and body: each command is where the joints are sent, and are."""

    def __init__(self) -> None:
        self.tick, self.at = 100, (0.0,) * len(ARM.joints)
        self.stream = JointStream(ARM, self.state(), "leader")

    def state(self) -> RobotState:
        places = zip(ARM.joints, self.at, strict=True)
        joints = tuple(Joint(name=joint.name, position=place) for joint, place in places)
        return replace(example(RobotState), tick=self.tick, joints=joints, joints_sent=self.at)

    def step(self, ticks: int = 1) -> JointCommand:
        self.tick += ticks
        command = self.stream.step(self.state())
        assert command
        self.at = command.position
        return command


@pytest.mark.parametrize("new", [1, 4])
def test_a_moving_posture_is_followed_closely_and_never_shot_over(new: int) -> None:
    arm, wanted, off = Arm(), 0.0, []
    for n in range(100):
        if n % new == 0 and n < 60:  # 0.75 rad/s, then at rest
            wanted += 0.015 * new
        arm.stream.go({"shoulder_pan": wanted, "shoulder_lift": -wanted}, None)
        command = arm.step()
        off += [wanted - command.position[PAN], wanted + command.position[LIFT]]
    assert min(off) > -1e-6
    assert max(off) < 0.75 * 0.1 + 0.015 * new
    assert off[-1] == pytest.approx(0.0, abs=1e-4)


def test_a_jump_is_followed_within_speed_and_acceleration() -> None:
    arm = Arm()
    pan, places, speeds = ARM.joints[PAN], [], []
    for _ in range(60):
        arm.stream.go({"shoulder_pan": 1.0}, None)
        command = arm.step()
        places.append(command.position[PAN])
        speeds.append(command.velocity[PAN])
    steps = [b - a for a, b in zip([0.0, *places], places, strict=False)]
    assert max(steps) <= pan.max_speed * TICK_S * 1.01
    gains = [b - a for a, b in zip([0.0, *speeds], speeds, strict=False)]
    assert max(map(abs, gains)) <= pan.max_acceleration * TICK_S * 1.01
    assert places[-1] == pytest.approx(1.0, abs=1e-4)
    assert max(places) < 1.0 + 1e-6


class LateArm(Arm):
    """A gate that misses some commands, and servos that follow 80 ms late."""

    def __init__(self) -> None:
        self.sent = [JointMotion(0.0) for _ in ARM.joints]
        self.before = (0.0,) * len(ARM.joints)
        super().__init__()

    def state(self) -> RobotState:
        rows = zip(ARM.joints, self.at, self.before, strict=True)
        joints = tuple(
            Joint(name=joint.name, position=place, velocity=(place - before) / TICK_S)
            for joint, place, before in rows
        )
        sent = tuple(motion.position for motion in self.sent)
        return replace(super().state(), joints=joints, joints_sent=sent)

    def pass_tick(self, *, lost: bool) -> None:
        """Send the joints on by one command, or brake them where it is `lost`."""
        command, self.tick = self.stream.step(self.state()), self.tick + 1
        assert command
        rows = zip(self.sent, command.position, command.velocity, ARM.joints, strict=True)
        self.sent = [
            braked(now, joint, TICK_S)
            if lost
            else approach(now, JointMotion(place, velocity), joint, TICK_S)
            for now, place, velocity, joint in rows
        ]
        pairs = zip(self.at, self.sent, strict=True)
        self.before = self.at
        self.at = tuple(at + 0.22 * (motion.position - at) for at, motion in pairs)


@pytest.mark.long
@pytest.mark.parametrize("gap", range(1, 10))  # ticks without a command
@pytest.mark.parametrize("back", range(12))  # ticks of commands between it and the end
def test_joints_that_have_arrived_stay_there_without_commands(gap: int, back: int) -> None:
    arm = LateArm()
    arm.stream.follow(JointPath(ARM, [(0.5, {"shoulder_pan": -1.2})], arm.stream.posture))
    missed, ticks = range(25 - back - gap, 25 - back), 0
    while not arm.stream.reached(arm.state()):
        arm.pass_tick(lost=ticks in missed)
        ticks += 1
        assert ticks < 75
    for _ in range(25):
        arm.pass_tick(lost=True)
    assert arm.sent[PAN].position == pytest.approx(-1.2, abs=0.003)
    assert arm.at[PAN] == pytest.approx(-1.2, abs=0.01)


def test_joints_that_are_not_measured_are_not_commanded() -> None:
    state = replace(example(RobotState), joints=(Joint(name="shoulder_pan", position=0.0),))
    with pytest.raises(BodyLost, match="not all of its joints are measured"):
        JointStream(ARM, state, "script")


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.int64, int])
def test_a_position_may_be_a_number_of_numpy(kind: type) -> None:
    assert checked_positions(ARM, {"shoulder_pan": kind(1)}) == {"shoulder_pan": 1.0}


@pytest.mark.parametrize("position", [True, "1", np.zeros(2), None])
def test_a_position_that_is_no_number_is_refused(position: float) -> None:
    with pytest.raises(ConfigError, match="shoulder_pan: expected a number, got "):
        checked_positions(ARM, {"shoulder_pan": position})


def test_a_path_goes_on_where_it_was_when_its_script_was_stopped() -> None:
    arm = Arm()
    path = JointPath(ARM, [(2.0, {"shoulder_pan": 1.0})], arm.stream.posture)
    arm.stream.follow(path)
    for _ in range(50):
        before = arm.step().position[PAN]
    places = [arm.step(3000).position[PAN], *(arm.step().position[PAN] for _ in range(25))]
    assert before == pytest.approx(0.5, abs=0.05)
    assert max(places) < 0.85
    for _ in range(60):
        places.append(arm.step().position[PAN])
    assert places[-1] == pytest.approx(1.0, abs=1e-3)


def test_joints_are_not_held_back_by_a_time_in_which_their_script_was_stopped() -> None:
    arm = Arm()
    arm.stream.go({"shoulder_pan": 1.0}, None)
    for ticks in (1, 3000):  # the gate has not moved them yet
        arm.tick += ticks
        arm.stream.step(arm.state())
    assert not arm.stream.held_back
