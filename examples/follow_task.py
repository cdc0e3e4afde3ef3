"""Send a goal without waiting for it, and watch the task: its step and what is left."""

import asyncio

import gigabrain_zenoh


async def main() -> None:
    async with gigabrain_zenoh.connect() as robot:
        name = await robot.tasks.go_to(0.4, -0.3)
        shown = ""

        def show(status) -> None:  # called five times a second
            nonlocal shown
            left = status.distance_remaining
            text = status.doing if left is None else f"{status.doing}, {left:.1f} m left"
            if text != shown:
                print(text)
            shown = text

        ended = await robot.tasks.result(name, show)
        print(ended.label, ended.state, "-", ended.reason)


asyncio.run(main())
