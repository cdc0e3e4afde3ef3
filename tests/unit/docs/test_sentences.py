"""The documentation is written in short sentences."""

from statistics import fmean

import pytest

from tests.places import ROOT
from tests.qa.blocks import pages
from tests.qa.sentences import MEAN, PAGE_MEAN, mean, sentences, words

NAMES = [str(page.relative_to(ROOT)) for page in pages()]


def test_the_mean_sentence_has_fewer_than_18_words() -> None:
    lengths = [words(one) for page in pages() for one in sentences(page.read_text())]
    assert len(lengths) > 1000
    assert fmean(lengths) < MEAN


@pytest.mark.parametrize("name", NAMES)
def test_a_page_is_no_riddle(name: str) -> None:
    assert mean(ROOT / name) < PAGE_MEAN  # see `python -m tests.qa.sentences`


@pytest.mark.parametrize(
    ("text", "lengths"),
    [
        ("One two three. Four five!", [3, 2]),
        ("# A heading\n\nOne two.\n\n| a | table |\n|---|---|\n", [2]),
        ("It takes 0.5 s, i.e. not long.", [7]),
        ("Run `gigabrain demo --headless` now.\n\n```sh\nnot this\n```\n", [3]),
        ("Two things:\n\n- one thing;\n- and [another thing](page.md#x).\n", [2, 2, 3]),
    ],
)
def test_sentences_are_counted_as_a_reader_does(text: str, lengths: list[int]) -> None:
    assert [words(one) for one in sentences(text)] == lengths
