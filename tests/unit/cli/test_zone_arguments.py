"""Arguments of `gigabrain zone add` that cannot be right, refused before a robot is looked for."""

from typing import Literal

import pytest

from gigabrain_zenoh.cli.zone import add_zone
from gigabrain_zenoh.errors import ConfigError


@pytest.mark.parametrize(("kind", "option"), [("speed", "--max-speed"), ("one_way", "--width")])
def test_a_missing_option_is_named(kind: Literal["speed", "one_way"], option: str) -> None:
    with pytest.raises(ConfigError, match=f"add {option}"):
        add_zone("ramp", kind, [0.0, 0.0, 1.0, 0.0, 1.0, 1.0])
