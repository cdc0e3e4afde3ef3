"""Joint commands at the gate: acceptance, limits and refusals; and the holding of an arm."""

from typing import Any

import pytest
from msgspec.structs import replace

from gigabrain_schemas.body import JointDescription, JointGains
from gigabrain_schemas.brain import JointCommand
from gigabrain_schemas.safety import JointCap, SafetyState
from gigabrain_zenoh.gate import causes, gate
from gigabrain_zenoh.geometry.joints import JointMotion
from gigabrain_zenoh.geometry.limits import ZERO
from tests.unit.gate.rig import BLIND, BOOT, Rig

NAN = float("nan")
JOINTS = (
    JointDescription(name="lift", lower=-1.0, upper=1.0, max_speed=1.0, max_acceleration=10.0),
    JointDescription(
        name="grip", part="gripper", lower=0.0, upper=0.1, max_speed=0.1, max_acceleration=1.0
    ),
)
START = (JointMotion(0.3), JointMotion(0.05))


class ArmRig(Rig):
    """A gate of a body with two joints."""

    def __init__(self) -> None:
        super().__init__(joints=JOINTS)
        self.measured, self.limp = START, False

        self.caps: tuple[JointCap, ...] = ()
        self.silent = False  # True: safety is silent

    def arm_tick(self, count: int = 1) -> None:
        for _ in range(count):
            self.feed(gate.Tick(ZERO, joints=self.measured, limp=self.limp))
            if not self.silent:
                now = self.state.tick
                self.feed(
                    gate.Safety(SafetyState(verdict="ok", joints=self.caps, boot=BOOT, tick=now))
                )

    def aim(self, source: str = "script", **fields: Any) -> gate.Outcome:
        self.seq += 1
        now = self.state.tick
        given = {"boot": BOOT, "tick": now, "basis": now, "seq": self.seq, "name": ("lift",)}
        return self.feed(gate.JointsCommand(JointCommand(source=source, **(given | fields))))

    def follow(self, ticks: int, **fields: Any) -> None:
        """All is well: a command in every tick."""
        for _ in range(ticks):
            self.arm_tick()
            assert self.aim(**fields).refused == ""

    @property
    def positions(self) -> list[float]:
        return [joint.position for joint in self.state.joints]


def enabled() -> ArmRig:
    rig = ArmRig()
    rig.arm_tick(26)
    assert rig.feed(gate.Release(0)).ok
    assert rig.feed(gate.Enable("script")).ok
    rig.arm_tick(4)
    return rig


def test_neither_start_nor_release_nor_enable_moves_a_joint() -> None:
    rig = ArmRig()
    assert rig.state.joints == ()
    for _ in range(26):
        rig.arm_tick()
        assert rig.positions == [0.3, 0.05]
    rig.feed(gate.Release(0))
    rig.feed(gate.Enable("script"))
    rig.arm_tick(20)
    assert rig.positions == [0.3, 0.05]


def test_an_arm_that_is_held_at_the_start_is_held_on_where_it_was_sent() -> None:
    rig = ArmRig()
    for _ in range(3):
        rig.feed(gate.Tick(ZERO, joints=START, held=(0.32, 0.05)))
    assert rig.positions == [0.32, 0.05]


def test_a_sagging_arm_is_held_where_it_was_sent() -> None:
    rig = enabled()
    rig.measured = (JointMotion(0.28), JointMotion(0.05))
    rig.arm_tick(100)
    assert rig.positions == [0.3, 0.05]


def test_a_command_moves_the_named_joint_within_its_limits() -> None:
    rig = enabled()
    rig.follow(3, position=(1.0,))
    moved = rig.state.joints[0]
    assert moved.velocity == pytest.approx(0.6)
    assert rig.positions[1] == 0.05
    rig.follow(100, position=(1.0,))
    assert rig.positions == [pytest.approx(1.0), 0.05]


def test_several_commands_in_one_tick_do_not_add_up() -> None:
    rig = enabled()
    rig.arm_tick()
    for _ in range(5):
        rig.aim(position=(1.0,))
    assert rig.state.joints[0].velocity == pytest.approx(0.2)


def test_velocities_alone_are_kept_up() -> None:
    rig = enabled()
    rig.follow(10, velocity=(0.5,))
    assert rig.state.joints[0].velocity == pytest.approx(0.5)


