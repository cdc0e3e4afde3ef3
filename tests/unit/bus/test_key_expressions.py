"""Key expressions are valid, and match, as Zenoh has it."""

import itertools

import pytest
import zenoh

from gigabrain_zenoh.bus.key_expressions import check_key_expression, key_expressions, matches
from gigabrain_zenoh.errors import ConfigError

PIECES = ("a", "/", "*", "**", "$*", "$", "#", "?", "/*", "/**")
TEXTS = ["".join(some) for n in range(5) for some in itertools.product(PIECES, repeat=n)]


def is_valid(text: str) -> bool:
    try:
        check_key_expression(text)
    except ConfigError:
        return False
    return True


def is_valid_for_zenoh(text: str) -> bool:
    try:
        zenoh.KeyExpr(text)
    except zenoh.ZError:
        return False
    return True


@pytest.mark.long
def test_what_zenoh_takes_is_taken_and_nothing_else() -> None:
    assert [text for text in TEXTS if is_valid(text) != is_valid_for_zenoh(text)] == []


def test_a_key_matches_as_for_zenoh() -> None:
    patterns = sorted(text for text in {*TEXTS} if is_valid(text))
    for key in ("a", "aa", "b", "a/a", "a/b", "ab/a", "a/b/a", "a/a/a/b"):
        there = zenoh.KeyExpr(key)
        different = [p for p in patterns if matches(p, key) != zenoh.KeyExpr(p).intersects(there)]
        assert different == []


def test_names_of_topics_become_key_expressions_and_wrong_ones_are_refused() -> None:
    assert key_expressions(("scan", "image", "robot/im$*", "**/x")) == [
        "robot/scan", "robot/image/**", "robot/im$*", "**/x",
    ]  # fmt: skip
    assert key_expressions(()) == []
    with pytest.raises(ConfigError, match="no topic 'scam'; did you mean 'scan'"):
        key_expressions(("scam",))
    with pytest.raises(ConfigError) as error:
        key_expressions(("scan", "robot/scan*"))
    assert str(error.value) == (
        "expected a key expression, got 'robot/scan*': names joined by /, without #, ? and $; "
        "* is any name, ** any number of names (*/** one or more), $* any characters of a name"
    )
