"""`gigabrain doctor`: what is wrong here, and the cure."""

from gigabrain_zenoh.cli.where import HERE, Which, say
from gigabrain_zenoh.host.signals import run_async

MARKS = {"ok": "ok  ", "hint": "hint", "bad": "BAD "}


def doctor(*, at: Which = HERE, json: bool = False) -> int:
    """Check this machine and the robot that can be reached, and say what to do.

    Example: gigabrain doctor

    Ends with 1 where something is bad; a hint is no fault.

    Parameters
    ----------
    json
        One JSON object per line.
    """

    import msgspec

    from gigabrain_zenoh.diagnostics.doctor import examine, exit_code
    from gigabrain_zenoh.diagnostics.doctor_facts import this_machine, this_robot

    robot, keys = run_async(this_robot(at.where()))
    findings = examine(this_machine(keys), robot)
    for one in findings:
        if json:
            say(msgspec.json.encode(one).decode())
            continue
        say(f"{MARKS[one.grade]}  {one.about:<14} {one.text}")
        if one.cure:
            say(f"      {'':<14} -> {one.cure}")
    return exit_code(findings)
