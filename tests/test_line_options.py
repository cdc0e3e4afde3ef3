"""A body on a text line in YAML: what is wrong in it is refused with its field and its line."""

from pathlib import Path

import pytest

from gigabrain_drivers import catalog
from gigabrain_drivers.line import LineDriver
from gigabrain_drivers.line_options import LineOptions
from gigabrain_drivers.robot import Run
from gigabrain_zenoh.errors import ConfigError
from tests.line_rig import BARE

THIRD = Path(__file__).parent / "third_base" / "robot.yaml"
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
    mine = tmp_path / "robot.yaml"
    mine.write_text(BARE.replace(right, wrong))
    with pytest.raises(ConfigError, match=r"robot\.yaml" + complaint):
        catalog.make_driver(str(mine), Run(folder=tmp_path, link="real"))


@pytest.mark.parametrize(
    ("right", "wrong", "complaint"),
    [
        ("{linear_x:.3f}", "{wheel_back}", r"real\.command: no wheel_back on a differential base"),
        ("wheel_radius: 0.08\n", "", r"real\.state\[0\]: .* its wheels: none"),
    ],
)
def test_a_wheel_that_the_base_does_not_have_is_refused(
    tmp_path: Path, right: str, wrong: str, complaint: str
) -> None:
    mine = tmp_path / "robot.yaml"
    mine.write_text(BARE.replace(right, wrong))
    with pytest.raises(ConfigError, match=complaint):
        catalog.make_driver(str(mine), Run(folder=tmp_path, link="real"))


def test_a_third_base_takes_fewer_than_twenty_lines() -> None:
    assert len(THIRD.read_text().splitlines()) < 20
    robot, driver = catalog.make_driver(str(THIRD), Run(folder=THIRD.parent, link="real"))
    assert isinstance(driver, LineDriver)
    assert catalog.links_of(robot) == ["sim", "emulated", "real"]


def test_the_third_base_stands_in_the_docs_as_it_is_here() -> None:
    page = Path(__file__).parent.parent / "docs" / "firmware_line.md"
    assert THIRD.read_text() in page.read_text()


def test_the_third_base_turns_metres_into_revolutions() -> None:
    _, driver = catalog.make_driver(str(THIRD), Run(folder=THIRD.parent, link="real"))
    assert isinstance(driver, LineDriver)
    line = driver._command.template.encode({"wheel_left": 1.0, "wheel_right": -2.0})
    assert line == b"$MOT,9.5,-19.1*4E\r\n"


def test_mycustombot_says_what_the_issue_wants() -> None:
    run = Run(folder=Path(), link="real")
    robot, _, options, _ = catalog.load_link("mycustombot", run)
    assert isinstance(options, LineOptions)
    assert (options.baud, options.command) == (115200, "V,{linear_x:.3f},{angular_z:.3f}\n")
    assert options.scan is not None
    assert options.scan.driver == "ld19"
    assert (robot.wheel_separation, robot.wheel_radius) == (0.5, 0.08)


def test_the_emulated_link_is_the_real_one_on_other_ports() -> None:
    folder = Path()
    _, _, real, _ = catalog.load_link("mycustombot", Run(folder=folder, link="real"))
    run = Run(folder=folder, link="emulated", emulator="/run/ports")
    _, _, emulated, _ = catalog.load_link("mycustombot", run)
    assert isinstance(real, LineOptions)
    assert isinstance(emulated, LineOptions)
    assert emulated.scan is not None
    assert (emulated.port, emulated.scan.port) == ("/run/ports/base", "/run/ports/scan")
    assert (emulated.command, emulated.state) == (real.command, real.state)


def test_an_emulated_section_of_its_own_says_where_its_ports_are(tmp_path: Path) -> None:
    mine = tmp_path / "robot.yaml"
    text = BARE.replace("real:", "emulated:").replace('"{port}"', '"{emulator}/uart"')
    mine.write_text(text)
    run = Run(folder=tmp_path, link="emulated", emulator="/run/ports")
    _, _, options, _ = catalog.load_link(str(mine), run)
    assert isinstance(options, LineOptions)
    assert options.port == "/run/ports/uart"
