"""`gigabrain why`: why does it not move?"""

from gigabrain_zenoh.cli.where import HERE, Which, say
from gigabrain_zenoh.host.signals import run_async


def why(*, at: Which = HERE, json: bool = False) -> int:
    """Say why the robot does not move, and what to do about it.

    Example: gigabrain why

    Follows one command from link to link. Ends with 0 where nothing is broken: the robot moves, or
    waits for something, such as a goal. Else with the code of the link that is broken: 10 router,
    11 driver, 12 its link to the body, 13 scan, 14 world, 15 intent, 16 control, 17 safety,
    18 gate, 19 the body itself.

    Parameters
    ----------
    json
        For programs instead of people.
    """

    import msgspec

    from gigabrain_zenoh.diagnostics.hearing import NAME
    from gigabrain_zenoh.diagnostics.why import judge
    from gigabrain_zenoh.diagnostics.why_facts import Facts, Watcher
    from gigabrain_zenoh.errors import Ambiguous, BusError
    from gigabrain_zenoh.runtime.connect import joined

    async def look() -> Facts:
        try:
            async with joined(at.where(), NAME) as (bus, _):
                return await Watcher(bus).look()
        except Ambiguous:  # nothing is broken: it is not known which robot is meant
            raise
        except BusError as error:
            return Facts(router=str(error))

    verdict = judge(run_async(look()))
    broken, waits = verdict.broken, verdict.waits
    if json:
        told = {
            "broken": broken.link if broken else None,
            "waits": waits.text if waits and not verdict.moves else None,
            **msgspec.to_builtins(verdict),
        }
        say(msgspec.json.encode(told).decode())
        return verdict.exit_code
    for one in verdict.findings:
        word = "BROKEN" if not one.ok else "waits" if one.waits else "ok"
        say(f"  {one.link:<8} {word:<6}  {one.text}")
    for note in verdict.notes:
        say(f"  note: {note}")
    if broken:
        how = "It still moves, but not for long." if verdict.moves else "It does not move."
        say(f"{how} {broken.link}: {broken.text}.")
        say(f"What to do: {broken.remedy}.")
    elif waits and not verdict.moves:
        say(f"It stands, and nothing is broken: {waits.text}.")
        say(f"What to do: {waits.remedy}.")
    else:
        say("It moves.")
    return verdict.exit_code
