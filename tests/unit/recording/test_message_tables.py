"""Tables of a recording are whole or not there, and each key has its own."""

import itertools
from pathlib import Path

import pytest

from gigabrain_schemas.base import Message
from gigabrain_zenoh.errors import UnknownName
from gigabrain_zenoh.recording import message_tables
from tests.unit.recording import bags


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "drive.mcap"
    bags.write(path, bags.drive(20))
    return path


def test_an_interrupted_conversion_leaves_no_table_and_keeps_earlier_ones(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, calls, row = tmp_path / "csv", itertools.count(), message_tables.row
    folder.mkdir()
    (folder / "robot_state.csv").write_text("earlier")

    def interrupted(message: Message) -> dict[str, message_tables.Value]:
        if next(calls) == 30:  # 24 are read for the columns
            raise KeyboardInterrupt
        return row(message)

    monkeypatch.setattr(message_tables, "row", interrupted)
    with pytest.raises(KeyboardInterrupt):
        message_tables.write_csv(recording, folder)
    assert [path.name for path in folder.iterdir()] == ["robot_state.csv"]
    assert (folder / "robot_state.csv").read_text() == "earlier"


def test_keys_that_differ_only_in_a_slash_have_tables_of_their_own(tmp_path: Path) -> None:
    path, encoding = tmp_path / "drive.mcap", "application/msgpack;gigabrain.RobotState"
    keys = ("a/b_c", "a_b/c", "a_b/c")
    each = (
        bags.arrival(n, key, bags.state(n))._replace(encoding=encoding)
        for n, key in enumerate(keys, 1)
    )
    bags.write(path, each)
    tables = message_tables.write_csv(path, tmp_path / "csv")
    assert [table.name for table in tables] == ["a_b_c.csv", "a_b_c_1.csv"]
    assert [len(table.read_text().splitlines()) for table in tables] == [2, 3]


def test_a_text_is_refused_by_naming_numbers_alone(recording: Path) -> None:
    with pytest.raises(UnknownName, match=r"^no number 'state\.gate\.mode'; ") as error:
        message_tables.read_series(recording, ["state.gate.mode"])
    _, _, known = str(error.value).partition("known: ")
    assert known.startswith("state.basis, state.boot, state.gate.enables, ")
    assert "state.robot_type" not in known
