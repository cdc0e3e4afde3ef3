"""Builds the documentation site into `site/`: `python -m docs.site.build`.

The pages of `docs/` and of the project go to a folder of their own, the reference pages are made
from the code, and Zensical renders both by `mkdocs.yml`. A broken link or an unknown name fails.
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

from docs.site import reference

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PROJECT = {"CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md"}  # below `project/` on the site
LINK = re.compile(r"(?<=\]\()([^)\s#:]+)(?=[)#])")
FILE = re.compile(r"^<!-- file: (\S+) -->\n```(\w+)$", re.MULTILINE)
CODE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)


def build(folder: Path = ROOT) -> int:
    """Assemble the pages and run Zensical by the mkdocs.yml in `folder`; return its exit code."""
    assemble(folder / ".site")
    command = (sys.executable, "-m", "zensical", "build", "--strict", "--clean")
    return subprocess.run(command, cwd=folder, check=False).returncode


def assemble(pages: Path) -> None:
    """Write all pages into the folder that Zensical reads."""
    shutil.rmtree(pages, ignore_errors=True)
    shutil.copytree(DOCS, pages, ignore=shutil.ignore_patterns("site", "__pycache__"))
    for source in DOCS.rglob("*.md"):
        path = source.relative_to(DOCS)
        (pages / path).write_text(relinked(source, path), "utf-8")
    (pages / "project").mkdir()
    for name in PROJECT:
        (pages / "project" / name).write_text(relinked(ROOT / name, Path("project", name)), "utf-8")
    for name, lines in reference.PAGES.items():
        (pages / f"reference/{name}.md").write_text("\n".join(lines()) + "\n", "utf-8")


def relinked(source: Path, path: Path) -> str:
    """Return the text of a page: links lead to the same places from `path`, files have names."""

    def moved(link: re.Match[str]) -> str:
        target = Path(os.path.normpath(source.parent / link[1]))
        return os.path.relpath(place_of(target), path.parent)

    text = FILE.sub(r"```\2 title='\1'", source.read_text("utf-8"))
    pieces, at = [], 0
    for code in CODE.finditer(text):
        pieces += [LINK.sub(moved, text[at : code.start()]), code[0]]
        at = code.end()
    return "".join([*pieces, LINK.sub(moved, text[at:])])


def place_of(target: Path) -> str:
    """Return where a file of the repository is on the site. Raises ValueError for no place."""
    if target.is_relative_to(DOCS):
        return str(target.relative_to(DOCS))
    name = str(target.relative_to(ROOT))
    if name in PROJECT:
        return f"project/{name}"
    if name == "README.md":
        return "index.md"
    if target.parent.name == "examples" or name == "examples":
        return "reference/examples.md"
    raise ValueError(f"{name} is not on the site; link to a page, or name it without a link")


if __name__ == "__main__":
    sys.exit(build())
