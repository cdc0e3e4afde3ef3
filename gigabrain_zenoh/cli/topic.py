"""`gigabrain topic`: what goes over the bus."""

from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from gigabrain_zenoh.cli.checked import above_zero
from gigabrain_zenoh.cli.live_names import topics
from gigabrain_zenoh.cli.where import HERE, Which, say, show
from gigabrain_zenoh.host.signals import run_async

if TYPE_CHECKING:
    from gigabrain_schemas.base import Message
    from gigabrain_schemas.topics import Topic

Name = Annotated[str, Parameter(completer=topics)]
Count = Annotated[int | None, Parameter(alias="-n")]


def list_(*, at: Which = HERE, all_topics: bool = False, json: bool = False) -> int:
    """List topics: rate, size and age, who sends them and who listens.

    Example: gigabrain topic list

    Parameters
    ----------
    all_topics
        Also those that nobody sends or hears.
    json
        One JSON object per line.
    """
    import msgspec

    from gigabrain_zenoh.diagnostics import topic_table
    from gigabrain_zenoh.diagnostics.hearing import NAME, everything, look
    from gigabrain_zenoh.runtime.connect import joined

    async def run() -> None:
        where = at.where()
        async with joined(where, NAME) as (bus, _):
            found = await look(bus, everything(where))
            rows = topic_table.rows(found, bus.clock.now_ns(), all_topics=all_topics)
        if json:
            for row in rows:
                say(msgspec.json.encode(row).decode())
        else:
            show(topic_table.table(rows))

    run_async(run())
    return 0


def echo(
    topic: Name,
    /,
    *,
    at: Which = HERE,
    fields: str = "",
    json: bool = False,
    count: Count = None,
    within: float | None = None,
) -> int:
    """Show messages as they come; long arrays as minimum, median and maximum.

    Example: gigabrain topic echo state --fields tick,velocity.linear_x

    Parameters
    ----------
    topic
        Its name, such as scan or health/driver, a key, or a key expression such as "robot/*".
    fields
        Dotted names with commas between them.
    json
        One JSON object per line, with whole arrays; nan is null, infinity "inf".
    count
        End after so many.
    within
        End with 1 when none has come after so long [s].
    """
    from gigabrain_zenoh.diagnostics.hearing import aimed
    from gigabrain_zenoh.diagnostics.topic_watch import Shown
    from gigabrain_zenoh.diagnostics.topic_watch import echo as run_echo

    above_zero("count", count)
    above_zero("within", within)
    chosen = tuple(field.strip() for field in fields.split(",") if field.strip())
    how = Shown(json=json, fields=chosen, count=count, within_s=within)

    async def run() -> int:
        async with aimed(at.where(), topic, looks_on=True) as (bus, aim):
            return await run_echo(bus, aim, how, say)

    return run_async(run())


def hz(topic: Name, /, *, at: Which = HERE, count: Count = None) -> int:
    """Measure how often messages come, and how evenly; a line a second.

    Example: gigabrain topic hz scan -n 5

    Parameters
    ----------
    topic
        Its name, such as scan, or a key expression such as "robot/*".
    count
        End after so many seconds in which something came.
    """
    return _measure("hz", topic, at, count)


def bw(topic: Name, /, *, at: Which = HERE, count: Count = None) -> int:
    """Measure how many bytes messages take; a line a second.

    Example: gigabrain topic bw "robot/*" -n 1

    Parameters
    ----------
    topic
        Its name, such as scan, or a key expression such as "robot/*".
    count
        End after so many seconds in which something came.
    """
    return _measure("bw", topic, at, count)


def delay(topic: Name, /, *, at: Which = HERE, count: Count = None) -> int:
    """Measure how long messages were on their way, by the clocks of both hosts; a line a second.

    Example: gigabrain topic delay cmd_vel

    Parameters
    ----------
    topic
        Its name, such as scan, or a key expression such as "robot/*".
    count
        End after so many seconds in which something came.
    """
    return _measure("delay", topic, at, count)


def _measure(what: Literal["hz", "bw", "delay"], topic: str, at: Which, count: int | None) -> int:
    from gigabrain_zenoh.diagnostics.hearing import aimed
    from gigabrain_zenoh.diagnostics.topic_watch import measure

    above_zero("count", count)

    async def run() -> int:
        async with aimed(at.where(), topic) as (bus, aim):
            return await measure(bus, aim, what, count, say)

    return run_async(run())


def info(topic: Name, /, *, at: Which = HERE) -> int:
    """Show all about one topic: its message, what is promised, who sends it and who listens.

    Example: gigabrain topic info cmd_vel

    Parameters
    ----------
    topic
        Its name, such as scan.
    """
    from gigabrain_zenoh.diagnostics.hearing import aimed, everything, look
    from gigabrain_zenoh.diagnostics.topic_table import about

    async def run() -> None:
        where = at.where()
        async with aimed(where, topic) as (bus, aim):
            found = await look(bus, everything(where))
            for line in about(aim, found, bus.clock.now_ns()):
                say(line)

    run_async(run())
    return 0


def pub(
    name: Name,
    /,
    *words: str,
    at: Which = HERE,
    rate: float | None = None,
    count: Count = None,
    take: bool = False,
) -> int:
    """Send a message. To cmd_vel it asks for the body, and gives it back at the end.

    Example: gigabrain topic pub cmd_vel linear_x=0.1 angular_z=0.3 --take

    A velocity lasts a second of the robot's time; with --rate, until Ctrl-C or for --count of them.

    Parameters
    ----------
    name
        Of the topic, such as cmd_vel.
    words
        field=value, with dots for parts (pose.x=1), or one JSON object.
    rate
        How often [Hz], until Ctrl-C or --count.
    count
        How many.
    take
        Even when somebody else drives, the robot's own brain included.
    """
    from gigabrain_schemas.topics import CMD_VEL
    from gigabrain_zenoh.diagnostics.names import COMMANDS, not_found, short, target
    from gigabrain_zenoh.diagnostics.publishing import drive, typed_in

    above_zero("rate", rate)
    above_zero("count", count)
    aim = target(name)
    topic = aim.topic if aim else None
    nothing = "/" not in name or short(name) in COMMANDS
    if (aim and "*" in aim.pattern) or (topic is None and nothing):
        raise not_found(name, ())
    if topic is None or topic is CMD_VEL:  # a key that is not ours may be what the body obeys
        seconds = None if rate and not count else (count or 1) / (rate or 1.0)
        say(run_async(drive(at.where(), name, words, seconds, take=take)))
        return 0
    of = name.rpartition("/")[2] if topic.many else ""
    run_async(_send(at, topic, typed_in(topic, words), of, rate, count))
    return 0


async def _send(
    at: Which,
    topic: "Topic[Any]",
    message: "Message",
    of: str,
    rate: float | None,
    count: int | None,
) -> None:
    """Send a message, of the process `of` where each has its own topic, and say how often."""
    from gigabrain_zenoh.diagnostics.publishing import send
    from gigabrain_zenoh.runtime.connect import joined

    async with joined(at.where(), "pub") as (bus, _):
        say(f"sent {await send(bus, topic, message, rate, count, of)}")
