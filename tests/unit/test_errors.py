"""Errors list the valid names; a long list ends with a count."""

import pytest

from gigabrain_zenoh.errors import MAX_UNKNOWN_CHARS, listed, unknown

MAX_REPLY_CHARS = 500  # of the text of a reply
LABELS = [f"thing_{number:04}" for number in range(2000)]


@pytest.mark.parametrize(
    ("names", "text"),
    [
        ([], "none"),
        (["left"], "left"),
        (["left", "right", "up"], "left, right, up"),
        (["left", "right", "up", "down"], "left, right, up and 1 more"),
        (["a name longer than the limit", "left"], "a name longer than the limit and 1 more"),
    ],
)
def test_a_long_list_ends_with_the_number_of_further_names(names: list[str], text: str) -> None:
    assert listed(names, len("left, right, up, ")) == text


def test_an_unknown_name_lists_whole_names_and_counts_the_others() -> None:
    text = str(unknown("label", "thing_1", LABELS))
    start, _, rest = text.partition(" known: ")
    names, _, more = rest.partition(" and ")
    shown = names.split(", ")
    assert start == "no label 'thing_1'; did you mean 'thing_1999'?"
    assert shown == LABELS[: len(shown)]
    assert more == f"{len(LABELS) - len(shown)} more"
    assert MAX_UNKNOWN_CHARS - 20 < len(text) < MAX_UNKNOWN_CHARS + len(" and 2000 more")


def test_the_longest_name_and_suggestion_leave_a_reply_whole() -> None:
    text = str(unknown("label", 64 * "x", ["x" * 63 + letter for letter in "abcdefgh"]))
    assert text.endswith(" more")
    assert len(text) <= MAX_REPLY_CHARS