def test_a_stream_that_ends_brakes_the_joints_within_40_ms_and_holds_them() -> None:
    rig = enabled()
    rig.follow(20, velocity=(1.0,))
    rig.arm_tick(1)
    assert rig.state.joints[0].velocity == pytest.approx(1.0)
    rig.arm_tick(5)
    held = rig.positions
    assert rig.state.joints[0].velocity == pytest.approx(0.0)
    rig.arm_tick(200)
    assert rig.positions == held
    assert rig.mode == "idle"


@pytest.mark.parametrize("known", [True, False])
def test_a_body_that_is_reached_again_moves_no_joint_from_where_it_held_it(known: bool) -> None:
    rig = enabled()
    rig.follow(20, velocity=(1.0,))
    places = (0.5, 0.06)  # after the body braked, or was moved by hand
    lost = gate.Tick(
        ZERO, joints=rig.measured, faults=(causes.LINK_LOST,), held=places if known else ()
    )
    for _ in range(30):
        rig.feed(lost)
    assert (rig.positions == list(places)) is known
    for _ in range(30):
        rig.feed(gate.Tick(ZERO, joints=rig.measured, held=places))
        assert rig.positions == list(places)


def test_a_speed_of_zero_brakes_a_joint_that_was_sent_ahead() -> None:
    rig = enabled()
    lift = replace(JOINTS[0], gains=JointGains(feed_forward=0.08))
    rig.config = replace(rig.config, joints=(lift, JOINTS[1]))
    rig.follow(30, velocity=(1.0,))  # its servo lags by 0.08 s
    at = rig.positions[0]
    rig.follow(5, velocity=(0.0,))
    assert rig.state.joints[0].velocity == pytest.approx(0.0)
    assert rig.positions[0] == pytest.approx(at + 0.016 - 0.6 * 0.08, abs=1e-4)


def test_an_estop_holds_every_joint_in_the_same_tick() -> None:
    rig = enabled()
    rig.follow(20, velocity=(1.0,))
    before = rig.state.joints_before[0].position
    rig.feed(gate.Estop("somebody"))
    assert rig.state.joints[0] == JointMotion(before)
    rig.arm_tick(50)
    assert rig.positions[0] == before


def test_a_cause_of_safety_brakes_the_joints() -> None:
    rig = enabled()
    rig.follow(20, velocity=(1.0,))
    rig.safety(BLIND, verdict="stop")
    assert rig.mode == "stopping"
    rig.arm_tick(6)
    assert rig.state.joints[0].velocity == pytest.approx(0.0)


@pytest.mark.parametrize(
    ("fields", "code"),
    [
        ({"boot": 8, "position": (0.0,)}, "boot"),
        ({"tick": 0, "position": (0.0,)}, "old"),
        ({"tick": 10_000, "position": (0.0,)}, "future"),
        ({"seq": 0, "position": (0.0,)}, "seq"),
        ({"source": "other", "position": (0.0,)}, "commander"),
        ({"name": ("wrist",), "position": (0.0,)}, "joint"),
        ({"position": (1.1,)}, "joint_limits"),
        ({"position": (-1.1,)}, "joint_limits"),
        ({"name": ("lift", "grip"), "position": (0.0, -0.1)}, "joint_limits"),
    ],
)
def test_what_must_not_move_a_joint_is_refused_by_its_reason(
    fields: dict[str, Any], code: str
) -> None:
    rig = enabled()
    rig.aim(position=(0.3,))
    assert rig.aim(**fields).refused == code
    rig.arm_tick(3)
    assert rig.positions == [pytest.approx(0.3), 0.05]


def test_the_brain_needs_a_basis() -> None:
    rig = ArmRig()
    rig.arm_tick(26)
    assert rig.aim("control", position=(0.0,), basis=0).refused == "basis"
    assert rig.aim("control", position=(0.0,)).refused == "not_enabled"


def test_a_body_without_joints_refuses_commands_for_them() -> None:
    rig = Rig()
    rig.tick(3)
    command = JointCommand(name=("lift",), position=(0.0,), boot=BOOT, tick=3, source="script")
    assert rig.feed(gate.JointsCommand(command)).refused == "no_joints"


def test_nothing_is_obeyed_before_the_joints_were_measured() -> None:
    rig = ArmRig()
    rig.tick(3)
    assert rig.aim(position=(0.0,)).refused == "joints_unknown"
    assert rig.state.joints == ()


