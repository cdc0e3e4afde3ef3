"""Wheels on the bus of an arm: LeKiwi's base by its driver, on an emulated bus in memory."""

import math
from pathlib import Path

import pytest

from gigabrain_drivers.bodies.feetech import protocol as feetech
from gigabrain_drivers.bodies.feetech.driver import FeetechDriver, FeetechOptions
from gigabrain_drivers.bodies.feetech.protocol import RADIANS_PER_TICK
from gigabrain_drivers.driver.catalog import load_link
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.kinematics.wheels import Twist, wheels_of
from gigabrain_drivers.sim.locomotion import Motor
from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import RobotState
from gigabrain_zenoh.errors import BodyLost, ConfigError
from tests.unit.drivers.feetech import FreeArm, Rig, opened

ROBOT, _, _OPTIONS, FOLDER = load_link("lekiwi", Run(folder=Path(), link="emulated", emulator="m"))
assert isinstance(_OPTIONS, FeetechOptions)
OPTIONS: FeetechOptions = _OPTIONS
BASE = wheels_of(ROBOT)
assert BASE
WHEELS = {"left": 7, "back": 8, "right": 9}


class Rolling(FreeArm):
    """LeKiwi's arm, and wheels that turn at once as the base is commanded, without slip."""

    def __init__(self) -> None:
        super().__init__(ROBOT, FOLDER)
        self.commanded = (0.0, 0.0, 0.0)
        self.angles = dict.fromkeys(WHEELS, 0.0)  # [rad]

    def command(self, linear_x: float, linear_y: float, angular_z: float) -> None:
        self.commanded = (linear_x, linear_y, angular_z)

    @property
    def speeds(self) -> dict[str, float]:
        assert BASE
        return dict(zip(BASE.wheels, BASE.to_wheels(Twist(*self.commanded)), strict=True))

    @property
    def wheels(self) -> list[Motor]:
        return [
            Motor(f"wheel_{name}_joint", self.angles[name], speed, 0.0, 25.0)
            for name, speed in self.speeds.items()
        ]

    def step(self, seconds: float) -> None:
        super().step(seconds)
        for name, speed in self.speeds.items():
            self.angles[name] += speed * seconds


