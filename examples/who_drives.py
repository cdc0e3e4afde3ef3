"""Take the robot over from its brain, give it back, and print who did what."""

import asyncio

import gigabrain_zenoh


async def main() -> None:
    async with gigabrain_zenoh.connect(source="my-script") as robot:
        print("drives:", (await robot.read_state()).gate.commander)
        taken = await robot.enable(take=True)  # the gate now obeys this script alone
        print("drives:", taken.gate.commander)
        await robot.drive(angular_z=0.5, seconds=0.5)
        given = await robot.enable("control", take=True)  # give it back to the brain
        print("drives:", given.gate.commander)
        for entry in await robot.audit(5):
            print(entry.what, entry.source, "-", entry.text)


asyncio.run(main())
