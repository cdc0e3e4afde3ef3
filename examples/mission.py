"""Run a mission that is written in the program: a behaviour tree in YAML."""

import asyncio

import gigabrain_zenoh

MISSION = """
places: {here: [0.0, 0.0], there: [0.4, 0.0]}
do:
  - timeout:
      seconds: 120
      do:
        - goto: there
        - wait: 1
        - fallback: [{check: battery.percentage > 99.9}, {goto: here}]
"""


async def main() -> None:
    async with gigabrain_zenoh.connect() as robot:
        name = await robot.tasks.carry_out(MISSION, label="there and back")
        seen = set()

        def show(status) -> None:
            if status.doing and status.doing not in seen:
                seen.add(status.doing)
                print(status.doing)

        ended = await robot.tasks.result(name, show)
        print(ended.state, "-", ended.reason)


asyncio.run(main())
