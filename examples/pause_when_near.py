"""Patrol between two places, but pause for as long as something is near.

Safety keeps the robot from touching anything by itself. This keeps a larger distance.
"""

import asyncio

import gigabrain_zenoh

NEAR_M, SCANS = 1.0, 100  # ten scans a second
PATROL = "do: [{patrol: {points: [[0, 0], [0.5, 0.3]]}}]"  # without `loops`: for ever


async def main() -> None:
    async with gigabrain_zenoh.connect() as robot:
        task = await robot.tasks.carry_out(PATROL, label="patrol")
        paused = False
        scans = 0
        async for world in robot.topic("world", timeout=5):
            near = min((one for one in world.sectors if one is not None), default=9.0)
            try:
                if near < NEAR_M and not paused:
                    print(f"{near:.2f} m: {await robot.tasks.pause(task)}")
                elif near >= NEAR_M and paused:
                    print(f"{near:.2f} m: {await robot.tasks.resume(task)}")
            except gigabrain_zenoh.Refused as error:  # the task has ended
                print(error)
                break
            paused = near < NEAR_M
            scans += 1
            if scans == SCANS:
                print(await robot.tasks.cancel(task))
                break


asyncio.run(main())
