"""Robot states from a body's lines: pose, velocity, battery, wheels, restarts and losses."""

import math
from pathlib import Path

import pytest
from msgspec.structs import replace

from gigabrain_drivers.bodies.line.conversion import LineReport
from gigabrain_drivers.bodies.line.driver import LineDriver
from gigabrain_drivers.bodies.line.options import LineOptions
from gigabrain_drivers.driver import catalog
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.kinematics.wheels import Ackermann, Twist, wheels_of
from gigabrain_schemas.body import Battery, RobotState
from gigabrain_zenoh.clock import FakeClock

MS = 1_000_000
ROBOT, _, OPTIONS, _ = catalog.load_link("mycustombot", Run(folder=Path(), link="real"))
assert isinstance(OPTIONS, LineOptions)
TICK = math.tau / 4096
TWO_LINES = LineOptions(
    driver="line",
    port="/dev/null",
    command="V,{linear_x},{angular_z}\n",
    state=(
        "S,{wheel_left_position},{wheel_right_position}\n",
        "B,{battery_voltage},{battery_percentage},{wheel_left_temperature}\n",
    ),
)


def make_report(options: LineOptions = OPTIONS) -> LineReport:
    return LineReport(options, ROBOT, wheels_of(ROBOT))


def wheels(left: float, right: float) -> dict[str, float]:
    return {"wheel_left_position": left, "wheel_right_position": right}


def test_wheels_that_turn_alike_move_the_body_straight() -> None:
    report = make_report()
    report.update(wheels(1.0, 1.0), 20 * MS)
    for n in range(1, 11):
        report.update(wheels(1.0 + 0.05 * n, 1.0 + 0.05 * n), (20 + 20 * n) * MS)
    assert (report.pose.x, report.pose.y, report.pose.yaw) == pytest.approx((0.04, 0.0, 0.0))
    assert report.velocity().linear_x == pytest.approx(0.2)
    assert report.joints(0)[0].position == pytest.approx(0.5)


def test_counters_may_wrap() -> None:
    report = make_report(replace(OPTIONS, tick_bits=16))
    report.update(wheels(32760 * TICK, 32760 * TICK), 20 * MS)
    report.update(wheels(-32760 * TICK, -32760 * TICK), 40 * MS)
    assert report.pose.x == pytest.approx(16 * TICK * 0.08)


def test_a_jump_of_the_counters_is_no_motion() -> None:
    report = make_report()
    report.update(wheels(10.0, 10.0), 20 * MS)
    report.update(wheels(0.0, 0.0), 40 * MS)
    report.update(wheels(0.05, 0.05), 60 * MS)
    assert report.pose.x == pytest.approx(0.004)


@pytest.mark.parametrize("delayed_lines", [1, 4, 10])
def test_lines_that_arrive_together_count_as_lines_in_time(delayed_lines: int) -> None:
    report, turn = make_report(replace(OPTIONS, state_hz=20.0)), ROBOT.max_angular_speed
    base = wheels_of(ROBOT)
    assert base
    left, right = base.to_wheels(Twist(0.0, 0.0, turn))
    for n in range(41):  # `delayed_lines` lines from line 10 on arrive in one read
        read = 10 + delayed_lines if 10 <= n < 10 + delayed_lines else n
        report.update(wheels(0.05 * n * left, 0.05 * n * right), (20 + 50 * read) * MS)
    assert report.pose.yaw == pytest.approx(math.remainder(2.0 * turn, math.tau))


def test_a_jump_of_the_counters_is_no_motion_in_lines_that_arrive_together() -> None:
    report = make_report()
    report.update(wheels(0.0, 0.0), 20 * MS)
    for angle in (0.05, 0.1, 10.0, 0.15, 0.2):  # after 0.1 s; one number is wrong
        report.update(wheels(angle, angle), 120 * MS)
    assert report.pose.x == pytest.approx(0.15 * 0.08)
    report.update(wheels(0.2, 0.2), 220 * MS)
    report.update(wheels(2.0, 2.0), 240 * MS)  # not delayed: too fast for 20 ms
    assert report.pose.x == pytest.approx(0.15 * 0.08)


def test_after_a_gap_the_shorter_motion_is_used() -> None:
    rolled, restarted = make_report(), make_report()
    for report in (rolled, restarted):
        report.update(wheels(5.0, 5.0), 20 * MS)
    rolled.update(wheels(5.5, 5.5), 320 * MS)
    restarted.update(wheels(0.1, 0.1), 320 * MS)
    assert rolled.pose.x == pytest.approx(0.04)
    assert restarted.pose.x == pytest.approx(0.008)


