"""Visit places in turn: each goal waits in the queue until the one before has ended."""

import asyncio

import gigabrain_zenoh

PLACES = {"start": (0.0, 0.0), "left": (0.3, 0.4), "right": (0.3, -0.4)}  # in the map [m]


async def main() -> None:
    async with gigabrain_zenoh.connect() as robot:
        await robot.tasks.cancel("all")
        names = {}
        for place, (x, y) in PLACES.items():
            try:
                names[place] = await robot.tasks.go_to(x, y, how="queue")
            except gigabrain_zenoh.Refused as error:  # for example inside an obstacle
                print(f"{place}: {error}")
        for place, name in names.items():
            ended = await robot.tasks.result(name)
            print(f"{place}: {ended.state}, {ended.reason}")


asyncio.run(main())
