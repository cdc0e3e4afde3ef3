"""An SO-101's driver on an emulated bus: what it refuses, what it moves, and what it never does."""

import math
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from gigabrain_drivers.bodies.feetech import protocol as feetech
from gigabrain_drivers.bodies.feetech.calibration import load_calibration
from gigabrain_drivers.bodies.feetech.driver import FeetechDriver, FeetechOptions
from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_zenoh.errors import BodyLost, ConfigError, UnknownName
from tests.unit.drivers.feetech import FOLDER, NAMES, OPTIONS, ROBOT, Rig, opened

HALF_A_DEGREE = math.radians(0.5)
LIFT = "shoulder_lift"


def furthest(before: dict[str, float], after: dict[str, float]) -> float:
    return max(abs(after[name] - before[name]) for name in before)


async def problem_of(rig: Rig) -> str:
    """Wait 40 ms, and return the driver's reason for not moving the arm."""
    await rig.wait(40)
    assert not (await rig.driver.read_state()).link.connected
    return rig.driver.problem


async def test_a_start_moves_nothing() -> None:
    rig = Rig()
    before = rig.positions()
    async with opened(rig):
        await rig.wait(500)
        assert (await rig.driver.read_state()).link.connected
        assert furthest(before, rig.positions()) < HALF_A_DEGREE
        assert all(servo[feetech.TORQUE] == 1 for servo in rig.arm.servos.values())


async def test_a_start_lets_down_nothing_that_is_held() -> None:
    rig = Rig()
    async with opened(rig):
        rig.joint(LIFT).load = 0.5
        await rig.go(1000, elbow_flex=0.5)
    held = rig.positions()
    await rig.wait(500)
    assert furthest(held, rig.positions()) < HALF_A_DEGREE
    rig.driver = rig.another_driver()
    async with opened(rig):
        await rig.wait(1000)
        assert furthest(held, rig.positions()) < HALF_A_DEGREE


async def test_joints_go_where_commanded_within_their_limits() -> None:
    rig = Rig()
    async with opened(rig):
        await rig.go(2000, shoulder_pan=0.5, gripper=9.0, wrist_roll=-9.0)
        sent = await rig.driver.set_joint_positions({"shoulder_pan": 0.5, "gripper": 9.0})
        state = await rig.driver.read_state()
    assert sent["shoulder_pan"] == pytest.approx(0.5, abs=0.001)
    assert sent["gripper"] == pytest.approx(1.7453, abs=0.001)
    at = {joint.name: joint.position for joint in state.joints}
    assert at["shoulder_pan"] == pytest.approx(0.5, abs=0.015)
    assert at["gripper"] == pytest.approx(1.7453, abs=0.015)
    assert at["wrist_roll"] == pytest.approx(-2.7438, abs=0.015)
    for name, position in rig.positions().items():
        assert at[name] == pytest.approx(position, abs=0.001)


async def test_measurements_have_units() -> None:
    rig = Rig()
    async with opened(rig):
        rig.joint(LIFT).load = 0.5
        await rig.go(1000, **{LIFT: -1.0})
        joint = (await rig.driver.read_state()).joints[1]
    assert joint.name == LIFT
    assert joint.effort == pytest.approx(-0.5, abs=0.06)
    assert joint.temperature == pytest.approx(25.0, abs=1.0)
    assert joint.current == pytest.approx(0.5 / 1.91 * 2.7, abs=0.1)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
async def test_what_is_no_number_moves_nothing(value: float) -> None:
    rig = Rig()
    async with opened(rig):
        before = rig.positions()
        sent = await rig.driver.set_joint_positions(dict.fromkeys(NAMES, value))
        await rig.wait(300)
        assert furthest(before, rig.positions()) < HALF_A_DEGREE
        assert all(map(math.isfinite, sent.values()))


async def test_an_unknown_joint_is_refused_with_the_known_ones_and_nothing_moves() -> None:
    rig = Rig()
    async with opened(rig):
        before = rig.positions()
        with pytest.raises(UnknownName, match="did you mean 'elbow_flex'"):
            await rig.driver.set_joint_positions({"shoulder_pan": 1.0, "elbow": 1.0})
        await rig.wait(300)
        assert furthest(before, rig.positions()) < HALF_A_DEGREE


