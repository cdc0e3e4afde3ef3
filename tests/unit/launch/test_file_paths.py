"""The path of a world, a mission or scripts is relative to whatever names it."""

from pathlib import Path

import pytest

from gigabrain_zenoh.launch import merging
from gigabrain_zenoh.launch.deployment import Deployment, load_deployment


def merged(folder: Path, *sets: str, files: tuple[Path, ...] = ()) -> Deployment:
    path = folder / "robot.yaml"
    return merging.merge(
        merging.file_layers(path), files, sets, lambda body, link: Deployment, path
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
