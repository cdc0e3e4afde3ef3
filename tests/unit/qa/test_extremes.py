"""The extremes that a robot is sent: complete, the same in every run, and judged as promised."""

from pathlib import Path

import msgspec
import pytest

from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.topics import CMD_VEL, ESTOP, MAP, SCAN, SERVICES, TOPICS
from gigabrain_zenoh.qa.faults.hostile import (
    KNOWN,
    all_extremes,
    as_map,
    chosen_extremes,
    decodes,
    leaves,
    message_of,
)
from gigabrain_zenoh.qa.faults.rows import extreme_messages
from gigabrain_zenoh.qa.faults.rows.extreme_messages import MessageEffect, figures

HEADER = {"boot": 7, "tick": 205, "basis": 205}


def test_every_topic_and_every_service_gets_its_share() -> None:
    assert {case.to.key for case in all_extremes()} == {one.key for one in (*TOPICS, *SERVICES)}


@pytest.mark.parametrize("to", [*TOPICS, *SERVICES], ids=lambda to: to.key)
def test_every_field_is_replaced_by_something_else(to: object) -> None:
    mine = [case for case in all_extremes() if case.to is to and len(case.changes) == 1]
    replaced = {case.changes[0][0] for case in mine}
    for path, _value in leaves(as_map(message_of(mine[0].to))):
        repeats = any(isinstance(at, int) and at > 0 for at in path)  # of a list the first
        named = "report" in path or any(str(at).startswith("robot/") for at in path)
        if not (repeats or named):
            assert any(path[: len(place)] == place for place in replaced), path


def test_the_numbers_name_the_same_cases_in_every_run() -> None:
    again = all_extremes.__wrapped__()
    assert [(c.number, c.key, c.what) for c in again] == [
        (c.number, c.key, c.what) for c in all_extremes()
    ]
    assert [case.number for case in all_extremes()] == list(range(len(all_extremes())))


def test_the_fixed_set_has_at_most_200_that_decode_and_all_that_once_did_harm() -> None:
    assert 150 < len(chosen_extremes()) <= 200
    known = {(case.to, case.what) for case in chosen_extremes()}
    assert known >= set(KNOWN)
    assert {case.to.key for case in chosen_extremes()} > {"robot/estop", "robot/goal", "robot/map"}


def test_a_case_changes_one_place_of_a_message_with_the_robots_own_header() -> None:
    case = next(c for c in all_extremes() if c.to is CMD_VEL and c.what == "linear_x most")
    sent = msgspec.msgpack.decode(case.payload(None, HEADER), type=CmdVel)
    assert (sent.linear_x, sent.boot, sent.tick) == (100.0, 7, 205)
    assert sent.angular_z == as_map(CmdVel)["angular_z"]


def test_a_place_that_the_robots_own_message_has_not_is_left_alone() -> None:
    case = next(c for c in all_extremes() if c.to is MAP and c.what == "resolution least")
    assert msgspec.msgpack.decode(case.payload({"width": 3}, HEADER)) == {"width": 3, **HEADER}


def test_whole_maps_and_pairs_decode() -> None:
    assert sum(c.to is MAP and " x " in c.what and decodes(c) for c in all_extremes()) == 30
    pairs = [case for case in all_extremes() if len(case.changes) == 2]
    assert len(pairs) > 1000
    assert all(case.changes[0][0] != case.changes[1][0] for case in pairs)
    assert any(case.to is SCAN for case in pairs)


def outcome(**changes: object) -> MessageEffect:
    return msgspec.convert({"number": 3, "what": "3: robot/map", **changes}, MessageEffect)


@pytest.mark.parametrize(
    ("changes", "wrong"),
    [
        ({}, ""),
        ({"again_s": 3.0, "grown_mb": 50.0}, ""),
        ({"again_s": 3.1}, "it drove again after 3.1 s"),
        ({"again_s": 9.9, "ended": ["decision"]}, ""),
        ({"again_s": 10.1, "ended": ["decision"]}, "it drove again after 10.1 s"),
        ({"silent": ["safety", "control"]}, "safety, control did not answer within 1 s"),
        ({"grown_mb": 51.0, "grown": "decision"}, "decision grew by 51 MB"),
    ],
)
def test_harm_is_silence_memory_and_standing_still(changes: dict[str, object], wrong: str) -> None:
    assert outcome(**changes).wrong == wrong


def test_the_figures_tell_deaths_from_pauses() -> None:
    outcomes = [outcome(again_s=0.5, grown_mb=2.0), outcome(again_s=7.0, ended=["safety"])]
    assert {one.name: value for one, value in figures(outcomes).items()} == {
        "unresponsive processes": 0,
        "memory grown": 2.0,
        "drives again after": 0.5,
        "after a death": 7.0,
    }


def test_results_are_read_up_to_a_line_that_was_cut_off(tmp_path: Path) -> None:
    file = tmp_path / "results.jsonl"
    assert list(extreme_messages.read_effects(file)) == []
    line = msgspec.json.encode(outcome(again_s=0.5))
    file.write_bytes(line + b"\n" + line[:20])
    assert [one.again_s for one in extreme_messages.read_effects(file)] == [0.5]


def test_requests_that_stop_by_their_purpose_are_among_the_cases() -> None:
    assert any(case.to is ESTOP and decodes(case) for case in all_extremes())