def test_a_number_that_is_none_stops_the_arm_where_it_is() -> None:
    rig = enabled()
    rig.follow(20, velocity=(1.0,))
    assert rig.aim(position=(NAN,)).refused == "not_finite"
    assert rig.mode == "stopping"


def test_missed_ticks_in_a_burst_only_brake() -> None:
    rig = enabled()
    rig.follow(20, velocity=(0.5,))
    rig.aim(velocity=(1.0,))
    for _ in range(3):
        rig.feed(gate.Tick(ZERO, joints=rig.measured, late=True))
    assert abs(rig.state.joints[0].velocity) < 0.5


def test_a_limp_arm_is_held_where_a_person_has_moved_it() -> None:
    rig = enabled()
    rig.feed(gate.Estop("somebody"))
    rig.limp, rig.measured = True, (JointMotion(-0.7), JointMotion(0.02))
    rig.arm_tick(3)
    assert rig.positions == [-0.7, 0.02]
    rig.limp, rig.measured = False, (JointMotion(-0.72), JointMotion(0.02))
    rig.arm_tick(30)
    assert rig.positions == [-0.7, 0.02]


def test_a_release_waits_until_the_joints_rest() -> None:
    rig = ArmRig()
    rig.measured = (JointMotion(0.3, 0.5), JointMotion(0.05))
    rig.arm_tick(40)
    assert not rig.feed(gate.Release(0)).ok
    rig.measured = START
    rig.arm_tick(26)
    assert rig.feed(gate.Release(0)).ok


def test_velocities_of_the_base_do_not_live_on_while_joints_are_commanded() -> None:
    rig = enabled()
    rig.send(0.2, source="script", seq=1)
    for _ in range(30):
        rig.arm_tick()
        rig.aim(position=(0.3,))
    assert rig.state.output == ZERO
    assert rig.mode == "enabled"


@pytest.mark.parametrize("way", [1.0, -1.0])
@pytest.mark.parametrize("fields", [{"velocity": (1.0,)}, {"position": (1.0,)}])
def test_a_joint_keeps_to_its_cap_one_way_and_is_free_the_other(
    way: float, fields: dict[str, tuple[float]]
) -> None:
    there = {key: (way * value[0],) for key, value in fields.items()}
    back = {key: (-way * value[0],) for key, value in fields.items()}
    rig = enabled()
    rig.caps = (JointCap(name="lift", **({"rise": 0.1} if way > 0 else {"fall": 0.1})),)
    rig.follow(20, **there)
    assert rig.state.joints[0].velocity == pytest.approx(0.1 * way)
    rig.follow(20, **back)
    assert rig.state.joints[0].velocity * way < -0.5


def test_a_joint_that_is_faster_than_its_new_cap_brakes_at_its_acceleration() -> None:
    rig = enabled()
    rig.follow(20, velocity=(1.0,))
    rig.caps = (JointCap(name="lift", rise=0.0),)
    rig.follow(1, velocity=(1.0,))  # the verdict comes with this tick
    speeds = [rig.state.joints[0].velocity]
    for _ in range(5):
        rig.follow(1, velocity=(1.0,))
        speeds.append(rig.state.joints[0].velocity)
    assert speeds == pytest.approx([0.8, 0.6, 0.4, 0.2, 0.0, 0.0])


def test_a_cap_of_one_joint_leaves_the_others_alone() -> None:
    rig = enabled()
    rig.caps = (JointCap(name="lift", rise=0.0, fall=0.0),)
    rig.follow(10, name=("lift", "grip"), velocity=(0.5, 0.02))
    assert rig.state.joints[0] == JointMotion(0.3)
    assert rig.state.joints[1].velocity == pytest.approx(0.02)


def test_joints_do_not_move_by_a_verdict_older_than_40_ms() -> None:
    rig = enabled()
    rig.follow(20, velocity=(0.5,))
    rig.silent = True
    rig.follow(2, velocity=(0.5,))
    assert rig.state.joints[0].velocity == pytest.approx(0.5)
    rig.follow(1, velocity=(0.5,))
    assert rig.state.joints[0].velocity == pytest.approx(0.1)
    assert rig.mode == "enabled"
    rig.silent = False
    rig.follow(10, velocity=(0.5,))
    assert rig.state.joints[0].velocity == pytest.approx(0.5)
