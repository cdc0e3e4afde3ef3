"""The documentation site: pages, navigation, and tables from the code."""

import re
from pathlib import Path
from typing import Any

import msgspec
import pytest
import yaml

from docs.site import build, reference, structs
from gigabrain_zenoh.cli.app import COMMANDS
from gigabrain_zenoh.config.settings import RecorderConfig
from gigabrain_zenoh.launch.deployment import Deployment
from tests.places import ROOT


def navigation(part: Any) -> list[str]:
    if isinstance(part, str):
        return [part]
    parts = part.values() if isinstance(part, dict) else part
    return [page for one in parts for page in navigation(one)]


def test_every_page_is_in_the_navigation_once() -> None:
    named = navigation(yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"])
    written = {str(page.relative_to(ROOT / "docs")) for page in (ROOT / "docs").rglob("*.md")}
    made = {f"reference/{name}.md" for name in reference.PAGES}
    project = {f"project/{name}" for name in build.PROJECT}
    assert sorted(named) == sorted(written | made | project)


@pytest.mark.long
def test_the_page_of_commands_has_each_with_its_options() -> None:
    page = "\n".join(reference.cli())
    assert re.findall(r"^## gigabrain (.*)$", page, re.MULTILINE) == [*COMMANDS]
    assert "--empty-" not in page
    assert "| `--wait`, `--no-wait` | yes or no | `True` |" in page
    assert "| `--seconds` | number | `10.0` | Length of each run [s]. |" in page


def test_a_field_has_its_bounds_unit_and_default() -> None:
    fields = {one.name: one for one in structs.fields(RecorderConfig)}
    flush = fields["flush_s"]
    assert (flush.kind, flush.default) == ("number > 0, ≤ 10", "0.25")
    assert fields["viewers"].kind == "true or false"
    assert fields["topics"].default == "[]"


def test_units_come_from_the_comments() -> None:
    class Base(msgspec.Struct, frozen=True, kw_only=True):
        """A base."""

    kinds = {kind.__name__: kind for kind in structs.nested(Deployment)}
    ahead = {one.name: one for one in structs.fields(kinds["PerceptionConfig"])}["ahead"]
    assert (ahead.unit, ahead.about) == ("m", "length of that cone")
    assert list(structs.fields(Base)) == []


def test_links_follow_a_page_to_its_place_on_the_site(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(build, "ROOT", tmp_path)
    monkeypatch.setattr(build, "DOCS", tmp_path / "docs")
    page = tmp_path / "docs/how-to/tools.md"
    page.parent.mkdir(parents=True)
    links = "[a](../../CHANGELOG.md#x) [b](../../examples/square.py) [c](../index.md)"
    page.write_text(f"{links}\n```\n[d](kept)\n```\n")
    assert build.relinked(page, Path("how-to/tools.md")) == (
        "[a](../project/CHANGELOG.md#x) [b](../reference/examples.md) [c](../index.md)"
        "\n```\n[d](kept)\n```\n"
    )
    page.write_text("<!-- file: a/b.yaml -->\n```yaml\na: 1\n```\n")
    assert build.relinked(page, Path("how-to/tools.md")) == (
        "```yaml title='a/b.yaml'\na: 1\n```\n"
    )
    page.write_text("[a](../../deploy/demo.yaml)")
    with pytest.raises(ValueError, match=r"deploy/demo\.yaml is not on the site"):
        build.relinked(page, Path("how-to/tools.md"))
