"""Old words of files and of the command line still work, and each prints one line."""

from collections.abc import Mapping

import pytest

from gigabrain_zenoh.config import renames, yaml_text
from gigabrain_zenoh.config.renames import (
    Rename,
    renamed_arguments,
    renamed_fields,
    renamed_settings,
)
from gigabrain_zenoh.errors import ConfigError

YAML = (
    Rename("decision.begin", "start", {"roam": "explore"}),
    Rename("decision.unknown", "unknown_space"),
    Rename("decision.linear_speed", "avoid.linear_speed"),
    Rename("recorder.how", "how", {"all": "everything"}),
)
CLI = (
    Rename("warm", "precompile"),
    Rename("task list", "goals"),
    Rename("demo --begin", "--start", {"roam": "explore", "wait": "wait"}),
    Rename("--remember", "--state-dir"),
    Rename("goto --how", "--how", {"after": "queue"}),
)


@pytest.fixture(autouse=True)
def _no_notice_yet(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(renames, "_printed", set())


def values(text: str) -> object:
    return renamed_fields(yaml_text.read(text), "robot.yaml", YAML).value


def test_an_old_field_and_its_old_value_are_read_as_the_new_ones() -> None:
    assert values("decision:\n  begin: roam\n") == {"decision": {"start": "explore"}}
    assert values("decision:\n  begin: wait\n") == {"decision": {"start": "wait"}}
    assert values("recorder: {how: all}") == {"recorder": {"how": "everything"}}
    assert values("recorder: {how: [all]}") == {"recorder": {"how": ["all"]}}


def test_the_notice_is_one_line_with_the_place_and_comes_once(
    capsys: pytest.CaptureFixture[str],
) -> None:
    for _ in range(2):
        values("decision:\n  begin: roam\n  unknown: avoid\n")
    assert capsys.readouterr().err.splitlines() == [
        "robot.yaml:2: 'begin: roam' is now 'start: explore'; the old form works until 0.3",
        "robot.yaml:3: 'unknown' is now 'unknown_space'; the old form works until 0.3",
    ]


def test_new_words_and_the_same_word_elsewhere_are_left_alone(
    capsys: pytest.CaptureFixture[str],
) -> None:
    same = {"decision": {"start": "explore"}, "begin": "roam", "list": [{"unknown": None}]}
    text = "decision: {start: explore}\nbegin: roam\nlist: [{unknown: }]\n"
    assert values(text) == same
    assert capsys.readouterr().err == ""


def test_a_field_moves_into_a_mapping_that_is_there_or_not() -> None:
    assert values("decision: {linear_speed: 0.2}") == {"decision": {"avoid": {"linear_speed": 0.2}}}
    both = {"decision": {"avoid": {"turn": "left", "linear_speed": 0.2}}}
    assert values("decision: {avoid: {turn: left}, linear_speed: 0.2}") == both
    assert values("decision: {linear_speed: 0.2, avoid: {turn: left}}") == both


def test_a_row_with_a_condition_holds_only_where_it_is_true(
    capsys: pytest.CaptureFixture[str],
) -> None:
    def navigates(decision: Mapping[str, object]) -> bool:
        return decision.get("behaviour") == "navigate"

    table = (
        Rename("decision.speed", "", when=navigates),
        Rename("decision.speed", "settings.max_speed"),
    )
    kept, dropped = {"speed": 0.2}, {"behaviour": "navigate", "speed": 0.2}
    moved = {"settings": {"max_speed": 0.2}}
    text = "decision: {speed: 0.2}"
    assert renamed_fields(yaml_text.read(text), "a", table).value == {"decision": moved}
    text = "decision: {behaviour: navigate, speed: 0.2}"
    without = {"behaviour": "navigate"}
    assert renamed_fields(yaml_text.read(text), "a", table).value == {"decision": without}
    assert "a:1: 'speed' has no effect here;" in capsys.readouterr().err
    assert renamed_settings(kept, "decision", table) == moved
    assert renamed_settings(dropped, "decision", table) == without


def test_a_file_with_both_words_keeps_both_for_the_loader_to_refuse() -> None:
    both = {"decision": {"begin": "roam", "start": "wait"}}
    assert values("decision: {begin: roam, start: wait}") == both


def test_settings_in_an_old_recording_get_the_current_words() -> None:
    old = {"begin": "roam", "linear_speed": 0.1, "samples": 64}
    new = {"start": "explore", "avoid": {"linear_speed": 0.1}, "samples": 64}
    assert renamed_settings(old, "decision", YAML) == new
    assert renamed_settings(old, "perception", YAML) == old
    assert old == {"begin": "roam", "linear_speed": 0.1, "samples": 64}


@pytest.mark.parametrize(
    ("old", "new", "notice"),
    [
        ("warm --quiet", "precompile --quiet", "'warm' is now 'precompile'"),
        ("task list --json", "goals --json", "'task list' is now 'goals'"),
        ("demo --begin roam", "demo --start explore", "'--begin roam' is now '--start explore'"),
        ("demo --begin=roam", "demo --start=explore", "'--begin roam' is now '--start explore'"),
        ("demo --begin wait", "demo --start wait", "'--begin' is now '--start'"),
        ("up a --remember d", "up a --state-dir d", "'--remember' is now '--state-dir'"),
        ("goto 1 2 --how after", "goto 1 2 --how queue", "'--how after' is now '--how queue'"),
        ("goto 1 2 --how replace", "goto 1 2 --how replace", ""),
        ("patrol --begin roam", "patrol --begin roam", ""),
        ("task show list", "task show list", ""),
        ("up -- --remember d", "up -- --remember d", ""),
    ],
)
def test_old_commands_and_options_are_read_as_the_new_ones(old: str, new: str, notice: str) -> None:
    expected = [f"{notice}; the old form works until 0.3"] if notice else []
    assert renamed_arguments(old.split(), CLI) == (new.split(), expected)


@pytest.mark.parametrize("old", ["demo --begin rome", "demo --begin=rome"])
def test_a_value_that_the_old_option_does_not_take_is_refused(old: str) -> None:
    with pytest.raises(ConfigError, match=r"^--begin: expected one of 'roam', 'wait', got 'rome'"):
        renamed_arguments(old.split(), CLI)


def test_every_row_of_the_tables_has_a_new_word() -> None:
    for rename in (*renames.YAML_WORDS, *renames.CLI_WORDS):
        assert rename.new or rename.when  # dropped where it has no effect
        assert rename.old != rename.new or rename.values
