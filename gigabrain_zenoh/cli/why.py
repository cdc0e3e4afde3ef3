"""`gigabrain why`: why does it not move?"""

from gigabrain_zenoh.cli.where import HERE, Which, say


def why(*, at: Which = HERE, json: bool = False) -> int:
    """Say why the robot does not move: the first link that is broken, and what to do about it.

    Example: gigabrain why

    Follows one command from link to link. Ends with 0 where the robot moves, else with 10 router,
    11 driver, 12 its link to the body, 13 scan, 14 world, 15 intent, 16 control, 17 safety,
    18 gate, 19 the body itself.

    Parameters
    ----------
    json
        For programs instead of people.
    """
    import asyncio

    import msgspec

    from gigabrain_zenoh.errors import BusError
    from gigabrain_zenoh.recording.joining import joined
    from gigabrain_zenoh.tools.hearing import NAME
    from gigabrain_zenoh.tools.why import judge
    from gigabrain_zenoh.tools.why_facts import Facts, Watcher

    async def look() -> Facts:
        try:
            async with joined(at.where(), NAME) as (bus, _):
                return await Watcher(bus).look()
        except BusError as error:
            return Facts(router=str(error))

    verdict = judge(asyncio.run(look()))
    broken = verdict.broken
    if json:
        told = {"broken": broken.link if broken else None, **msgspec.to_builtins(verdict)}
        say(msgspec.json.encode(told).decode())
        return verdict.exit_code
    for one in verdict.findings:
        say(f"  {one.link:<8} {'ok    ' if one.ok else 'BROKEN'}  {one.text}")
    for note in verdict.notes:
        say(f"  note: {note}")
    if broken:
        still = verdict.findings[-1].link == "body" and verdict.findings[-1].ok
        how = "It still moves, but not for long." if still else "It does not move."
        say(f"{how} {broken.link}: {broken.text}.")
        say(f"What to do: {broken.remedy}.")
    else:
        say("It moves.")
    return verdict.exit_code
