"""Every command in the documents can be parsed: its name, options and values exist."""

import re
import shlex
from collections.abc import Iterator

import pytest
from cyclopts import CycloptsError, MissingArgumentError

from gigabrain_zenoh.cli.app import PARENTS, make_app
from tests.places import ROOT

FENCE = re.compile(r"^```(?:sh)?\n(.*?)^```", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`(gigabrain [a-z][^`]*)`")
PLACEHOLDER = re.compile(r"\b[A-Z]{3,}\b|…|\.\.\.|\[|<")  # not a command to copy
ENDS = {"|", "&", "&&", ";", ">", "2>"}


def documented() -> Iterator[str]:
    """Yield the file and each command line in it, without what a shell would do."""
    for path in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(ROOT.glob("docs/**/*.md"))):
        text = path.read_text()
        lines = [line for block in FENCE.findall(text) for line in block.splitlines()]
        for line in (*lines, *INLINE.findall(text)):
            if line.startswith("gigabrain ") and not PLACEHOLDER.search(line):
                yield f"{path.name}: {line}"


@pytest.mark.long
def test_documented_commands_can_be_parsed() -> None:
    app, wrong = make_app(tuple(PARENTS)), []
    for line in sorted(set(documented())):
        words = shlex.split(line.partition(": gigabrain ")[2], comments=True)
        end = next((i for i, word in enumerate(words) if word in ENDS), len(words))
        try:
            app.parse_args(words[:end], exit_on_error=False, print_error=False)
        except MissingArgumentError:
            pass  # the name of a command, in a sentence
        except CycloptsError as error:
            wrong.append(f"{line}: {error}")
    assert wrong == []