class LeKiwi(Rig):
    """Driver, line and robot on one clock that the test moves."""

    def __init__(self, options: FeetechOptions = OPTIONS) -> None:
        self.rolling = Rolling()
        super().__init__(robot=ROBOT, folder=FOLDER, options=options, body=self.rolling)

    def wheel(self, name: str) -> feetech.ServoReadings:
        return feetech.decode_readings(self.arm.wheels[name].read(feetech.FIRST, feetech.LENGTH))

    async def drive(self, milliseconds: int, x: float, y: float, turn: float) -> Velocity:
        """Command as the driver's process does, every 20 ms."""
        sent = Velocity()
        for _ in range(milliseconds // 20):
            await self.driver.read_state()
            sent = await self.during(self.driver.set_base_velocity(x, y, turn))
            await self.wait(20)
        return sent

    async def state(self) -> RobotState:
        return await self.driver.read_state()


async def test_wheels_turn_in_velocity_mode_as_lerobot_turns_them() -> None:
    rig = LeKiwi()
    async with opened(rig):
        sent = await rig.drive(500, 0.1, 0.05, 0.3)
        goals = {name: rig.wheel(name).goal_velocity for name in WHEELS}
        modes = {name: servo[feetech.MODE] for name, servo in rig.arm.wheels.items()}
    expected = {}
    for name, degrees in (("left", 240.0), ("back", 0.0), ("right", 120.0)):
        angle = math.radians(degrees - 90.0)
        speed = (math.cos(angle) * 0.1 + math.sin(angle) * 0.05 + 0.125 * 0.3) / 0.05
        expected[name] = round(math.degrees(speed) * 4096 / 360)
    assert goals == expected
    assert set(modes.values()) == {1}
    assert (sent.linear_x, sent.linear_y, sent.angular_z) == pytest.approx((0.1, 0.05, 0.3), 0.01)


def test_speeds_are_written_as_the_makers_sdk_does() -> None:
    goals = {7: 500, 8: -300, 9: 0}
    words = {servo: feetech.GOAL_VELOCITY.encode(goal) for servo, goal in goals.items()}
    made = feetech.sync_write(feetech.GOAL_VELOCITY.address, words)
    assert made.hex(" ") == "ff ff fe 0d 83 2e 02 07 f4 01 08 2c 81 09 00 00 87"


async def test_nothing_is_written_to_the_memory_of_a_wheels_servo() -> None:
    rig = LeKiwi()
    before = {name: servo.kept for name, servo in rig.arm.wheels.items()}
    async with opened(rig):
        await rig.drive(200, 0.1, 0.0, 0.0)
    assert {name: servo.kept for name, servo in rig.arm.wheels.items()} == before


@pytest.mark.long
@pytest.mark.parametrize(
    "twist", [(0.2, 0.0, 0.0), (0.0, 0.15, 0.0), (0.0, 0.0, -1.0), (0.1, -0.05, 0.4)]
)
async def test_the_pose_is_how_the_wheels_have_turned(twist: tuple[float, float, float]) -> None:
    rig = LeKiwi()
    async with opened(rig):
        await rig.drive(2000, *twist)
        moving = await rig.state()
        await rig.drive(200, 0.0, 0.0, 0.0)
        at_rest = await rig.state()
    measured = moving.velocity
    assert (measured.linear_x, measured.linear_y, measured.angular_z) == pytest.approx(
        twist, abs=0.01
    )
    x, y, turn = twist
    assert at_rest.pose.yaw == pytest.approx(2 * turn, abs=0.06)
    assert math.hypot(at_rest.pose.x, at_rest.pose.y) == pytest.approx(
        2 * math.hypot(x, y), abs=0.02
    )
    assert at_rest.velocity == Velocity()
    assert [joint.name for joint in at_rest.joints][:3] == [f"wheel_{n}_joint" for n in WHEELS]


async def test_speeds_that_are_too_much_at_once_become_slower_on_the_same_curve() -> None:
    rig = LeKiwi()
    async with opened(rig):
        sent = await rig.drive(100, 0.2, 0.0, 1.0)
        fastest = max(abs(rig.wheel(name).goal_velocity) for name in WHEELS)
    assert fastest <= 3000
    assert sent.linear_x < 0.17
    assert sent.angular_z / sent.linear_x == pytest.approx(5.0, rel=0.01)


@pytest.mark.parametrize("end", ["stop", "hold", "limp", "close"])
async def test_wheels_stand_after(end: str) -> None:
    rig = LeKiwi()
    async with opened(rig):
        await rig.drive(300, 0.2, 0.0, 0.0)
        assert rig.rolling.commanded[0] > 0.1
        await rig.during(rig.driver.stop() if end == "limp" else getattr(rig.driver, end)())
        if end == "limp":
            await rig.during(rig.driver.limp())
        await rig.wait(200)
        assert rig.rolling.commanded == (0.0, 0.0, 0.0)


async def test_wheels_stand_after_a_close_whose_first_bytes_get_lost() -> None:
    rig, left = LeKiwi(), 200  # a servo waits for so many where the length of a frame was hit

    def swallow(data: bytes) -> bytes:
        nonlocal left
        taken = min(left, len(data))
        left -= taken
        return data[taken:]

    async with opened(rig):
        await rig.drive(500, 0.1, 0.0, 0.0)
        rig.link.disturb_sent = swallow
    await rig.wait(200)
    assert rig.rolling.commanded == (0.0, 0.0, 0.0)


async def test_what_is_no_number_stops_all_wheels() -> None:
    rig = LeKiwi()
    async with opened(rig):
        await rig.drive(300, 0.2, 0.0, 0.0)
        sent = await rig.drive(300, math.nan, 0.0, 0.0)
        assert sent == Velocity()
        assert rig.rolling.commanded == (0.0, 0.0, 0.0)


async def test_wheels_turn_on_while_the_line_is_cut_and_stop_once_it_is_back() -> None:
    """The servos have no watchdog: this is what the documents warn of."""
    rig = LeKiwi()
    async with opened(rig):
        await rig.drive(300, 0.2, 0.0, 0.0)
        rig.link.drop("the cable was pulled out")
        await rig.wait(3000)
        assert rig.rolling.commanded[0] == pytest.approx(0.2, abs=0.01)
        rig.link.open()
        await rig.wait(1000)
        assert rig.rolling.commanded == (0.0, 0.0, 0.0)


async def test_a_wheel_that_answers_no_more_stops_the_others() -> None:
    rig = LeKiwi()
    async with opened(rig):
        await rig.drive(300, 0.2, 0.0, 0.0)
        rig.arm.bus.servos.remove(rig.arm.wheels["back"])
        await rig.drive(300, 0.2, 0.0, 0.0)
        assert (
            rig.driver.problem
            == "servo 8 (wheel back) no longer answers: check its cable and power"
        )
        assert rig.rolling.speeds["left"] == pytest.approx(0.0, abs=0.01)
        assert not (await rig.state()).link.connected


async def test_a_wheels_servo_that_starts_again_ends_the_driver() -> None:
    rig = LeKiwi()
    async with opened(rig):
        await rig.drive(300, 0.2, 0.0, 0.0)
        rig.arm.wheels["left"].power_on()
        with pytest.raises(BodyLost, match=r"servo 7 \(wheel left\) had switched itself off"):
            await rig.drive(300, 0.2, 0.0, 0.0)


async def test_a_reading_that_no_motion_explains_moves_no_pose() -> None:
    rig = LeKiwi()
    async with opened(rig):
        await rig.wait(100)
        rig.rolling.angles["left"] += 500 * RADIANS_PER_TICK
        await rig.wait(20)
        state = await rig.state()
    assert (state.pose.x, state.pose.y, state.pose.yaw) == (0.0, 0.0, 0.0)
    assert state.link.errors > 0


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"wheels": {"left": 7, "back": 8}}, "wheels: left, back; expected left, back, right"),
        ({"wheels": {}}, "wheels: none; expected left, back, right for omni"),
        ({"wheels": {"left": 7, "back": 7, "right": 9}}, "servos: each needs an id of its own"),
        ({"wheels": {"left": 1, "back": 8, "right": 9}}, "servos: each needs an id of its own"),
        ({"inverted": ("front",)}, "inverted: no joint 'front'"),
    ],
)
def test_wheels_that_are_not_those_of_the_base_are_refused(
    changes: dict[str, object], problem: str
) -> None:
    fields = {name: getattr(OPTIONS, name) for name in OPTIONS.__struct_fields__}
    with pytest.raises(ValueError, match=problem):
        FeetechDriver.check(ROBOT, FeetechOptions(**{**fields, "scan": None, **changes}))  # type: ignore[arg-type]


