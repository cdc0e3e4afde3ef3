"""Arguments of `gigabrain zone add` that cannot be right, refused before a robot is looked for."""

from typing import Any, Literal

import pytest

from gigabrain_zenoh.cli.zone import _ask, add_zone
from gigabrain_zenoh.errors import ConfigError


@pytest.mark.parametrize(("kind", "option"), [("speed", "--max-speed"), ("one_way", "--width")])
def test_a_missing_option_is_named(kind: Literal["speed", "one_way"], option: str) -> None:
    with pytest.raises(ConfigError, match=f"add {option}"):
        add_zone("ramp", kind, [0.0, 0.0, 1.0, 0.0, 1.0, 1.0])


async def test_a_refused_zone_is_not_explained_by_a_path_in_a_message() -> None:
    bus: Any = None  # not reached
    zone = {"name": "z", "kind": "keepout", "points": [(0, 0), (1, 1)]}
    with pytest.raises(ConfigError, match=r"a polygon has at least 3 points$"):
        await _ask(bus, {"zone": zone})


async def test_a_bad_name_is_refused_in_words_and_not_by_a_regular_expression() -> None:
    bus: Any = None  # not reached
    place = {"name": "a/b", "x": 0.0, "y": 0.0}
    text = (
        r"place or zone: name: expected a string of letters, digits, spaces, - _ and \., a letter"
    )
    with pytest.raises(ConfigError, match=text):
        await _ask(bus, {"place": place})
