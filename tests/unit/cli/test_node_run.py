"""`gigabrain node run`: settings that do not fit its process."""

import pytest

from gigabrain_zenoh.cli.processes import run
from gigabrain_zenoh.errors import ConfigError


@pytest.mark.parametrize(
    ("name", "given", "text"),
    [
        ("driver", (), "--set: missing field 'body'; expected a string"),
        ("page", ("prt=80",), "--set: unknown field 'prt'; did you mean 'port'? known: "),
        ("page", ("port=http",), "--set: port: expected a whole number >= 0 and <= 65535, got 'ht"),
        ("button", ("port=usb:x",), "--set: port: expected a path, or usb:VID:PID"),
    ],
)
def test_settings_that_do_not_fit_are_named_as_they_are_given(
    name: str, given: tuple[str, ...], text: str
) -> None:
    with pytest.raises(ConfigError) as error:
        run(name, set=given)
    assert str(error.value).startswith(text)
