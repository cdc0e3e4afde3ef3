"""`gigabrain param save`: what it writes, and what it says where it cannot."""

import os
from pathlib import Path

import pytest

from gigabrain_schemas.requests import Param, ParamReply
from gigabrain_zenoh.cli import node
from gigabrain_zenoh.errors import ConfigError
from tests.closed import close_folder

MARGIN = Param(
    name="stop_margin", value="0.1", expected="a number", key="robot.stop_margin", initial="0.05"
)


@pytest.fixture(autouse=True)
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, ...]]:
    """A decision with one changed parameter; return what it is asked."""
    asked: list[tuple[str, ...]] = []

    def answer(_: object, *words: str) -> dict[str, ParamReply]:
        asked.append(words)
        return {"decision": ParamReply(ok=True, text="", params=(MARGIN,))}

    monkeypatch.setattr(node, "ask_params", answer)
    return asked


def test_changed_parameters_are_saved_beside_the_other_values(tmp_path: Path) -> None:
    file = tmp_path / "slow.yaml"
    file.write_text("robot: {max_linear_speed: 0.2}\n")
    node.save_params(file)
    assert file.read_text() == "robot:\n  max_linear_speed: 0.2\n  stop_margin: 0.1\n"


def test_a_file_that_cannot_be_written_is_named_before_anything_is_changed(
    tmp_path: Path, asked: list[tuple[str, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    close_folder(tmp_path / "closed", monkeypatch)
    for file, fault in (
        (tmp_path / "none" / "x.yaml", "no such folder; create it first"),
        (tmp_path / "closed" / "inner" / "x.yaml", "no such folder; create it first"),
        (tmp_path, "it is a folder; name a file"),
    ):
        with pytest.raises(ConfigError) as error:
            node.set_param("decision", "stop_margin", "0.1", save=file)
        assert str(error.value) == f"cannot write {file}: {fault}"
        with pytest.raises(ConfigError, match=fault):
            node.save_params(file)
    assert asked == []


@pytest.mark.parametrize("text", ["hello world\n", "- a\n- b\n", "a: [\n"])
def test_a_file_that_holds_something_else_is_not_overwritten(
    tmp_path: Path, asked: list[tuple[str, ...]], text: str
) -> None:
    file = tmp_path / "notes.txt"
    file.write_text(text)
    with pytest.raises(ConfigError, match=r"notes\.txt:[12]: (expected a mapping of|not YAML)"):
        node.set_param("decision", "stop_margin", "0.1", save=file)
    assert asked == []
    with pytest.raises(ConfigError, match=r"notes\.txt:[12]: (expected a mapping of|not YAML)"):
        node.save_params(file)
    assert file.read_text() == text


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("# of the hall\nrobot: {max_linear_speed: 0.2}\n", 1),
        ("world: 'a#b'\nrobot:\n  max_linear_speed: 0.2 # by the door\n", 3),
    ],
)
def test_comments_of_a_file_by_hand_are_not_lost(
    tmp_path: Path, asked: list[tuple[str, ...]], text: str, line: int
) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(text)
    fault = rf"mine\.yaml:{line}: has a comment, which would be lost; save to another file"
    with pytest.raises(ConfigError, match=fault):
        node.set_param("decision", "stop_margin", "0.1", save=file)
    assert asked == []
    with pytest.raises(ConfigError, match=fault):
        node.save_params(file)
    assert file.read_text() == text


def test_a_number_sign_in_a_text_is_no_comment(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("world: 'a # b'\nbody: c#d\n")
    node.save_params(file)
    kept = "world: 'a # b'\nbody: c#d\n"
    assert file.read_text() == f"{kept}robot:\n  stop_margin: 0.1\n"


def test_a_full_disk_leaves_the_file_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "slow.yaml"
    file.write_text("robot: {max_linear_speed: 0.2}\n")

    def fsync(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", fsync)
    with pytest.raises(ConfigError, match=r"^cannot write .*slow.yaml: the disk is full; free"):
        node.save_params(file)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["robot: {max_linear_speed: 0.2}\n"]
