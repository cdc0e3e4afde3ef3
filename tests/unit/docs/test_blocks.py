"""Every block of the documentation can be read, and is run or says why not."""

from pathlib import Path

import pytest

from tests.places import ROOT
from tests.qa.blocks import Block, blocks, pages, problem

NAMES = [str(page.relative_to(ROOT)) for page in pages()]


@pytest.mark.parametrize("name", NAMES)
def test_the_blocks_of_a_page_can_be_read(name: str) -> None:
    found = {f"{name}:{block.line}": problem(block) for block in blocks(ROOT / name)}
    assert {place: text for place, text in found.items() if text} == {}


@pytest.mark.parametrize(
    ("language", "text", "verb", "value", "said"),
    [
        ("", "x", "", "", "no language"),
        ("rust", "x", "", "", "a block of rust"),
        ("sh", "make", "not run", "hours", "expected one of"),
        ("sh", "make", "not run", "hardware (a robot)", ""),
        ("python", "def x(:", "", "", "invalid syntax"),
        ("yaml", "boddy: mock", "", "", "did you mean 'body'?"),
        ("yaml", "seed: 3", "", "", ""),
        ("yaml", "wheel_radius: far", "", "", "wheel_radius"),
        ("yaml", "wheel_radius: 0.1", "", "", ""),
        ("yaml", "do: [{goto: [1, 2]}]", "file", "round.yaml", ""),
        ("toml", "a = ", "", "", "Invalid value"),
    ],
)
def test_a_mistake_in_a_block_is_named(
    language: str, text: str, verb: str, value: str, said: str
) -> None:
    found = problem(Block(Path("page.md"), 1, language, text, verb, value))
    assert said in found
    assert bool(found) == bool(said)
