"""Measures the sentences of README.md and docs/: `python -m tests.qa.sentences`.

Code, tables, headings, targets of links and comments are left out. A list item is a sentence; a
colon before a list or a block ends one. It prints the mean of each page, and the longest sentences.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from statistics import fmean

from tests.places import ROOT
from tests.qa.blocks import pages

FENCE = re.compile(r"^ *```.*?^ *```$", re.MULTILINE | re.DOTALL)
COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
LINK = re.compile(r"!?\[([^\]]*)\]\([^)]*\)")
CODE = re.compile(r"`[^`]*`")
END = re.compile(r"(?<=[.!?])[)\"”*_]*\s+(?=[A-Z`(*\"“0-9])|(?<=:)\s*$")
ABBREVIATIONS = re.compile(r"\b(e\.g|i\.e|etc|vs|al|No)\.")
WORD = re.compile(r"[\w'./%°×-]*\w[\w'./%°×-]*")
MEAN, PAGE_MEAN = 18.0, 20.0  # [words], limits for all sentences, and for those of a page


def sentences(text: str) -> Iterator[str]:
    """Yield the sentences of a page."""
    for part in _paragraphs(text):
        for sentence in END.split(part):
            if sentence and len(WORD.findall(sentence)) > 1:
                yield sentence.strip()


def words(sentence: str) -> int:
    """Return the number of words in a sentence; a piece of code counts as one."""
    return len(WORD.findall(sentence))


def _paragraphs(text: str) -> Iterator[str]:
    """Yield paragraphs and list items, each as one line."""
    text = COMMENT.sub("", FENCE.sub("\n", text))
    text = CODE.sub("Code", LINK.sub(r"\1", ABBREVIATIONS.sub(r"\1", text)))
    lines: list[str] = []
    for line in [*text.splitlines(), ""]:
        stripped = line.strip()
        item = re.match(r"([-*]|\d+\.) ", stripped)
        if item or not stripped or stripped.startswith(("#", "|", "!")):
            if lines:
                yield " ".join(lines)
            lines = [stripped[item.end() :]] if item else []
        else:
            lines.append(stripped)


def mean(page: Path) -> float:
    """Return the mean length of a page's sentences [words]; 0 without any."""
    found = [words(one) for one in sentences(page.read_text("utf-8"))]
    return fmean(found) if found else 0.0


def main() -> None:
    """Print the mean of each page and of all, and the longest sentences."""
    found = [
        (words(one), page.name, one) for page in pages() for one in sentences(page.read_text())
    ]
    for page in pages():
        print(f"{mean(page):5.1f}  {page.relative_to(ROOT)}")
    print(f"{fmean(count for count, *_ in found):5.1f}  of {len(found)} sentences")
    for count, name, sentence in sorted(found, reverse=True)[:30]:
        print(f"\n{count} {name}: {sentence}")


if __name__ == "__main__":
    main()
