"""A body on a text line in YAML: errors name the field and the line."""

from pathlib import Path

import pytest

from gigabrain_drivers.bodies.line.driver import LineDriver
from gigabrain_drivers.bodies.line.options import LineOptions
from gigabrain_drivers.driver import catalog
from gigabrain_drivers.driver.robot import Run
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.testing.line import BARE

THIRD = Path(__file__).parents[2] / "third_base" / "robot.yaml"
COMMAND = 'command: "V,{linear_x:.3f},{angular_z:.3f}\\n"'
STATE = '"S,{wheel_left_position|tick},{wheel_right_position|tick},{flags:02x}*{crc16}\\n"'


@pytest.mark.parametrize(
    ("right", "wrong", "complaint"),
    [
        ("{linear_x:.3f}", "{liner_x:.3f}", r":12: real\.command: no field 'liner_x'; did you"),
        ("{linear_x:.3f}", "{linear_x:3}", r":12: real\.command: \{linear_x\}: expected a format"),
        ("{linear_x:.3f}", "{linear_x|V}", r":12: real\.command: \{linear_x\}: it is a speed"),
        ("{angular_z:.3f}\\n", "{angular_z:.3f}", r":12: real\.command: expected a newline"),
        (COMMAND, "command: 'V,{linear_x}\\n'", r":12: real\.command: .*double quotes"),
        (COMMAND, 'command: "V,{seq}\\n"', r":12: real\.command: it moves nothing"),
        (COMMAND, "", r":9: real: missing field 'command'"),
        ("*{crc16}", "*{crc17}", r":13: real\.state\[0\]: no field 'crc17'; did you mean 'crc16'"),
        (f"[{STATE}]", "[]", r":13: real\.state: expected a list"),
        (
            f"[{STATE}]",
            f'\n    - {STATE}\n    - "B,{{battery_volts}}\\n"',
            r":15: real\.state\[1\]: no field 'battery_volts'; did you mean 'battery_voltage'",
        ),
        (STATE, f'{STATE}, "B,{{yaw}}\\r"', r":13: real\.state\[1\]: it must end as the first"),
        ("ticks_per_turn: 4096", "tick_bits: 32", r":13: real\.state\[0\]: .*`ticks_per_turn`"),
        ("ticks_per_turn: 4096", "ticks_per_turn: 0", r":14: real\.ticks_per_turn: expected"),
        ("{flags:02x}", "{yaw}", r":15: real\.flags: there is no \{flags\}"),
        (
            "{flags:02x}",
            "{flags:02x},{battery_voltage}",
            r":9: real: battery_empty: it is needed where only battery_voltage is reported",
        ),
        (
            "{flags:02x}",
            '{flags:02x},{battery_voltage}*{crc16}\\n"]\n  battery_empty: 12\n'
            '  battery_full: 10\n  start: "\\n"\n  stop: "\\n"\n  baud: 115200 #',
            r":15: real\.battery_full: expected more than battery_empty",
        ),
        (
            "  driver: line",
            "  driver: line\n  baud: 1200",
            r":11: real\.baud: command lines of 16 bytes at 100 Hz need 16000",
        ),
        ("  driver: line", "  driver: line\n  command_hz: 1", r":11: real\.command_hz: expected"),
        ("  driver: line", "  driver: line\n  start: GO", r":11: real\.start: expected a newline"),
        ("  driver: line", "  driver: line\n  stoop: x", r":11: .*did you mean 'stop'"),
        ('port: "{port}"', "port: usb:12345", r":11: real\.port: expected usb:VID:PID"),
    ],
)
def test_a_mistake_is_refused_with_file_line_and_field(
    tmp_path: Path, right: str, wrong: str, complaint: str
) -> None:
    assert right in BARE
    file = tmp_path / "robot.yaml"
    file.write_text(BARE.replace(right, wrong))
    with pytest.raises(ConfigError, match=r"robot\.yaml" + complaint):
        catalog.make_driver(str(file), Run(folder=tmp_path, link="real"))


