"""Errors between the fields of a deployment file, reported with the line of the wrong field."""

from pathlib import Path

import pytest

from gigabrain_schemas.body import Thresholds
from gigabrain_zenoh.cli.demo import up
from gigabrain_zenoh.cli.processes import button
from gigabrain_zenoh.config import loading as config
from gigabrain_zenoh.config.layers import assignment
from gigabrain_zenoh.config.settings import ButtonConfig
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.launch.deployment import (
    Deployment,
    deployment_folder,
    deployment_path,
    deployment_type,
    host_of,
)

PORT = "expected a path, or usb:VID:PID[:SERIAL], got"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "body: mock\n\nlink: sim\n\nrouter: tcp/0.0.0.0:7447",
            "f:5: router: tcp/0.0.0.0:7447 can",
        ),
        (
            "body: mock\nrouter: tcp/127.0.0.1:99999",
            "f:2: router: 'tcp/127.0.0.1:99999' is not a Zenoh endpoint; expected one like tcp/1",
        ),
        ("body: mock\nrouter: localhost", "f:2: router: 'localhost' is not a Zenoh endpoint"),
        (
            "hosts:\n  a: [router]\n  b: [driver]\nrouter: tcp/127.0.0.1:0",
            "f:4: router: tcp/127.0.0.1:0: several hosts need a fixed port; replace 0",
        ),
        (
            "body: mock\nhosts:\n  a: [driver]\n  b: [driver]",
            "f:2: hosts: driver repeated; list each once",
        ),
        (
            "recorder:\n  topics: [scan, robot/sc*an]",
            "f:2: recorder.topics: expected a key expression, got 'robot/sc*an': names joined",
        ),
        ("recorder:\n  topics: [scam]", "f:2: recorder.topics: no topic 'scam'; did you mean"),
        (
            "hosts:\n  robot: [router]\n  brain: []",
            "f:3: hosts.brain: no process; name at least one, or remove the host",
        ),
        ("body: mock\nnamespace: /red", "f:2: namespace: expected a name such as red, or names j"),
        ("namespace: a//b", "f:1: namespace: expected a name such as red, or names joined by '/'"),
        ("namespace: ../red", "f:1: namespace: expected a name such as red, or names joined by"),
        ("namespace: red*", "f:1: namespace: expected a name such as red, or names joined by '/'"),
        ("link: emulated\nspeed: 2", "f:2: speed: works in simulation only"),
        ("body: mock\nbutton:\n  port: ''", f"f:3: button.port: {PORT} ''"),
        ("body: mock\nbutton:\n  port: usb:xyz", f"f:3: button.port: {PORT} 'usb:xyz'"),
    ],
)
def test_a_deployment_is_refused_at_the_line_that_is_wrong(text: str, said: str) -> None:
    with pytest.raises(ConfigError) as error:
        config.loads(text, deployment_type(), "f")
    assert str(error.value).startswith(said)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "scan_age: 0.3\nbattery_warn: 5",
            "f:2: battery_stop, battery_return and battery_warn must ascend",
        ),
        ("scan_age: 0.3\nmotor_warn: 99", "f:2: motor_stop must not be below motor_warn"),
    ],
)
def test_thresholds_that_contradict_each_other_are_refused_where_they_stand(
    text: str, said: str
) -> None:
    with pytest.raises(ConfigError) as error:
        config.loads(text, Thresholds, "f")
    assert str(error.value) == said


class Begun(Exception):
    """Nothing was wrong up to the start of the processes."""


@pytest.fixture
def only_begun(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def begin(*_: object, **__: object) -> None:
        raise Begun

    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setattr("gigabrain_zenoh.launch.up.process_specs", begin)


@pytest.mark.usefixtures("only_begun")
@pytest.mark.parametrize("named", ["beeps", "a_file"])
def test_a_folder_of_scripts_that_is_not_there_is_reported_at_the_start(
    tmp_path: Path, named: str
) -> None:
    (tmp_path / "a_file").touch()
    place, file = tmp_path / named, tmp_path / "robot.yaml"
    file.write_text(f"body: mock\ndecision:\n  behaviour: navigate\n  scripts: {place}\n")
    with pytest.raises(ConfigError) as error:
        up(str(file))
    expected = "expected the folder with the programs that missions may run"
    assert str(error.value) == f"{file}:4: scripts: no folder '{place}'; {expected}"
    place.unlink(missing_ok=True)
    place.mkdir()
    with pytest.raises(Begun):
        up(str(file))


@pytest.mark.usefixtures("only_begun")
def test_a_folder_of_scripts_is_looked_for_only_where_decision_runs(tmp_path: Path) -> None:
    file = tmp_path / "robot.yaml"
    decision = "{behaviour: navigate, settings: {scripts: /nowhere/beeps}}"
    file.write_text(f"hosts: {{a: [router], b: [decision]}}\ndecision: {decision}\n")
    with pytest.raises(Begun):
        up(str(file), host="a")
    with pytest.raises(ConfigError, match=r"robot\.yaml:2: scripts: no folder '/nowhere/beeps'; "):
        up(str(file), host="b")


@pytest.mark.parametrize("name", ["2", "on", "1e3", "/maps/hall: floor #1.yaml"])
def test_a_map_of_up_may_have_a_name_that_yaml_reads_otherwise(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def merge(_: str, __: object, sets: tuple[str, ...], ___: object) -> None:
        assert [assignment(one).node.value for one in sets] == ["localize", name]
        raise Begun

    monkeypatch.setattr("gigabrain_zenoh.cli.demo.checked_map", lambda _: name)
    monkeypatch.setattr("gigabrain_zenoh.cli.demo.merged_file", merge)
    with pytest.raises(Begun):
        up("demo", map=name)


def test_a_folder_does_not_hide_the_known_deployment_of_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "demo").mkdir()
    assert deployment_path("demo") == deployment_folder() / "demo.yaml"
    (tmp_path / "mine").mkdir()
    assert deployment_path("mine") == Path("mine")


def test_a_host_that_is_like_no_other_gets_no_suggestion() -> None:
    with pytest.raises(ConfigError) as error:
        host_of(Deployment(), "nobody")
    assert str(error.value) == "no host 'nobody'; known: robot"
    with pytest.raises(ConfigError, match=r"no host 'robto'; did you mean 'robot'\?"):
        host_of(Deployment(), "robto")


@pytest.mark.parametrize("port", ["", " ", "usb:", "usb:0403", "usb:04x3:6001"])
def test_a_button_that_can_be_nowhere_is_refused(port: str) -> None:
    with pytest.raises(ConfigError) as error:
        button(port=port)
    assert str(error.value) == f"--port: {PORT} {port!r}"
    with pytest.raises(ValueError, match="port: expected a path"):
        ButtonConfig(port=port)


@pytest.mark.parametrize("port", ["/dev/ttyUSB0", "auto", "usb:0403:6001", "usb:10C4:ea60:A 1"])
def test_a_button_may_be_at_any_port(port: str) -> None:
    assert ButtonConfig(port=port).port == port


def test_a_button_whose_adapter_is_missing_is_reported_before_there_is_a_robot(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("gigabrain_zenoh.cli.processes.run_process", lambda config: 0)
    assert button(port="/dev/nope") == 0
    said = "gigabrain: no /dev/nope: is it plugged in? Waiting for it.\n"
    assert capsys.readouterr().err == said
    assert button(port="/dev/null") == 0
    assert capsys.readouterr().err == ""
