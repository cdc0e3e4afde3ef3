"""`gigabrain param`: what may be changed while the robot runs."""

import asyncio
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from gigabrain_zenoh.cli.live_names import processes
from gigabrain_zenoh.cli.where import HERE, Which, say
from gigabrain_zenoh.errors import BodyLost, Refused, unknown
from gigabrain_zenoh.host.signals import run_async

if TYPE_CHECKING:
    from gigabrain_schemas.requests import Param, ParamReply

Process = Annotated[str, Parameter(completer=processes)]


def list_(process: Process = "", /, *, at: Which = HERE) -> int:
    """List what may be changed while the robot runs: value, and what it may be.

    Example: gigabrain param list decision

    Parameters
    ----------
    process
        Of this one only.
    """
    for name, reply in sorted(run_async(_ask(at, process, "", "")).items()):
        for one in reply.params:
            say(f"{name:<12} {one.name:<14} {one.value:<10} {one.expected}")
    return 0


def get(process: Process, name: str, /, *, at: Which = HERE) -> int:
    """Show one value.

    Example: gigabrain param get decision max_linear_speed

    Parameters
    ----------
    process
        Whose.
    name
        Of the parameter.
    """
    reply = run_async(_ask(at, process, "", ""))[process]
    say(_named(reply.params, name).value)
    return 0


def set_(process: Process, name: str, value: str, /, *, at: Which = HERE) -> int:
    """Change one value, until the process ends.

    Example: gigabrain param set decision max_linear_speed 0.15

    Parameters
    ----------
    process
        Whose.
    name
        Of the parameter.
    value
        What it should be.
    """
    reply = run_async(_ask(at, process, name, value))[process]
    if not reply.ok:
        raise Refused(f"{process}: {reply.text}")
    say(f"{process}: {reply.text}")
    return 0


def _named(params: "tuple[Param, ...]", name: str) -> "Param":
    found = {one.name: one for one in params}
    if name not in found:
        raise unknown("parameter", name, found)
    return found[name]


async def _ask(at: Which, process: str, name: str, value: str) -> "dict[str, ParamReply]":
    """What one process answers, or all of them."""
    import getpass

    from gigabrain_schemas.requests import ParamRequest
    from gigabrain_schemas.topics import PARAM
    from gigabrain_zenoh.diagnostics.hearing import NAME
    from gigabrain_zenoh.diagnostics.roll_call import roll_call
    from gigabrain_zenoh.runtime.connect import joined

    request = ParamRequest(name=name, value=value, source=getpass.getuser())
    async with joined(at.where(), NAME) as (bus, _):
        there = await roll_call(bus)
        if process and process not in there:
            raise unknown("process", process, there)
        wanted = [process] if process else list(there)
        told = await asyncio.gather(*(bus.ask(PARAM, request, name=each) for each in wanted))
    replies = {each: some[0] for each, some in zip(wanted, told, strict=True) if some}
    if not replies or (process and process not in replies):
        raise BodyLost(f"{process or 'nobody'} does not answer; may your keys ask for it?")
    return replies
