"""AgileX Piper's driver: what it sends the arm, and what it makes of its reports."""

import logging
import math

import pytest
from msgspec.structs import replace

from gigabrain_drivers.bodies.piper import protocol as piper
from gigabrain_drivers.bodies.piper.driver import NOTHING_COMES, PiperDriver
from gigabrain_drivers.links.can_link import CanDecoder, CanFrame, records
from gigabrain_zenoh.errors import BodyLost, Unsupported
from tests.unit.drivers.piper import ARM, OPTIONS, ROBOT, Rig, make_rig  # noqa: F401

RAISED = (0.3, 1.0, -1.2, 0.2, 0.6, -0.4)  # [rad]


async def test_opening_moves_nothing_whatever_was_sent_before() -> None:
    rig = Rig(*RAISED)
    rig.arm.feed(piper.mode(piper.BY_CAN, piper.MOVE_J, 100).record())
    async with rig.driver:
        await rig.wait(1000)
        state = await rig.driver.read_state()
        assert state.link.connected
        assert rig.angles == pytest.approx(RAISED, abs=math.radians(0.5))
        assert not (await rig.driver.read_state()).limp


async def test_motors_get_power_only_after_targets_where_they_are() -> None:
    rig = Rig(0.5)
    rig.arm.reset()
    rig.arm.reset()  # a restart: motors off
    rig.arm.feed(piper.mode(piper.BY_CAN, piper.MOVE_J, 100).record())
    rig.arm.feed(records(piper.move((-1.0, 0.0, 0.0, 0.0, 0.0, 0.0))))  # of another program
    async with rig.driver:
        await rig.wait(600)
        assert all(servo.on for servo in (*rig.arm.joints, rig.arm.gripper))
        assert rig.angles[0] == pytest.approx(0.5, abs=1e-4)
        ids = [frame.id for frame in rig.cable.sent]
        assert ids.index(piper.MOVE) < ids.index(piper.MODE) < ids.index(piper.ENABLE)


async def test_joints_go_where_they_are_sent_and_it_says_where_that_is(rig: Rig) -> None:
    sent = await rig.driver.set_joint_positions({"joint1": 0.1234567, "gripper": 0.02})
    assert sent == pytest.approx({"joint1": math.radians(7.074), "gripper": 0.02}, abs=1e-9)
    state = await rig.move(1500, joint1=0.1234567, joint3=-0.4, gripper=0.02)
    positions = {joint.name: joint.position for joint in state.joints}
    assert positions["joint1"] == pytest.approx(0.12346, abs=2e-4)
    assert positions["joint3"] == pytest.approx(-0.4, abs=2e-4)
    assert positions["gripper"] == pytest.approx(0.02, abs=1e-4)
    assert positions["joint2"] == pytest.approx(0.0, abs=1e-4)
    assert list(positions) == [*ARM, "gripper"]


async def test_one_joint_alone_leaves_the_others_where_they_were_sent(rig: Rig) -> None:
    await rig.driver.set_joint_positions({"joint2": 0.5})
    assert await rig.driver.set_joint_position("joint1", 0.2) == pytest.approx(0.2, abs=1e-5)
    assert piper.decode_pair(rig.frames(piper.MOVE)[-1]) == pytest.approx((0.2, 0.5), abs=1e-4)


async def test_positions_stay_within_the_limits(rig: Rig) -> None:
    sent = await rig.driver.set_joint_positions({"joint2": -1.0, "joint5": 9.0, "gripper": 1.0})
    assert sent == pytest.approx({"joint2": 0.0, "joint5": 1.22, "gripper": 0.035}, abs=1e-4)
    await rig.wait(3000)
    assert rig.angles[4] == pytest.approx(1.22, abs=1e-3)
    assert rig.body.places["gripper"] == pytest.approx(0.035, abs=1e-4)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
async def test_what_is_no_number_has_all_joints_stay(rig: Rig, bad: float) -> None:
    await rig.move(600, joint1=0.2)
    sent = await rig.driver.set_joint_positions({"joint1": bad, "joint4": 1.0})
    assert sent == pytest.approx({"joint1": 0.2, "joint4": 0.0}, abs=1e-4)
    await rig.wait(500)
    assert rig.angles[3] == pytest.approx(0.0, abs=1e-4)


async def test_a_joint_that_it_does_not_have_is_refused_and_nothing_moves(rig: Rig) -> None:
    before = len(rig.cable.sent)
    with pytest.raises(Unsupported, match="no joint 'joint9'"):
        await rig.driver.set_joint_positions({"joint1": 0.5, "joint9": 0.1})
    assert len(rig.cable.sent) == before


