"""Settings from a deployment file, settings files and `--set`: what counts, and from where."""

import errno
import itertools
import os
import re
from pathlib import Path

import pytest

from gigabrain_zenoh.cli.app import make_app
from gigabrain_zenoh.cli.config import merged_file, rows_of, with_values
from gigabrain_zenoh.config.layers import Row
from gigabrain_zenoh.errors import ConfigError, GigabrainError, UnknownName
from gigabrain_zenoh.geometry.body_settings import split
from gigabrain_zenoh.host.run_folders import new_run_dir
from gigabrain_zenoh.launch.deployment import Deployment
from gigabrain_zenoh.launch.merging import read_rows, write_rows

FILE = """\
body: mock
world: house
decision:
  behaviour: navigate
  settings:
    max_linear_speed: 0.2
robot:
  thresholds: {stop_margin: 0.1}
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "my.yaml"
    path.write_text(FILE)
    return path


def merged(file: Path, *sets: str, files: tuple[Path, ...] = ()) -> Deployment:
    made = merged_file(str(file), files, sets)
    made.check_behaviour()
    rows_of(made)
    return made.deployment


def sources(file: Path, *sets: str, files: tuple[Path, ...] = ()) -> dict[str, tuple[object, str]]:
    rows = rows_of(merged_file(str(file), files, sets))
    return {row.key: (row.value, row.source) for row in rows}


@pytest.mark.parametrize(
    ("given", "key", "value"),
    [
        ("seed=3", "seed", 3),
        ("perception.mapping=slam", "perception.mapping", "slam"),
        ("mapping=slam", "perception.mapping", "slam"),
        ("max_linear_speed=0.1", "decision.settings.max_linear_speed", 0.1),
        ("robot.max_linear_speed=0.1", "robot.max_linear_speed", 0.1),
        ("stop_margin=0.3", "robot.thresholds.stop_margin", 0.3),
        ("robot.thresholds={side_margin: 0.05}", "robot.thresholds.side_margin", 0.05),
        ("hosts.robot=[router]", "hosts.robot", ["router"]),
        ("hosts={other: [page]}", "hosts.other", ["page"]),
        ("max_linear_deceleration=0.5", "robot.max_linear_deceleration", 0.5),
    ],
)
def test_every_key_can_be_set_by_its_name_or_its_end(
    file: Path, given: str, key: str, value: object
) -> None:
    assert sources(file, given)[key] == (value, f"--set {given}")


def test_later_settings_count_and_each_value_has_its_source(file: Path, tmp_path: Path) -> None:
    saved = tmp_path / "saved.yaml"
    saved.write_text("robot:\n  max_linear_speed: 0.1\nseed: 4\nworld: arena\n")
    found = sources(file, "seed=5", files=(saved,))
    assert found["seed"] == (5, "--set seed=5")
    assert found["world"] == ("arena", f"{saved}:4")
    assert found["robot.max_linear_speed"] == (0.1, f"{saved}:2")
    assert found["robot.thresholds.stop_margin"] == (0.1, f"{file}:8")
    assert found["decision.settings.max_linear_speed"] == (0.2, f"{file}:6")
    assert found["decision.settings.samples"] == (1000, "default")
    assert found["robot.drive_type"][1].endswith("mock/robot.yaml:3")
    assert found["link"] == ("sim", "default")
    assert merged(file, "seed=5", files=(saved,)).robot == {
        "max_linear_speed": 0.1,
        "thresholds": {"stop_margin": 0.1},
    }


@pytest.mark.parametrize(
    "given",
    [
        ("link=emulated", "speed=1"),
        ("perception.map=/maps/office.yaml", "mapping=localize"),
        ("fleet=[blue]", "namespace=red"),
    ],
)
def test_settings_that_need_one_another_may_come_in_any_order(
    file: Path, given: tuple[str, ...]
) -> None:
    file.write_text("body: mycustombot\nspeed: 2\n")
    forwards, backwards = (sources(file, *sets) for sets in (given, given[::-1]))
    assert forwards == backwards
    with pytest.raises(ConfigError, match=r"^--set link=far: link: expected one of "):
        merged(file, "link=far", "seed=2")


@pytest.mark.parametrize(
    "given", list(itertools.permutations(("link=emulated", "body=mycustombot", "stop_margin=0.3")))
)
def test_a_link_that_the_body_of_the_file_lacks_may_come_before_another_body(
    file: Path, given: tuple[str, ...]
) -> None:
    found = sources(file, *given)
    assert found["link"] == ("emulated", "--set link=emulated")
    assert found["body"] == ("mycustombot", "--set body=mycustombot")
    assert found["robot.thresholds.stop_margin"] == (0.3, "--set stop_margin=0.3")
    with pytest.raises(ConfigError, match=r"^mock has no link 'emulated'; it has: sim$"):
        sources(file, "link=emulated", "seed=2")


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        ("stop_margn=0.1", "did you mean 'robot.thresholds.stop_margin'"),
        ("robot.max_linear_sped=0.1", "did you mean 'robot.max_linear_speed'"),
        ("wrold=house", "did you mean 'world'"),
        ("nonsense=1", "lists all"),
        ("port=1", "page.port or foxglove.port"),
        ("seed", "expected KEY=VALUE"),
        ("=1", "expected KEY=VALUE"),
        ("seed=[", "not YAML"),
        ("seed=much", "--set seed=much: seed: expected a whole number"),
        ("max_linear_speed=fast", "expected a number"),
        ("stop_margin=0.02", "below the body's own need, 0.08 m"),
        ("robot.max_linear_speed=1", "above the body's own limit, 0.26 m/s"),
        ("robot.max_linear_deceleration=9", "above the body's own limit, 1 m/s2"),
        ("robot.thresholds.reaction_time=0.1", "below the body's own need, 0.22 s"),
        ("robot.thresholds.stop_margin=9", "the lidar sees no farther"),
        ("speed=2 link=emulated", "expected"),
        ("body=mok", "did you mean 'mock'"),
    ],
)
def test_a_wrong_setting_is_refused_in_one_line(file: Path, given: str, problem: str) -> None:
    with pytest.raises(GigabrainError) as refused:
        merged(file, given)
    assert problem in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_settings_file_is_refused_with_its_own_line(file: Path, tmp_path: Path) -> None:
    saved = tmp_path / "saved.yaml"
    saved.write_text("decision:\n  settings:\n    start: roam\n")
    with pytest.raises(ConfigError, match=r"saved\.yaml:3: start: expected"):
        merged(file, files=(saved,))
    saved.write_text("- seed\n")
    with pytest.raises(ConfigError, match=r"saved\.yaml:1: expected a mapping"):
        merged(file, files=(saved,))
    with pytest.raises(ConfigError, match="no such file"):
        merged(file, files=(tmp_path / "none.yaml",))


def test_settings_that_are_saved_keep_what_the_file_held(tmp_path: Path) -> None:
    path = tmp_path / "saved.yaml"
    path.write_text("seed: 3\nrobot: {max_linear_speed: 0.2}\n")
    path.write_text(with_values(path, {"robot.max_linear_speed": "0.1", "decision.x": "null"}))
    assert with_values(path, {}) == (
        "seed: 3\nrobot:\n  max_linear_speed: 0.1\ndecision:\n  x: null\n"
    )


def test_limits_are_told_apart_from_other_changes_of_a_robots_file() -> None:
    changes = {"max_linear_speed": 0.1, "thresholds": {"stop_margin": 0.2, "late": 0.1}, "x": 1}
    settings, rest = split(changes)
    assert settings == {"max_linear_speed": 0.1, "thresholds.stop_margin": 0.2}
    assert rest == {"thresholds": {"late": 0.1}, "x": 1}


def test_the_settings_of_a_run_are_read_back(file: Path, tmp_path: Path) -> None:
    rows = rows_of(merged_file(str(file), (), ()))
    write_rows(tmp_path, rows)
    assert [tuple(row) for row in read_rows(tmp_path)] == [tuple(row) for row in rows]
    with pytest.raises(ConfigError, match="cannot be read"):
        read_rows(tmp_path / "other")


def test_only_the_robot_s_user_can_read_the_settings_of_a_run(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        run_dir = new_run_dir(tmp_path, "demo")
        write_rows(run_dir, [Row("seed", 3, "default")])
    finally:
        os.umask(before)
    modes = [path.stat().st_mode & 0o777 for path in (run_dir, run_dir / "config.json")]
    assert modes == [0o700, 0o600]


CAMERA = "rtsp://admin:pass@word@cam.local:554/live?token=secret"
SECRET = "word@|token=secret"
CAMERAS = f'robot.real.cameras={{front: {{source: opencv, device: "{CAMERA}"}}}}'


def test_the_settings_of_a_run_hold_no_password_of_an_address(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file.write_text(
        "body: turtlebot3_waffle\nlink: real\n"
        f"processes: {{mine: {{module: my.node, settings: {{urls: [{{a: '{CAMERA}'}}]}}}}}}\n"
    )
    words = ("config", str(file), "--set", CAMERAS, "--set", "robot.cameras=[{name: front}]")
    make_app(words)(words, exit_on_error=False, print_error=False, result_action="return_value")
    shown = capsys.readouterr().out
    assert '"rtsp://cam.local:554"' in shown
    assert not re.search(SECRET, shown)
    rows = rows_of(merged_file(str(file), (), (words[3], words[5])))
    write_rows(tmp_path, rows)
    assert not re.search(SECRET, (tmp_path / "config.json").read_text())
    values = {row.key: row.value for row in rows}
    assert values["robot.real.cameras.front.device"] == "rtsp://cam.local:554"
    assert values["processes.mine.settings.urls"] == [{"a": "rtsp://cam.local:554"}]


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        (CAMERAS.replace("device", "devise"), "unknown field 'devise'"),
        (CAMERAS.replace("opencv", CAMERA), "no camera source 'rtsp://…@cam.local"),
        (f"robot.real.cameras={{'{CAMERA}': {{}}}}", "unknown field"),
        (f"seed={CAMERA}", "expected a whole number"),
        (f"seed: {CAMERA}", "no setting"),
        ("seed: rtsp://admin:pass@word@cam.local", "expected KEY=VALUE"),
        (f"seed=[{CAMERA}", "not YAML"),
    ],
)
def test_an_error_holds_no_password_of_an_address(file: Path, given: str, problem: str) -> None:
    file.write_text("body: turtlebot3_waffle\nlink: real\nrobot: {cameras: [{name: front}]}\n")
    with pytest.raises(GigabrainError) as refused:
        merged(file, given)
    assert problem in str(refused.value)
    assert "word@" not in str(refused.value)


def test_a_full_disk_does_not_keep_a_robot_from_starting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fsync(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", fsync)
    write_rows(tmp_path, [Row("seed", 3, "default")])
    assert caplog.messages == [f"cannot write {tmp_path / 'config.json'}: No space left on device"]
    assert list(tmp_path.iterdir()) == []


def test_config_prints_every_key_with_value_and_source(
    file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("config", str(file), "--set", "seed=7")
    make_app(words)(words, exit_on_error=False, print_error=False, result_action="return_value")
    lines = capsys.readouterr().out.splitlines()
    assert [line.split() for line in lines if line.startswith("seed ")] == [
        ["seed", "7", "--set", "seed=7"]
    ]
    assert lines == sorted(lines, key=lambda line: line.split()[0])


def test_the_behaviour_of_a_package_on_another_host_is_no_fault(tmp_path: Path) -> None:
    path = tmp_path / "my.yaml"
    path.write_text("body: mock\ndecision: {behaviour: elsewhere, settings: {x: 1}}\n")
    made = merged_file(str(path), (), ("seed=2",))
    assert {row.key for row in rows_of(made)} >= {"seed", "decision.settings.x"}
    with pytest.raises(UnknownName, match="no behaviour 'elsewhere'"):
        made.check_behaviour()