def test_a_base_without_an_arm_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "robot.yaml"
    file.write_text(
        "summary: two servo wheels\n"
        "robot_type: rover\n"
        "drive_type: differential\n"
        "wheel_radius: 0.05\n"
        "wheel_separation: 0.2\n"
        "max_linear_speed: 0.2\n"
        "max_angular_speed: 1.0\n"
        "footprint: [[0.1, 0.1], [-0.1, 0.1], [-0.1, -0.1], [0.1, -0.1]]\n"
        "real:\n"
        "  driver: feetech\n"
        "  wheels: {left: 7, right: 8}\n"
        "  servos: {}\n"
    )
    with pytest.raises(ConfigError, match=r"robot\.yaml:12: real\.servos: this body has no joints"):
        load_link(str(file), Run(folder=Path(), link="real"))


async def test_servos_of_another_variant_are_refused() -> None:
    rig = LeKiwi()
    rig.arm.wheels["right"].keep(feetech.MAX_VOLTAGE, 140)
    with pytest.raises(ConfigError, match=r"servo 9 \(wheel right\) takes up to 14 V"):
        await rig.during(rig.driver.open())


async def test_a_wheel_that_has_protected_itself_stands_as_it_is_switched_on_again() -> None:
    rig = LeKiwi()
    async with opened(rig):
        await rig.drive(500, 0.1, 0.0, 0.0)
        servo, goals = rig.arm.wheels["left"], list[int]()
        assert servo[feetech.GOAL_VELOCITY]
        write = servo.write

        def recorded(address: int, data: bytes) -> None:
            write(address, data)
            if (address, data) == (feetech.TORQUE.address, b"\1"):
                goals.append(servo[feetech.GOAL_VELOCITY])

        servo.write = recorded  # type: ignore[method-assign]
        servo._latched = True  # something blocks it
        await rig.drive(500, 0.1, 0.0, 0.0)
        assert goals == [0]
        assert (await rig.state()).link.connected


@pytest.mark.parametrize("stuck", ["left", "arm_shoulder_pan"])
async def test_a_servo_that_stays_overloaded_keeps_no_other_from_giving_way(stuck: str) -> None:
    rig = LeKiwi()
    async with opened(rig):
        lift = rig.servo("arm_shoulder_lift")
        rig.joint("arm_shoulder_lift").load = 0.3
        await rig.wait(1000)
        lift._latched = True
        its = {**rig.arm.wheels, **rig.arm.servos}[stuck]
        its._status = lambda: feetech.OVERLOAD  # type: ignore[method-assign]
        await rig.wait(1500)
        assert lift[feetech.STATUS] == 0
        assert "protects itself: overload" in rig.driver.problem


async def test_a_memory_that_was_read_wrongly_once_is_not_another_robot_s() -> None:
    rig, hit = LeKiwi(), set[int]()

    def disturb(data: bytes) -> bytes:
        wrong = bytearray(data)
        if len(data) == feetech.EEPROM_SIZE + 6 and data[2] not in hit:
            hit.add(data[2])
            for first in (5 + feetech.MAX_VOLTAGE.address, 5 + feetech.OFFSET.address):
                wrong[first], wrong[first + 1] = data[first] ^ 0xFF, data[first + 1] ^ 0xFF
            wrong[-1] = feetech.checksum(bytes(wrong[2:-1]))
        return bytes(wrong)

    rig.link.disturb = disturb
    async with opened(rig):
        assert hit == {1, 2, 3, 4, 5, 6, 7, 8, 9}
        assert rig.driver.problem == ""