async def test_stop_and_hold_keep_the_last_position_and_nothing_sinks(rig: Rig) -> None:
    await rig.move(1500, joint2=1.0, joint3=-1.0)
    for _ in range(50):
        await rig.driver.stop()
        await rig.driver.hold()
        await rig.wait(20)
    assert rig.angles[1:3] == pytest.approx([1.0, -1.0], abs=1e-3)
    assert not rig.frames(piper.STOP)


async def test_a_dead_driver_leaves_the_arm_where_it_is(rig: Rig) -> None:
    await rig.move(1500, joint2=1.0, joint3=-1.0)
    rig.cable.to_arm = lambda data: None
    await rig.wait(5000)
    assert rig.angles[1:3] == pytest.approx([1.0, -1.0], abs=1e-3)


async def test_closing_lets_go_of_nothing() -> None:
    rig = Rig()
    async with rig.driver:
        await rig.wait(400)
        await rig.move(1500, joint2=1.0)
    await rig.wait(2000)
    assert rig.angles[1] == pytest.approx(1.0, abs=1e-3)
    assert all(servo.on for servo in rig.arm.joints)


async def test_limp_lets_go_and_the_next_positions_hold_where_it_is(rig: Rig) -> None:
    await rig.move(1500, joint2=1.0, joint3=-1.0, gripper=0.01)
    await rig.driver.limp()
    await rig.wait(300)
    state = await rig.driver.read_state()
    assert state.limp
    assert state.link.connected
    assert not any(servo.on for servo in (*rig.arm.joints, rig.arm.gripper))
    await rig.driver.stop()
    await rig.wait(300)
    assert (await rig.driver.read_state()).limp
    fallen = rig.angles[1]
    assert fallen < 0.6
    sent = await rig.driver.set_joint_positions({"joint2": fallen})
    await rig.wait(400)
    assert sent["joint2"] == pytest.approx(fallen, abs=0.3)
    state = await rig.driver.read_state()
    assert not state.limp
    assert rig.angles[1] == pytest.approx(state.joints[1].position, abs=1e-4)
    await rig.wait(300)
    assert rig.angles[1] == pytest.approx(state.joints[1].position, abs=1e-4)


async def test_a_driver_that_ends_limp_leaves_the_gripper_limp_too() -> None:
    rig = Rig()
    rig.driver.robot = replace(ROBOT, safe_state="limp")
    async with rig.driver:
        await rig.wait(400)
        await rig.move(1000, gripper=0.01)
    await rig.wait(300)
    assert not any(servo.on for servo in (*rig.arm.joints, rig.arm.gripper))


