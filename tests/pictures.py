"""Takes the pictures of the operator page that are in the docs: python -m tests.pictures FOLDER."""

import asyncio
import sys
import tempfile
from pathlib import Path

from playwright.async_api import Page, async_playwright

from tests.onlooker import looking_on
from tests.page_rig import CHROMIUM, FLAGS, OPERATOR, Robot
from tests.stack import Home, until

DRIVEN_TICKS = 2000  # 40 s, so that there is something to see
SIZES = {"light": (1280, 800), "dark": (1280, 800), "phone": (390, 844)}


async def take(folder: Path) -> None:
    """A house, driven through for a while; a log as well in the dark one."""
    with tempfile.TemporaryDirectory() as place:
        home = Home(Path(place) / "home")
        try:
            robot = Robot(home, world="house", seed=1)
            async with looking_on(robot.endpoint) as seen:
                await until(lambda: "page" in seen.health, "the page is served")
                async with async_playwright() as playwright:
                    chromium = await playwright.chromium.launch(
                        executable_path=CHROMIUM, args=FLAGS
                    )
                    pages = {
                        name: await chromium.new_page(
                            viewport={"width": width, "height": height},
                            color_scheme="dark" if name == "dark" else "light",
                        )
                        for name, (width, height) in SIZES.items()
                    }
                    for page in pages.values():
                        await page.goto(f"{robot.origin}/#{OPERATOR}")
                    await seen.ticks(DRIVEN_TICKS)
                    await pages["dark"].click("#tab-topics")
                    for name, page in pages.items():
                        await shoot(page, folder / f"page_{name}.png")
                    await chromium.close()
        finally:
            home.close()


async def shoot(page: Page, path: Path) -> None:
    await page.wait_for_selector("#link.live")
    await page.wait_for_timeout(1200)  # the tables are drawn once a second
    await page.screenshot(path=path)


if __name__ == "__main__":
    asyncio.run(take(Path(sys.argv[1])))
