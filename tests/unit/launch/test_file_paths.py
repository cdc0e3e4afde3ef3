"""The path of a robot, a world, a map or a mission is relative to whatever names it."""

from pathlib import Path

import pytest

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.launch import merging
from gigabrain_zenoh.launch.deployment import Deployment, load_deployment
from gigabrain_zenoh.runtime.running import find_endpoint

HOMELESS = "~nobody7/a.yaml: no such home folder; write the whole path"


def merged(folder: Path, *sets: str, files: tuple[Path, ...] = ()) -> Deployment:
    path = folder / "robot.yaml"
    return merging.merge(
        merging.file_layers(path), files, sets, lambda body, link: Deployment
    ).deployment


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "robot.yaml").write_text("world: flat.yaml\n")
    return tmp_path


def test_in_a_deployment_file_it_lies_beside_the_file(folder: Path) -> None:
    assert merged(folder).world == str(folder / "flat.yaml")
    assert load_deployment(folder / "robot.yaml").world == str(folder / "flat.yaml")


def test_in_a_settings_file_it_lies_beside_that(folder: Path) -> None:
    (folder / "more").mkdir()
    more = folder / "more" / "settings.yaml"
    more.write_text("world: maps/hall.yaml\n")
    assert merged(folder, files=(more,)).world == str(folder / "more" / "maps" / "hall.yaml")


def test_of_set_it_is_relative_to_the_present_folder(
    folder: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = tmp_path_factory.mktemp("here")
    monkeypatch.chdir(here)
    assert merged(folder, "world=hall.xml").world == str(here / "hall.xml")
    assert merged(folder, "world=/worlds/hall.xml").world == "/worlds/hall.xml"


def test_names_of_shipped_worlds_stay_as_they_are(folder: Path) -> None:
    assert merged(folder, "world=house").world == "house"
    assert merged(folder, "world=random:7").world == "random:7"


def test_so_are_a_mission_and_scripts(
    folder: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = "decision: {behaviour: navigate, settings: {mission: a.yaml, scripts: s}}\n"
    (folder / "robot.yaml").write_text(text)
    (folder / "more").mkdir()
    more = folder / "more" / "settings.yaml"
    more.write_text("decision: {settings: {scripts: t}}\n")
    here = tmp_path_factory.mktemp("here")
    monkeypatch.chdir(here)
    beside = {"mission": str(folder / "a.yaml"), "scripts": str(folder / "s")}
    assert load_deployment(folder / "robot.yaml").decision.settings == beside
    assert merged(folder).decision.settings == beside
    assert merged(folder, "decision.settings.mission=b.yaml", files=(more,)).decision.settings == {
        "mission": str(here / "b.yaml"),
        "scripts": str(folder / "more" / "t"),
    }


def test_so_are_a_body_a_map_and_recordings(
    folder: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = "body: my/robot.yaml\nperception: {mapping: localize, map: ~/maps/office.yaml}\n"
    (folder / "robot.yaml").write_text(text + "recorder: {folder: drives, file: a.mcap}\n")
    more = folder / "more.yaml"
    more.write_text("perception: {map: hall.yaml}\n")
    here = tmp_path_factory.mktemp("here")
    monkeypatch.chdir(here)
    monkeypatch.setenv("HOME", "/home/ann")
    for found in (load_deployment(folder / "robot.yaml"), merged(folder)):
        assert found.body == str(folder / "my" / "robot.yaml")
        assert found.perception.map == "/home/ann/maps/office.yaml"
        assert found.recorder.folder == str(folder / "drives")
        assert found.recorder.file == str(folder / "a.mcap")
    found = merged(folder, "body=robot.yaml", "recorder.file=b.mcap", files=(more,))
    assert found.body == str(here / "robot.yaml")
    assert found.perception.map == str(folder / "hall.yaml")
    assert found.recorder.file == str(here / "b.mcap")


def test_so_are_keys_certificates_secrets_and_types_of_ros(
    folder: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = "page: {certificate: page.crt, certificate_key: page.key, tokens: ~/tokens}\n"
    text += "foxglove: {secret: secret}\nros2: {types: [msg, /b.msg]}\nkeys: home\n"
    (folder / "robot.yaml").write_text(text)
    (folder / "more").mkdir()
    more = folder / "more" / "settings.yaml"
    more.write_text("keys: others\nros2: {types: [srv]}\n")
    here = tmp_path_factory.mktemp("here")
    monkeypatch.chdir(here)
    monkeypatch.setenv("HOME", "/home/ann")
    for found in (load_deployment(folder / "robot.yaml"), merged(folder)):
        assert found.page.certificate == str(folder / "page.crt")
        assert found.page.certificate_key == str(folder / "page.key")
        assert found.page.tokens == "/home/ann/tokens"
        assert found.foxglove.secret == str(folder / "secret")
        assert found.ros2
        assert found.ros2.types == (str(folder / "msg"), "/b.msg")
        assert found.keys == str(folder / "home")
    found = merged(folder, "page.certificate=page.crt", files=(more,))
    assert found.page.certificate == str(here / "page.crt")
    assert found.ros2
    assert found.ros2.types == (str(folder / "more" / "srv"),)
    assert found.keys == str(folder / "more" / "others")
    assert merged(folder, "keys=home/robot").keys == str(here / "home" / "robot")


def test_names_of_known_bodies_and_saved_maps_stay_as_they_are(folder: Path) -> None:
    (folder / "robot.yaml").write_text("body: alpha\nperception: {mapping: slam, map: house}\n")
    for found in (load_deployment(folder / "robot.yaml"), merged(folder)):
        assert (found.body, found.perception.map) == ("alpha", "house")
        assert (found.recorder.folder, found.recorder.file) == ("", "")


@pytest.mark.parametrize(
    "text",
    [
        "world: ~nobody7/a.yaml",
        "recorder: {folder: ~nobody7/a.yaml}",
        "keys: ~nobody7/a.yaml",
        "ros2: {types: [~nobody7/a.yaml]}",
    ],
)
def test_a_home_that_is_not_there_is_refused_in_one_line(folder: Path, text: str) -> None:
    (folder / "robot.yaml").write_text(f"{text}\n")
    with pytest.raises(ConfigError, match=f"^{HOMELESS}$"):
        load_deployment(folder / "robot.yaml")


def test_so_it_is_for_commands() -> None:
    with pytest.raises(ConfigError, match=f"^{HOMELESS}$"):
        find_endpoint(None, keys="~nobody7/a.yaml")