async def test_it_holds_within_a_few_degrees_of_where_it_is_stopped() -> None:
    rig = Rig()
    async with opened(rig):
        await rig.driver.set_joint_positions({"shoulder_pan": 1.5})
        await rig.wait(300)
        moving = rig.joint("shoulder_pan")
        at, speed = moving.position, moving.velocity
        assert speed > 1.0
        await rig.driver.stop()
        await rig.wait(300)
        assert abs(moving.velocity) < 0.02
        assert 0.0 <= moving.position - at < 0.4


async def test_holding_again_and_again_lets_no_load_down() -> None:
    rig = Rig()
    async with opened(rig):
        rig.joint(LIFT).load = 0.6
        await rig.go(1000, **{LIFT: -1.0})
        before = rig.joint(LIFT).position
        for _ in range(100):
            await rig.driver.stop()
            await rig.wait(20)
        assert abs(rig.joint(LIFT).position - before) < HALF_A_DEGREE


async def test_a_closed_driver_leaves_the_arm_as_it_is() -> None:
    rig = Rig()
    async with opened(rig):
        rig.joint(LIFT).load = 0.6
        await rig.go(1000, **{LIFT: -1.0})
        before = rig.positions()
    await rig.wait(3000)
    assert furthest(before, rig.positions()) < HALF_A_DEGREE


async def test_limp_lets_go_until_joints_are_sent_somewhere() -> None:
    rig = Rig()
    async with opened(rig):
        await rig.driver.limp()
        rig.joint(LIFT).load = 0.6
        await rig.wait(500)
        assert not any(servo[feetech.TORQUE] for servo in rig.arm.servos.values())
        state = await rig.driver.read_state()
        assert state.limp
        assert not state.joints_sent
        assert state.link.connected
        assert rig.joint(LIFT).position > -1.5  # it has fallen
        rig.joint(LIFT).load = 0.0
        await rig.wait(200)
        before = rig.positions()
        await rig.go(20, gripper=0.0)
        assert furthest(before, rig.positions()) < HALF_A_DEGREE
        await rig.go(1000, gripper=0.5)
        assert rig.servo(LIFT)[feetech.TORQUE] == 1
        assert rig.joint(LIFT).position == pytest.approx(before[LIFT], abs=HALF_A_DEGREE)
        assert rig.joint("gripper").position == pytest.approx(0.5, abs=0.02)
        assert not (await rig.driver.read_state()).limp


@pytest.mark.parametrize(("limit", "gentle"), [(1.0, 0.4), (0.3, 0.3)])
async def test_a_gripper_is_gentle_once_it_touches_something(limit: float, gentle: float) -> None:
    rig = Rig(torque_limit=limit)
    async with opened(rig):
        await rig.go(1500, gripper=1.0)
        rig.joint("gripper").lower = 0.5  # something is between its fingers
        await rig.go(1000, gripper=0.0)
        assert rig.servo("gripper")[feetech.TORQUE_LIMIT] == 1000 * gentle
        assert rig.joint("gripper").effort == pytest.approx(-gentle * 1.91, abs=0.01)
        await rig.driver.hold()
        await rig.wait(5000)
        assert rig.joint("gripper").effort == pytest.approx(-gentle * 1.91, abs=0.01)
        assert (await rig.driver.read_state()).link.connected
        await rig.go(1500, gripper=1.0)
        assert rig.servo("gripper")[feetech.TORQUE_LIMIT] == 1000 * limit
        assert rig.joint("gripper").position == pytest.approx(1.0, abs=0.02)


async def test_an_overloaded_servo_gives_way_and_works_again() -> None:
    rig = Rig()
    async with opened(rig):
        rig.joint(LIFT).upper = rig.joint(LIFT).position + 0.1  # it drives into a wall
        for _ in range(50):
            await rig.driver.set_joint_positions({LIFT: 0.5})
            await rig.wait(100)
            if not (await rig.driver.read_state()).link.connected:
                break
        assert rig.driver.problem == f"servo 2 ({LIFT}) protects itself: overload"
        await rig.wait(1500)
        assert (await rig.driver.read_state()).link.connected
        assert abs(rig.joint(LIFT).effort) < 0.2
        await rig.go(1000, **{LIFT: -1.65})
        assert rig.joint(LIFT).position == pytest.approx(-1.65, abs=0.02)