@pytest.mark.parametrize(
    ("command", "complaint"),
    [
        ("{wheel_back}", r"no wheel_back on a differential base; its wheels: left, right"),
        ("{wheel_left}", r"no \{wheel_right\}; a differential base needs \{linear_x\} and"),
        ("{linear_x}", r"no \{angular_z\}"),
        ("{angular_z}", r"no \{linear_x\}"),
        ("{wheel_left},{wheel_right},{angular_z}", r"\{angular_z\} beside \{wheel_left\} and"),
        ("{linear_x:d},{angular_z}", r"\{linear_x\}: its smallest step is 1, .* does 0.4"),
        ("{linear_x},{angular_z|10deg/s:d}", r"\{angular_z\}: its smallest step is 0.175"),
        ("{wheel_left:d},{wheel_right:d}", r"\{wheel_left\}: its smallest step is 1, .* does 5"),
        ("{linear_x}{angular_z}", r"\{linear_x\} and \{angular_z\} touch"),
        ("{linear_x}0{angular_z}", r"\{linear_x\} and \{angular_z\} touch"),
    ],
)
def test_a_command_that_does_not_fit_the_body_is_refused(
    tmp_path: Path, command: str, complaint: str
) -> None:
    text = BARE.replace("{linear_x:.3f},{angular_z:.3f}", command)
    with pytest.raises(ConfigError, match=r"robot\.yaml:12: real\.command: " + complaint):
        load(tmp_path, text)


@pytest.mark.parametrize(
    "command", ["{linear_x|mm/s:d},{linear_y},{angular_z}", "{linear_x:+.2f}{angular_z:+.2f}"]
)
def test_a_command_that_fits_the_body_is_accepted(tmp_path: Path, command: str) -> None:
    load(tmp_path, BARE.replace("{linear_x:.3f},{angular_z:.3f}", command))


@pytest.mark.parametrize(
    ("state", "complaint"),
    [
        (["{battery_percentage}"], r": no field reports how the body moves; expected \{linear_x"),
        (["{linear_x}"], r": no field reports \{angular_z\}"),
        (["{wheel_left_position}", "B,{wheel_right_position}"], r"\[0\]: .*in one line"),
        (["{x},{y}", "B,{yaw}"], r"\[0\]: \{x\}, \{y\} and \{yaw\} must stand in one line"),
        (["{linear_x},{angular_z}", "{x},{y},{yaw}", "{_}"], r"\[2\]: \{_\} alone reports nothing"),
        (["{linear_x},{angular_z}", "{x},{y}"], r"\[1\]: its lines look like those of state\[0"),
        (["{linear_x}{angular_z}"], r"\[0\]: \{linear_x\} and \{angular_z\} touch"),
    ],
)
def test_a_state_without_the_bodys_motion_is_refused(
    tmp_path: Path, state: list[str], complaint: str
) -> None:
    with pytest.raises(ConfigError, match=r"robot\.yaml:13: real\.state" + complaint):
        load(tmp_path, with_state(state))


@pytest.mark.parametrize(
    "state",
    [
        ["{wheel_left_velocity},{wheel_right_velocity}"],
        ["{wheel_left_velocity}", "B,{wheel_right_velocity}"],
        ["{linear_x},{wheel_left_position},{wheel_right_position}"],
        ["{linear_x},{angular_z}", "B,{battery_percentage},{_}"],
    ],
)
def test_a_state_with_the_bodys_motion_is_accepted(tmp_path: Path, state: list[str]) -> None:
    load(tmp_path, with_state(state))


