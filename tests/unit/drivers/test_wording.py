"""Frames as text for the log, each with its own bytes."""

import logging
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from gigabrain_drivers.bodies.alpha import protocol as alpha
from gigabrain_drivers.bodies.line.protocol import COMMAND, LineDecoder, Template, describe
from gigabrain_drivers.bodies.turtlebot3 import protocol as opencr
from gigabrain_drivers.lidars.ld import protocol as ld
from gigabrain_drivers.lidars.lds import lds01, lds03
from gigabrain_drivers.lidars.rplidar import protocol as rplidar
from gigabrain_drivers.links import link as links
from gigabrain_drivers.links.frames import Spelling, Wording, as_one_frame, describe_command
from gigabrain_schemas.base import Velocity
from gigabrain_zenoh.cli import driver
from gigabrain_zenoh.cli.driver import trace
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.qa.conformance import kit
from gigabrain_zenoh.qa.conformance.authoring import trace_line
from gigabrain_zenoh.testing.line import BARE, bench

LINE = Template("V,{linear_x:.3f},{angular_z|deg/s:.1f}\n", COMMAND)
FRAMES: list[tuple[Callable[[bytes], Any], Callable[[Any], str], str, str]] = [
    (
        opencr.DynamixelDecoder().feed,
        opencr.describe,
        "ff ff fd 00 c8 1d 00 03 96 00 0a 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 "
        "32 00 00 00 4d 37",
        "velocity: linear x 10 x 0.01 m/s = 0.10 m/s, angular z 50 x 0.01 rad/s = 0.50 rad/s",
    ),
    (
        opencr.DynamixelDecoder().feed,
        opencr.describe,
        "ff ff fd 00 c8 06 00 03 13 00 07 23 a7",
        "heartbeat 7",
    ),
    (
        opencr.DynamixelDecoder().feed,
        opencr.describe,
        "ff ff fd 00 c8 07 00 02 0a 00 ac 00 b6 2f",
        "read 172 bytes at 10",
    ),
    (
        opencr.DynamixelDecoder().feed,
        opencr.describe,
        "ff ff fd 00 c8 07 00 55 00 00 50 05 4c b7",
        "status: model 0x5000, firmware 5",
    ),
    (
        ld.LdDecoder().feed,
        ld.describe,
        "54 2c 68 08 ab 7e e0 00 e4 dc 00 e2 d9 00 e5 d5 00 e3 d3 00 e4 d0 00 e9 cd 00 e4 ca 00 e2 "
        "c7 00 e9 c5 00 e5 c2 00 e5 c0 00 e5 be 82 3a 1a 50",
        "12 points from 324.27 to 334.70 deg clockwise, 192 to 224 mm, 5.98 turns/s",
    ),
    (as_one_frame, lds01.describe_command, "62", "start"),
    (lds03.CommandDecoder().feed, lds03.describe_command, "aa 55 f5 0a", "stop"),
    (
        lds03.Lds03Decoder().feed,
        lds03.describe,
        "aa 55 15 02 01 05 81 05 af 57 90 a1 0f 68 c9 0f",
        "a turn begins at 1.0 Hz, 2 samples from 10.00 deg, 1000 mm to 11.00 deg, 1010 mm",
    ),
    (
        rplidar.RequestDecoder().feed,
        rplidar.describe_request,
        "a5 82 05 00 00 00 00 00 22",
        "express scan 00 00 00 00 00",
    ),
    (alpha.AlphaDecoder().feed, alpha.describe, alpha.encode_stop(7).hex(" "), "7 stop"),
    (
        LineDecoder([LINE]).feed,
        describe,
        LINE.encode({"linear_x": 0.1, "angular_z": 0.5}).hex(" "),
        "linear_x 0.1 m/s, angular_z 0.4992 rad/s",
    ),
]


@pytest.mark.parametrize(
    ("feed", "describe", "frame", "text"), FRAMES, ids=[f[3][:20] for f in FRAMES]
)
def test_a_frame_is_shown_with_its_bytes(
    feed: Callable[[bytes], Any], describe: Callable[[Any], str], frame: str, text: str
) -> None:
    spelling, data = Spelling(feed, describe), bytes.fromhex(frame)
    assert spelling.spell(data[:3]) + spelling.spell(data[3:]) == [f"{frame}  {text}"]
    assert spelling.spell(data) == [f"{frame}  {text}"]