async def test_a_servo_that_starts_again_is_caught_and_named() -> None:
    rig = Rig()
    async with opened(rig):
        rig.joint(LIFT).load = 0.6
        await rig.go(1000, **{LIFT: -1.0})
        before = rig.joint(LIFT).position
        rig.servo(LIFT).power_on()
        await rig.wait(200)
        with pytest.raises(BodyLost, match=r"servo 2 \(shoulder_lift\) had switched itself off"):
            await rig.driver.read_state()
        assert rig.servo(LIFT)[feetech.TORQUE] == 1
        assert abs(rig.joint(LIFT).position - before) < math.radians(10)


async def test_a_servo_that_answers_no_more_is_named_and_the_others_hold() -> None:
    rig = Rig()
    async with opened(rig):
        rig.arm.bus.servos.remove(rig.servo("wrist_flex"))
        await rig.go(300, shoulder_pan=1.0)
        assert (
            rig.driver.problem
            == "servo 4 (wrist_flex) no longer answers: check its cable and power"
        )
        assert not (await rig.driver.read_state()).link.connected
        at = rig.joint("shoulder_pan").position
        await rig.go(500, shoulder_pan=1.5)
        assert abs(rig.joint("shoulder_pan").position - at) < 0.1
        rig.arm.bus.servos.append(rig.servo("wrist_flex"))
        await rig.wait(100)
        assert (await rig.driver.read_state()).link.connected


async def test_an_emulated_servo_that_is_silent_neither_hears_nor_answers() -> None:
    rig = Rig()
    async with opened(rig):
        rig.arm.silent_servo = 3
        goals = rig.arm.servos["elbow_flex"].goals
        await rig.wait(300)
        assert (
            rig.driver.problem
            == "servo 3 (elbow_flex) no longer answers: check its cable and power"
        )
        assert rig.arm.servos["elbow_flex"].goals == goals
        rig.arm.silent_servo = 0
        await rig.wait(200)
        assert rig.driver.problem == ""


async def test_a_plugged_in_line_is_found_again_without_a_motion() -> None:
    rig = Rig()
    async with opened(rig):
        await rig.go(600, shoulder_pan=0.4)
        rig.link.drop("unplugged?")
        await rig.wait(100)
        assert not (await rig.driver.read_state()).link.connected
        assert (await rig.driver.set_joint_positions({"shoulder_pan": 1.0}))["shoulder_pan"] < 0.5
        before = rig.positions()
        rig.link.open()
        await rig.wait(500)
        assert (await rig.driver.read_state()).link.connected
        assert furthest(before, rig.positions()) < HALF_A_DEGREE


async def test_no_write_ever_reaches_the_eeprom() -> None:
    rig = Rig()
    kept = {name: servo.kept for name, servo in rig.arm.servos.items()}
    async with opened(rig):
        await rig.go(500, shoulder_pan=0.4)
        rig.link.drop("unplugged?")
        rig.link.open()
        await rig.go(500, gripper=0.4)
        await rig.driver.limp()
    writes = rig.written()
    assert writes
    assert min(packet.params[0] for packet in writes) >= feetech.EEPROM_SIZE
    assert {name: servo.kept for name, servo in rig.arm.servos.items()} == kept


async def test_lost_settings_are_written_again() -> None:
    rig = Rig()
    async with opened(rig):
        rig.servo(LIFT)[feetech.GOAL_VELOCITY] = 0
        rig.servo(LIFT)[feetech.TORQUE_LIMIT] = 100
        await rig.wait(100)
        assert rig.servo(LIFT)[feetech.GOAL_VELOCITY] == 2347
        assert rig.servo(LIFT)[feetech.TORQUE_LIMIT] == 1000
        assert rig.driver.report()["settings_rewritten"]


async def test_an_answer_with_an_impossible_jump_is_refused_and_counted() -> None:
    rig = Rig()
    async with opened(rig):
        at = (await rig.driver.read_state()).joints[0].position
        rig.servo("shoulder_pan")[feetech.POSITION] = 3000
        await rig.clock.advance(10_000_000)
        state = await rig.driver.read_state()
        assert state.joints[0].position == at
        assert rig.driver.report()["readings_refused"] == 1
        assert state.link.errors == 1


def twice(rig: Rig) -> None:
    rig.servo("wrist_flex").keep(feetech.ID, 3)


def missing(rig: Rig) -> None:
    rig.arm.bus.servos.remove(rig.servo("wrist_flex"))


