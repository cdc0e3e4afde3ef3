"""The built documentation site works from files, without any host."""

import re
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from playwright.async_api import Page, async_playwright

from docs.site.build import build
from tests.places import ROOT
from tests.system.page import CHROMIUM, FLAGS, needs_browser

RESOURCE = re.compile(
    r"<(?:script|link|img|iframe|source)\b[^>]*?\b(?:src|href)=\"?(https?://[^\"> ]+)"
)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    paths = [str(ROOT / name) for name in ("", "schemas", "drivers")]
    settings = (ROOT / "mkdocs.yml").read_text()
    assert "paths: [., schemas, drivers]" in settings
    settings = settings.replace("paths: [., schemas, drivers]", f"paths: {paths}")
    (folder / "mkdocs.yml").write_text(settings)
    assert build(folder) == 0
    return folder / "site"


def test_no_page_loads_anything_from_another_host(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) > 30
    assert {str(page): RESOURCE.findall(page.read_text()) for page in pages} == {
        str(page): [] for page in pages
    }


@pytest.fixture
async def page() -> AsyncIterator[Page]:
    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield await browser.new_page()
        await browser.close()


@needs_browser
async def test_the_search_works_from_files_without_requests_to_a_host(
    site: Path, page: Page
) -> None:
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    for _ in range(5):  # Enter opens the first result; not all pages may be indexed yet
        await page.goto((site / "index.html").as_uri())
        await page.get_by_role("button", name="Search").click()
        await page.keyboard.insert_text("safe_state")
        for _ in range(300):  # results are in a closed shadow root
            await page.wait_for_timeout(100)
            await page.keyboard.press("Enter")
            if "/index.html" not in page.url:
                break
        if "safe_state" in await page.inner_text("article"):
            break
    assert "safe_state" in await page.inner_text("article")
    assert [url for url in asked if not url.startswith("file:")] == []


@needs_browser
async def test_the_api_page_contains_the_docstrings(site: Path, page: Page) -> None:
    await page.goto((site / "reference/python.html").as_uri())
    text = await page.inner_text("article")
    assert "move(" in text
    assert "Drive straight by" in text