def test_the_pose_follows_the_firmwares_pose_from_its_first_value() -> None:
    report = make_report()
    report.update({"x": 5.0, "y": 1.0, "yaw": math.pi / 2}, 20 * MS)
    report.update({"x": 5.0, "y": 1.01, "yaw": math.pi / 2}, 40 * MS)
    assert (report.pose.x, report.pose.y) == pytest.approx((0.01, 0.0))
    report.update({"x": 0.0, "y": 0.0, "yaw": 0.0}, 500 * MS)  # restarted
    assert (report.pose.x, report.pose.y) == pytest.approx((0.01, 0.0))


def test_a_reported_velocity_is_integrated_without_positions() -> None:
    report = make_report()
    for n in range(1, 52):
        report.update({"linear_x": 0.1, "angular_z": 0.0}, 20 * n * MS)
    assert report.pose.x == pytest.approx(0.1)
    assert report.velocity().linear_x == 0.1


def test_the_velocity_follows_from_wheel_speeds() -> None:
    report = make_report()
    report.update({"wheel_left_velocity": 1.0, "wheel_right_velocity": 2.0}, 20 * MS)
    assert report.velocity().linear_x == pytest.approx(0.12)
    assert report.velocity().angular_z == pytest.approx(0.16)


def test_wheel_speeds_are_integrated_without_positions() -> None:
    report = make_report()
    for n in range(1, 52):
        report.update({"wheel_left_velocity": 1.0, "wheel_right_velocity": 2.0}, 20 * n * MS)
    assert report.pose.yaw == pytest.approx(0.16)
    assert report.pose.x == pytest.approx(0.75 * math.sin(0.16), abs=1e-4)  # radius 0.12 / 0.16 m
    assert report.joints(0)[1].position == pytest.approx(2.0)


def test_wheel_speeds_may_be_in_different_lines() -> None:
    report = make_report()
    for n in range(1, 52):
        report.update({"wheel_left_velocity": 1.0}, (20 * n - 10) * MS)
        report.update({"wheel_right_velocity": 1.0}, 20 * n * MS)
    assert (report.pose.x, report.pose.yaw) == pytest.approx((0.08, 0.0), abs=0.001)


def test_each_part_of_the_velocity_has_its_own_source() -> None:
    report = make_report()
    for n in range(11):
        report.update({"linear_x": 0.25, **wheels(0.0, 0.05 * n)}, (20 + 20 * n) * MS)
    assert report.velocity().linear_x == 0.25
    assert report.velocity().angular_z == pytest.approx(0.4)  # 2.5 rad/s * 0.08 / 0.5


@pytest.mark.parametrize(
    ("volts", "percent"), [(9.9, 0), (11.25, 50), (12.6, 100), (14, 100), (5, 0)]
)
def test_the_percentage_of_the_battery_follows_from_its_voltage(
    volts: float, percent: float
) -> None:
    report = make_report()
    assert report.battery(0) is None
    report.update({"battery_voltage": volts}, 20 * MS)
    battery = report.battery(20 * MS)
    assert battery is not None
    assert (battery.voltage, battery.percentage) == pytest.approx((volts, percent))


def test_wheels_have_their_temperatures() -> None:
    report = make_report()
    report.update({"wheel_left_temperature": 31.5, "wheel_right_temperature": 30.0}, 20 * MS)
    assert [(j.name, j.temperature) for j in report.joints(20 * MS)] == [
        ("wheel_left_joint", 31.5),
        ("wheel_right_joint", 30.0),
    ]


def test_the_odometry_of_a_car_uses_its_steering_angle() -> None:
    robot = replace(
        ROBOT, drive_type="ackermann", wheel_base=0.5, max_linear_speed=2.0, max_angular_speed=2.0
    )
    base = wheels_of(robot)
    assert isinstance(base, Ackermann)
    report = LineReport(OPTIONS, robot, base)
    drive, steering = base.to_wheels(Twist(1.0, 0.0, 0.5))
    for n in range(51):
        line = {"wheel_drive_position": drive * 0.02 * n, "wheel_steering_position": steering}
        report.update(line, 20 * (n + 1) * MS)
    assert report.pose.yaw == pytest.approx(0.5)
    assert report.pose.x == pytest.approx(2.0 * math.sin(0.5), abs=1e-4)
    assert report.joints(0)[1].position == pytest.approx(steering)