@pytest.mark.parametrize(
    ("right", "wrong", "complaint"),
    [
        ("wheel_radius: 0.08", "wheel_radius: 0", r":13: real\.state\[0\]: .* its wheel_radius at"),
        ("wheel_separation: 0.5\n", "", r":12: real\.state\[0\]: .* its wheel_separation at"),
        ("drive_type: differential", "drive_type: mecanum", r":13: .* its wheel_base at the top"),
        ("  driver: line\n", "", r":9: real: missing field 'driver'"),
        ("driver: line", "drivr: line", r":10: unknown field 'drivr'; did you mean 'driver'"),
        ("driver: line", "driver: lin", r":10: no driver 'lin'; did you mean 'line'"),
        ("driver: line", "driver: 5", r":10: real\.driver: expected a string, got 5"),
        ('port: "{port}"', 'port: ""', r":11: real\.port: expected a path"),
        ("  command:", "  scan: {driver: ld20}\n  command:", r":12: no lidar 'ld20'; did you mean"),
        ("  command:", '  scan: {driver: ld19, port: "{port}"}\n  command:', r":12: .*of the base"),
        (
            "  command:",
            "  scan: {driver: ld19, port: Auto}\n  command:",
            r":12: real\.scan\.port: ",
        ),
        (
            "  command:",
            "  scan: {driver: ld19}\n"
            "  lidar: {beams: 5000, rate_hz: 10, range_min: 0.1, range_max: 12}\n  command:",
            r":12: real\.scan: its lidar has 5000 beams, .* 450 in each",
        ),
    ],
)
def test_fields_that_do_not_fit_together_are_refused_with_file_and_line(
    tmp_path: Path, right: str, wrong: str, complaint: str
) -> None:
    assert right in BARE
    with pytest.raises(ConfigError, match=r"robot\.yaml" + complaint):
        load(tmp_path, BARE.replace(right, wrong, 1))


def load(folder: Path, text: str) -> None:
    file = folder / "robot.yaml"
    file.write_text(text)
    catalog.make_driver(str(file), Run(folder=folder, link="real"))


def with_state(lines: list[str]) -> str:
    ended = ", ".join(f'"{line}\\n"' for line in lines)
    return BARE.replace(f"[{STATE}]", f"[{ended}]").replace(
        "  flags: [watchdog, estop, bumper_left, bumper_right]\n", ""
    )


def test_a_base_of_a_third_party_needs_fewer_than_twenty_lines() -> None:
    assert len(THIRD.read_text().splitlines()) < 20
    robot, driver = catalog.make_driver(str(THIRD), Run(folder=THIRD.parent, link="real"))
    assert isinstance(driver, LineDriver)
    assert catalog.robot_links(robot) == ["sim", "emulated", "real"]


def test_the_base_of_a_third_party_is_in_the_docs() -> None:
    page = Path(__file__).parents[3] / "docs" / "reference" / "firmware_line.md"
    assert THIRD.read_text() in page.read_text()


def test_the_base_of_a_third_party_is_commanded_in_revolutions() -> None:
    _, driver = catalog.make_driver(str(THIRD), Run(folder=THIRD.parent, link="real"))
    assert isinstance(driver, LineDriver)
    line = driver._command.template.encode({"wheel_left": 1.0, "wheel_right": -2.0})
    assert line == b"$MOT,9.5,-19.1*4E\r\n"


def test_mycustombot_has_these_options() -> None:
    run = Run(folder=Path(), link="real")
    robot, _, options, _ = catalog.load_link("mycustombot", run)
    assert isinstance(options, LineOptions)
    assert (options.baud, options.command) == (115200, "V,{linear_x:.3f},{angular_z:.3f}\n")
    assert options.scan is not None
    assert options.scan.driver == "ld19"
    assert (robot.wheel_separation, robot.wheel_radius) == (0.5, 0.08)


def test_the_emulated_link_is_the_real_link_on_other_ports() -> None:
    folder = Path()
    _, _, real, _ = catalog.load_link("mycustombot", Run(folder=folder, link="real"))
    run = Run(folder=folder, link="emulated", emulator="/run/ports")
    _, _, emulated, _ = catalog.load_link("mycustombot", run)
    assert isinstance(real, LineOptions)
    assert isinstance(emulated, LineOptions)
    assert emulated.scan is not None
    assert (emulated.port, emulated.scan.port) == ("/run/ports/base", "/run/ports/scan")
    assert (emulated.command, emulated.state) == (real.command, real.state)


def test_an_emulated_section_may_name_its_ports(tmp_path: Path) -> None:
    file = tmp_path / "robot.yaml"
    text = BARE.replace("real:", "emulated:").replace('"{port}"', '"{emulator}/uart"')
    file.write_text(text)
    run = Run(folder=tmp_path, link="emulated", emulator="/run/ports")
    _, _, options, _ = catalog.load_link(str(file), run)
    assert isinstance(options, LineOptions)
    assert options.port == "/run/ports/uart"
