"""Texts for users and the README's table are those of the code; `make golden` writes them again."""

import re

import pytest

from gigabrain_zenoh.cli.app import COMMANDS
from tests import user_texts


@pytest.mark.long
def test_texts_for_users_are_those_of_the_golden_file() -> None:
    assert user_texts.render() == user_texts.GOLDEN.read_text()


def test_the_table_of_commands_in_the_readme_is_current() -> None:
    readme = user_texts.README.read_text()
    assert user_texts.with_commands(readme) == readme


@pytest.mark.long
def test_every_command_has_help_with_an_example() -> None:
    text = user_texts.GOLDEN.read_text()
    for command in COMMANDS:
        assert f"Usage: gigabrain {command}" in text
        assert re.search(rf'^Example: (eval "\$\()?gigabrain {command}', text, re.MULTILINE)


def test_every_wrong_command_line_is_refused_in_one_line() -> None:
    """Exit code 2 is a wrong file, option or name; 1 no robot; 3 an e-stop without an answer."""
    text = user_texts.GOLDEN.read_text().split("==== wrong arguments ====")[1].split("====")[0]
    refused = re.findall(r"^\$ (gigabrain .*)\n((?:.*\n)*?)\[(.*)\]$", text, re.MULTILINE)
    assert len(refused) == len(user_texts.WRONG_ARGUMENTS.read_text().splitlines())
    for command, error, code in refused:
        assert error.startswith("gigabrain: "), command
        assert error.count("\n") == 1, command
        assert code in ("1", "2", "3"), command