async def test_a_battery_and_temperatures_expire_without_new_values() -> None:
    clock = FakeClock()
    driver = LineDriver(ROBOT, TWO_LINES, Run(folder=Path(), link="real"), clock=clock)
    odometry, power = TWO_LINES.state_templates()
    values = {"battery_voltage": 12.0, "battery_percentage": 80.0, "wheel_left_temperature": 31.0}

    async def pass_seconds(seconds: int, *, powered: bool) -> RobotState:
        for _ in range(50 * seconds):
            driver.link.on_bytes(odometry.encode(wheels(0.0, 0.0)))
            if powered:
                driver.link.on_bytes(power.encode(values))
            await clock.advance(20 * MS)
        return await driver.read_state()

    before = await pass_seconds(1, powered=True)
    assert before.battery == Battery(voltage=12.0, percentage=80.0)
    assert [joint.temperature for joint in before.joints] == [31.0, None]
    after = await pass_seconds(3, powered=False)
    assert after.battery is None
    assert [joint.temperature for joint in after.joints] == [None, None]


@pytest.mark.parametrize(
    ("lines", "needed"),
    [
        (("A,{wheel_left_velocity}\n", "B,{wheel_right_velocity}\n"), (0, 1)),
        (("A,{linear_x}\n", "B,{angular_z}\n"), (0, 1)),
        (("A,{linear_x},{angular_z}\n", "B,{x},{y},{yaw}\n"), (0,)),
        (("A,{linear_x}\n", "B,{x},{y},{yaw}\n"), (0, 1)),
        (("A,{wheel_left_position},{wheel_right_position}\n", "B,{wheel_left_velocity}\n"), (0,)),
        (("A,{linear_x},{angular_z}\n", "B,{battery_percentage}\n"), (0,)),
    ],
)
async def test_a_body_is_lost_without_a_line_that_has_its_velocity(
    lines: tuple[str, ...], needed: tuple[int, ...]
) -> None:
    clock = FakeClock()
    options = replace(TWO_LINES, state=lines)
    driver = LineDriver(ROBOT, options, Run(folder=Path(), link="real"), clock=clock)
    templates = options.state_templates()

    async def connected_without(missing: int | None) -> bool:
        for _ in range(10):
            for place, template in enumerate(templates):
                if place != missing:
                    driver.link.on_bytes(template.encode({}))
            await clock.advance(20 * MS)
        return (await driver.read_state()).link.connected

    assert await connected_without(None)
    for place in range(len(lines)):
        assert await connected_without(place) is (place not in needed)
        assert await connected_without(None)


@pytest.mark.parametrize("every", [5, 8])  # slow lines come after so many quick ones, 20 ms each
async def test_a_body_is_connected_although_one_line_of_its_velocity_is_slower(every: int) -> None:
    clock = FakeClock()
    options = replace(TWO_LINES, state=("V,{linear_x}\n", "G,{angular_z}\n"))
    driver = LineDriver(ROBOT, options, Run(folder=Path(), link="real"), clock=clock)
    quick, slow = options.state_templates()
    connected = list[bool]()
    for n in range(300):
        driver.link.on_bytes(quick.encode({}))
        if n % every == 0 and n < 200:
            driver.link.on_bytes(slow.encode({}))
        await clock.advance(20 * MS)
        connected.append((await driver.read_state()).link.connected)
    assert all(connected[:200])
    assert not any(connected[240:])


FLAGGED = replace(TWO_LINES, state=(TWO_LINES.state[0], "F,{flags}\n"), flags=("estop", "bumper"))


@pytest.mark.parametrize(
    ("period", "lost"),
    [(1, True), (25, True), (None, False)],  # in motion lines; None: flags are sent on changes only
)
async def test_a_body_is_lost_without_flags_that_it_repeated(
    period: int | None, lost: bool, caplog: pytest.LogCaptureFixture
) -> None:
    clock = FakeClock()
    driver = LineDriver(ROBOT, FLAGGED, Run(folder=Path(), link="real"), clock=clock)
    motion, flags = FLAGGED.state_templates()

    async def state_after(lines: int, *changes: float, every: int | None = None) -> RobotState:
        for value in changes:
            driver.link.on_bytes(flags.encode({"flags": value}))
        for n in range(lines):
            driver.link.on_bytes(motion.encode(wheels(0.0, 0.0)))
            if every and n % every == 0:
                driver.link.on_bytes(flags.encode({"flags": 0.0}))
            await clock.advance(20 * MS)
            state = await driver.read_state()
        return state

    assert (await state_after(500, 2.0, 0.0, 2.0, 0.0, every=period)).link.connected
    assert (await state_after(100)).link.connected is not lost
    assert ("flags no longer arrive" in caplog.text) is lost
    back = await state_after(1, 2.0)
    assert back.link.connected
    assert back.bumpers == (True,)


def test_an_expired_percentage_is_not_an_empty_battery() -> None:
    report = make_report(TWO_LINES)
    for n in range(50):
        report.update({"battery_percentage": 80.0}, 20 * n * MS)
    report.update({"battery_voltage": 12.0}, 4000 * MS)
    assert report.battery(4000 * MS) is None