def another_arm(rig: Rig) -> None:
    rig.servo("elbow_flex").keep(feetech.OFFSET, 12)


def another_variant(rig: Rig) -> None:
    rig.servo("gripper").keep(feetech.MAX_VOLTAGE, 140)


def wheel(rig: Rig) -> None:
    rig.servo("gripper").keep(feetech.MODE, 1)


@pytest.mark.parametrize(
    ("spoil", "text"),
    [
        (twice, r"answers as servo 3 \(elbow_flex\) is garbled, and servo 4 \(wrist_flex\) is mis"),
        (missing, r"servo 4 \(wrist_flex\) does not answer: are its cable"),
        (another_arm, r"servo 3 \(elbow_flex\) keeps offset 12 .* this is another arm; run gig"),
        (another_variant, r"servo 6 \(gripper\) takes up to 14 V, but the robot's file has serv"),
        (wheel, r"servo 6 \(gripper\) is of model 777 in mode 1; expected an STS3215"),
    ],
)
async def test_an_arm_that_is_not_the_one_described_is_refused_and_nothing_moves(
    spoil: Callable[[Rig], None], text: str
) -> None:
    rig = Rig()
    spoil(rig)
    rig.arm.reset()
    rig.arm.step(0)
    with pytest.raises(ConfigError, match=text) as caught:
        await rig.during(rig.driver.open())
    assert "\n" not in str(caught.value)
    assert not any(servo.goals for servo in rig.arm.servos.values())
    assert not any(servo[feetech.TORQUE] for servo in rig.arm.servos.values())
    await rig.driver.close()


async def test_the_wrong_supply_is_refused() -> None:
    rig = Rig()
    rig.arm.sag_volts = 3.2
    rig.arm.step(0)
    with pytest.raises(ConfigError, match=r"measures 4\.2 V; expected 4\.5 to 8\.7 V"):
        await rig.during(rig.driver.open())
    await rig.driver.close()


async def test_without_a_calibration_nothing_is_opened(tmp_path: Path) -> None:
    rig = Rig(calibration=str(tmp_path / "none.yaml"))
    with pytest.raises(ConfigError, match=r"so101 is not calibrated; run gigabrain driver calib"):
        await rig.driver.open()
    assert not rig.link.sent


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("gripper:", "claw:", "joints: shoulder_pan, .*, claw; expected those of so101"),
        ("{id: 6", "{id: 7", r"joints\.gripper\.id: 7, but the robot's file has 6"),
        ("direction: 1", "direction: 2", "expected .*1"),
        ("lower: 796", "lower: 3600", "upper: expected more than lower"),
    ],
)
def test_a_calibration_of_another_kind_is_refused_with_its_place(
    old: str, new: str, text: str, tmp_path: Path
) -> None:
    path = tmp_path / "calibration.yaml"
    given = (FOLDER / "emulated.yaml").read_text()
    assert old in given
    path.write_text(given.replace(old, new, 1))
    with pytest.raises(ConfigError, match=text):
        load_calibration(path, "so101", ROBOT.joints, OPTIONS.servos)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"voltage": 9.0}, "voltage: expected 7.4 or 12"),
        ({"servos": {**OPTIONS.servos, "gripper": 5}}, "servos: each needs an id of its own"),
        ({"servos": {**OPTIONS.servos, "claw": 9}}, "servos: no joint 'claw'"),
        ({"servos": {"gripper": 6}}, "servos: none for shoulder_pan"),
        ({"inverted": ("claw",)}, "inverted: no joint 'claw'"),
    ],
)
def test_options_that_do_not_fit_the_body_are_refused(
    changes: dict[str, object], text: str
) -> None:
    robot = load_robot("so101")
    with pytest.raises(ValueError, match=text):
        FeetechDriver.check(robot, msgspec.convert(_options(changes), FeetechOptions))


def _options(changes: dict[str, object]) -> dict[str, object]:
    return {"driver": "feetech", "servos": OPTIONS.servos, **changes}


async def test_a_silent_line_is_waited_for() -> None:
    rig = Rig()
    rig.link.to_arm = lambda data: None
    await rig.during(rig.driver.open())
    assert "no servo answers: right port, power on?" in await problem_of(rig)
    rig.link.to_arm = rig.arm.feed
    await rig.wait(400)
    assert (await rig.driver.read_state()).link.connected
    await rig.driver.close()