async def test_limp_that_the_bus_does_not_take_is_an_error_and_the_arm_is_held(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with monkeypatch.context() as full:
        full.setattr(rig.cable, "write", lambda data: rig.cable.drop("buffer full"))
        with pytest.raises(BodyLost, match="memory: buffer full"):
            await rig.driver.limp()
    rig.cable.plug()
    await rig.wait(500)
    assert all(servo.on for servo in rig.arm.joints)
    rig.arm.joints[1].on = False  # which is noticed, as it is to hold
    await rig.wait(100)
    assert "motor 2 has switched itself off" in caplog.text


async def test_limp_without_an_arm_is_an_error() -> None:
    rig = Rig()
    rig.cable.cut = True
    async with rig.driver:
        await rig.wait(100)
        with pytest.raises(BodyLost, match="no arm reports"):
            await rig.driver.limp()
        with pytest.raises(BodyLost, match="no arm reports"):
            await rig.driver.set_joint_positions({"joint1": 0.0})
        state = await rig.driver.read_state()
        assert (state.joints, state.link.connected, state.limp) == ((), False, False)
        assert rig.driver.problem == NOTHING_COMES


async def test_a_temperature_that_comes_no_more_is_not_reported(rig: Rig) -> None:
    arrive = rig.cable.on_bytes

    def without_the_third_drive(data: bytes) -> None:
        frames = [one for one in CanDecoder().feed(data) if one.id != piper.DRIVES + 2]
        arrive(records(frames))

    rig.cable.on_bytes = without_the_third_drive
    await rig.wait(2100)
    state = await rig.driver.read_state()
    assert state.link.connected
    assert [joint.temperature is None for joint in state.joints[:4]] == [False, False, True, False]


async def test_it_reports_speed_current_temperature_and_effort(rig: Rig) -> None:
    for _ in range(10):
        await rig.driver.set_joint_positions({"joint1": 1.0})
        await rig.wait(20)
    joint = (await rig.driver.read_state()).joints[0]
    assert joint.velocity > 0.5
    assert joint.temperature == 32.0
    assert joint.current is not None
    assert joint.effort == pytest.approx(joint.current * 1.18125)
    assert joint.effort == pytest.approx(0.5, abs=2e-3)


async def test_feedback_that_ends_is_reported_within_120_ms_and_logged(
    rig: Rig, caplog: pytest.LogCaptureFixture
) -> None:
    rig.cable.cut = True
    await rig.wait(120)
    state = await rig.driver.read_state()
    assert not state.link.connected
    assert state.link.age_ms >= 100
    assert len(state.joints) == 7  # as they were last
    with caplog.at_level(logging.WARNING):
        await rig.wait(700)
    assert [record.message for record in caplog.records] == [f"memory: {NOTHING_COMES}"]
    sent = await rig.driver.set_joint_positions({"joint1": 1.0})
    assert sent["joint1"] == pytest.approx(0.0, abs=1e-4)


async def test_a_dead_bus_that_is_opened_again_and_again_is_logged_once(
    rig: Rig, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    rig.cable.cut = True
    for _ in range(10):
        await rig.wait(200)
        rig.cable.drop("no data for 200 ms")
        await rig.wait(100)
        rig.cable.plug()
    assert [record.message for record in caplog.records if record.levelname == "WARNING"] == [
        "memory: no data for 200 ms",
        f"memory: {NOTHING_COMES}",
    ]
    rig.cable.cut = False
    await rig.wait(100)
    assert caplog.records[-1].message == "memory: the arm reports, and all is well"
    rig.cable.cut = True
    await rig.wait(800)
    assert caplog.records[-1].message == f"memory: {NOTHING_COMES}"


async def test_after_a_loss_it_starts_from_where_the_arm_is(rig: Rig) -> None:
    await rig.move(1000, joint1=0.5)
    rig.cable.drop("unplugged")
    assert not (await rig.driver.read_state()).link.connected
    rig.arm.joints[0].position = rig.arm.joints[0].target = -0.7  # moved meanwhile
    await rig.wait(20)
    sent = await rig.driver.set_joint_positions({"joint1": 0.6})
    assert sent["joint1"] == pytest.approx(0.5, abs=1e-4)
    rig.cable.plug()
    await rig.wait(100)
    assert (await rig.driver.read_state()).limp  # so the gate goes on from what is measured
    await rig.driver.stop()
    await rig.wait(200)
    assert rig.angles[0] == pytest.approx(-0.7, abs=1e-4)
    assert not (await rig.driver.read_state()).limp


async def test_a_loss_between_two_looks_is_reported_once(rig: Rig) -> None:
    rig.cable.drop("unplugged")
    rig.cable.plug()
    await rig.wait(100)
    assert not (await rig.driver.read_state()).link.connected
    assert (await rig.driver.read_state()).link.connected


@pytest.mark.parametrize(
    ("bits", "text"),
    [
        (0x01, "joint 3 has too low a voltage"),
        (0x02, "joint 3 is too hot"),
        (0x10, "joint 3 has met an obstacle"),
        (0x80, "joint 3 is stalled"),
    ],
)
async def test_a_motor_that_reports_a_fault_is_named(rig: Rig, bits: int, text: str) -> None:
    rig.arm.faults[2] = bits
    await rig.wait(100)
    assert rig.driver.problem == text
    assert not (await rig.driver.read_state()).link.connected
    before = len(rig.cable.sent)
    await rig.driver.set_joint_positions({"joint1": 0.5})
    assert len(rig.cable.sent) == before
    rig.arm.faults[2] = 0
    await rig.wait(100)
    assert rig.driver.problem == ""
    assert (await rig.driver.read_state()).link.connected


async def test_a_motor_that_switches_itself_off_is_named_and_not_switched_on_again(
    rig: Rig, caplog: pytest.LogCaptureFixture
) -> None:
    rig.arm.joints[3].on = False
    await rig.wait(100)
    assert "motor 4 has switched itself off" in caplog.text
    assert not (await rig.driver.read_state()).link.connected  # told once
    state = await rig.driver.read_state()
    assert state.link.connected
    assert state.limp
    await rig.wait(500)
    assert not rig.arm.joints[3].on
    await rig.driver.set_joint_positions({"joint1": 0.0})  # once the gate is open again
    await rig.wait(300)
    assert rig.arm.joints[3].on


async def test_a_motor_that_does_not_switch_on_is_named(rig: Rig) -> None:
    await rig.driver.limp()
    await rig.wait(100)
    rig.cable.to_arm = lambda data: None
    await rig.driver.set_joint_positions({"joint1": 0.0})
    await rig.wait(3500)
    assert rig.driver.problem == "motor 1 does not switch on: switch the arm off and on"


async def test_the_arms_own_stop_is_named_and_after_its_reset_a_person_has_to_enable(
    rig: Rig,
) -> None:
    await rig.move(1000, joint2=1.0)
    rig.arm.feed(CanFrame(piper.STOP, bytes((piper.SINK, *[0] * 7))).record())
    await rig.wait(500)
    assert rig.driver.problem.startswith("its emergency stop is active")
    assert rig.angles[1] < 0.95  # it sinks, whatever is sent
    rig.arm.feed(CanFrame(piper.STOP, bytes((piper.RESET, *[0] * 7))).record())
    await rig.wait(500)
    assert (await rig.driver.read_state()).limp
    await rig.driver.stop()
    await rig.wait(500)
    assert (await rig.driver.read_state()).limp
    await rig.driver.set_joint_positions({"joint2": 0.0})
    await rig.wait(400)
    assert not (await rig.driver.read_state()).limp


async def test_teaching_by_hand_is_left_alone(rig: Rig) -> None:
    rig.arm.status = rig.arm.status._replace(control=piper.TEACHING)
    await rig.wait(50)
    before = len(rig.cable.sent)
    await rig.driver.stop()
    await rig.driver.set_joint_positions({"joint1": 0.5})
    await rig.wait(300)
    assert len(rig.cable.sent) == before
    assert rig.driver.problem.startswith("it is being taught by hand")


async def test_a_jump_that_no_joint_can_make_is_not_believed(rig: Rig) -> None:
    jump = piper.pairs(piper.POSITIONS, (1.5, 0.0, 0.0, 0.0, 0.0, 0.0))[0]
    rig.cable.arrive(jump.record())
    state = await rig.driver.read_state()
    assert state.joints[0].position == pytest.approx(0.0, abs=1e-4)
    assert state.link.errors == 1


async def test_two_arms_on_one_bus_are_noticed(rig: Rig) -> None:
    others = piper.pairs(piper.POSITIONS, (1.5, 0.5, -1.0, 0.0, 0.0, 0.0))
    for _ in range(60):
        rig.cable.arrive(records(others))
        await rig.wait(10)
    assert "two arms on one bus" in rig.driver.problem
    assert not (await rig.driver.read_state()).link.connected


async def test_frames_of_others_and_short_ones_are_thrown_away(rig: Rig) -> None:
    rig.cable.arrive(records([CanFrame(0x123, b"12345678"), CanFrame(piper.POSITIONS, b"1234")]))
    rig.cable.arrive(b"\xff" * 16)
    rig.cable.arrive(b"123")
    state = await rig.driver.read_state()
    assert state.link.errors == 3
    assert [joint.position for joint in state.joints[:2]] == pytest.approx([0.0, 0.0], abs=1e-4)


async def test_the_emulated_arm_answers_questions_but_not_its_own_answers(rig: Rig) -> None:
    came: list[CanFrame] = []
    rig.cable.on_bytes = lambda data: came.extend(CanDecoder().feed(data))
    rig.arm.feed(CanFrame(piper.FIRMWARE, bytes((1, *[0] * 7))).record())
    assert b"S-V1.8-1" in b"".join(frame.data for frame in came)
    rig.arm.feed(CanFrame(piper.ASK_LIMITS, bytes((3, 1, *[0] * 6))).record())
    assert came[-1] == CanFrame(piper.LIMITS, bytes.fromhex("030000F95C0BB800"))
    rig.arm.feed(CanFrame(piper.ASK_LIMITS, bytes((3, 2, *[0] * 6))).record())
    assert came[-1].id == piper.MAX_ACCELERATION
    count = len(came)
    rig.arm.feed(records(came))
    assert len(came) == count


async def test_stop_and_close_can_be_had_in_any_state() -> None:
    rig = Rig()
    for call in (rig.driver.stop, rig.driver.close, rig.driver.hold):
        await call()
    await rig.driver.open()
    for call in (rig.driver.stop, rig.driver.close, rig.driver.close, rig.driver.stop):
        await call()
    assert rig.cable.sent == []
    with pytest.raises(BodyLost):
        await rig.driver.set_joint_positions({"joint1": 0.0})


def test_a_body_with_other_joints_is_refused() -> None:
    from msgspec.structs import replace

    PiperDriver.check(ROBOT, OPTIONS)
    assert ROBOT.arm
    arm = replace(ROBOT.arm, home=ROBOT.arm.home[:5])
    with pytest.raises(ValueError, match="joints: expected the six"):
        PiperDriver.check(replace(ROBOT, joints=ROBOT.joints[:5], arm=arm), OPTIONS)