def test_bytes_without_a_frame_are_shown() -> None:
    spelling = Spelling(opencr.DynamixelDecoder().feed, opencr.describe)
    lines = spelling.spell(bytes(600))
    assert [line[-8:] for line in lines] == ["no frame"]
    assert Wording().lines("tx", b"\x01\xff") == ["tx 01 ff"]


def test_a_command_is_reported_as_received_and_as_converted() -> None:
    asked, sent = Velocity(linear_x=0.123, angular_z=-0.456), Velocity(linear_x=0.12)
    assert describe_command(asked, sent) == (
        "command linear_x 0.1230 m/s, linear_y 0.0000 m/s, angular_z -0.4560 rad/s -> "
        "sent linear_x 0.1200 m/s, linear_y 0.0000 m/s, angular_z 0.0000 rad/s"
    )


@pytest.mark.long
async def test_a_trace_shows_both_directions_and_restores_the_log(tmp_path: Path) -> None:
    before, lines = (links.log.level, list(links.log.handlers)), list[str]()
    await trace_line(
        "mycustombot",
        "emulated",
        tmp_path,
        part="base",
        seconds=1.5,
        wanted=Velocity(linear_x=0.1),
        print_line=lines.append,
    )
    assert (
        "tx 56 2c 30 2e 31 30 30 2c 30 2e 30 30 30 0a  linear_x 0.1 m/s, angular_z 0 rad/s" in lines
    )
    assert any(line.startswith("rx 53 2c") and "battery_voltage" in line for line in lines)
    assert any(line.startswith("command linear_x 0.1000 m/s") for line in lines)
    assert (links.log.level, list(links.log.handlers)) == before


async def test_the_log_has_the_same_lines_at_debug_level(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG, links.__name__)
    async with bench(tmp_path) as line:
        await line.drive(0.1, 0.2)
    sent = f"{tmp_path}/base tx 56 2c 30 2e 32 30 30 2c 30 2e 30 30 30 0a  linear_x 0.2 m/s"
    assert any(message.startswith(sent) for message in caplog.messages)


async def test_a_real_body_is_not_moved_by_a_trace(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="not moved without its gate"):
        await trace_line(
            "mycustombot",
            "real",
            tmp_path,
            part="base",
            seconds=1.0,
            wanted=Velocity(linear_x=0.1),
            print_line=print,
        )


async def test_a_trace_returns_whether_anything_was_received(tmp_path: Path) -> None:
    text = BARE.replace("{port}", str(tmp_path / "nothing"))
    (tmp_path / "robot.yaml").write_text(text)
    name, lines = str(tmp_path / "robot.yaml"), list[str]()
    received = await trace_line(
        name, "real", tmp_path, part="base", seconds=0.1, wanted=Velocity(), print_line=lines.append
    )
    assert not received


async def test_a_trace_of_a_lidar_that_the_body_lacks_is_refused(tmp_path: Path) -> None:
    text = BARE.replace("{port}", str(tmp_path / "nothing"))
    (tmp_path / "robot.yaml").write_text(text)
    name = str(tmp_path / "robot.yaml")
    with pytest.raises(ConfigError, match="has no lidar on its own line; trace its base"):
        await trace_line(
            name, "real", tmp_path, part="scan", seconds=0.1, wanted=Velocity(), print_line=print
        )


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"seconds": math.nan}, "--seconds: expected a number above 0, got nan"),
        ({"seconds": -1.0}, "--seconds: expected a number above 0, got -1"),
        ({"seconds": 1e9}, r"--seconds: expected a number below 1e\+09, got 1e\+09"),
    ],
)
def test_a_trace_with_an_invalid_duration_is_refused(
    options: dict[str, float], complaint: str
) -> None:
    with pytest.raises(ConfigError, match=complaint):
        trace("mycustombot", **options)  # type: ignore[arg-type]


def test_the_kit_summarises_expected_warnings_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    async def check(*_: object) -> list[object]:
        for text in ("watchdog", "unplugged", "watchdog"):
            logging.getLogger("somebody.elses.driver").warning("the firmware reports: %s", text)
        return []

    monkeypatch.setattr(kit, "check", check)
    assert driver.test("mycustombot") == 0
    assert capsys.readouterr().out.splitlines()[0] == (
        "warnings during the checks: the firmware reports: watchdog (2 times); "
        "the firmware reports: unplugged"
    )
