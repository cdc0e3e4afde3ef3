"""`gigabrain topic` and `schema export`: messages on the bus, and their definitions."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from gigabrain_zenoh.cli.options import (
    LOCAL,
    Count,
    JsonLines,
    RobotAddress,
    Take,
    Topic,
    check_positive,
    print_line,
    print_table,
)
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.signals import run_async

if TYPE_CHECKING:
    from gigabrain_schemas import topics
    from gigabrain_schemas.base import Message


def list_(*, at: RobotAddress = LOCAL, all_topics: bool = False, json: JsonLines = False) -> int:
    """List topics: rate, size, age, senders and receivers.

    Example: gigabrain topic list

    Args:
        all_topics: Also list topics without senders and receivers.
    """
    import msgspec

    from gigabrain_zenoh.diagnostics.listener import CLIENT_NAME, snapshot, widest_pattern
    from gigabrain_zenoh.diagnostics.topics import rows, topic_table
    from gigabrain_zenoh.runtime.connect import joined

    async def run() -> None:
        where = at.where()
        async with joined(where, CLIENT_NAME) as (bus, _):
            found = await snapshot(bus, widest_pattern(where))
            listed = rows(found, bus.clock.now_ns(), all_topics=all_topics)
        if json:
            for row in listed:
                print_line(msgspec.json.encode(row).decode())
        else:
            print_table(topic_table(listed))

    run_async(run())
    return 0


def echo(
    topic: Topic,
    /,
    *,
    at: RobotAddress = LOCAL,
    fields: str = "",
    json: JsonLines = False,
    count: Count = None,
    within: float | None = None,
) -> int:
    """Print messages as they arrive; long arrays as minimum, median and maximum.

    Example: gigabrain topic echo state --fields tick,velocity.linear_x

    With --json arrays are whole; nan is null, and infinity "inf".

    Args:
        topic: Name such as scan or health/driver, key, or key expression such as "robot/*".
        fields: Dotted names of fields, separated by commas.
        count: End after this many messages.
        within: Exit with code 1 if no message arrives in this time [s].
    """
    from gigabrain_zenoh.diagnostics.listener import open_topic
    from gigabrain_zenoh.diagnostics.topics import EchoOptions
    from gigabrain_zenoh.diagnostics.topics import echo as run_echo

    check_positive(count=count, within=within)
    chosen = tuple(field.strip() for field in fields.split(",") if field.strip())
    options = EchoOptions(json=json, fields=chosen, count=count, within_s=within)

    async def run() -> int:
        async with open_topic(at.where(), topic, looks_on=True) as (bus, aim):
            return await run_echo(bus, aim, options, print_line)

    return run_async(run())


def hz(topic: Topic, /, *, at: RobotAddress = LOCAL, count: Count = None) -> int:
    """Measure rates and gaps of messages, one line per second.

    Example: gigabrain topic hz scan -n 5

    Args:
        topic: Name such as scan, or key expression such as "robot/*".
        count: End after this many seconds with messages.
    """
    return _measure("hz", topic, at, count)


def bw(topic: Topic, /, *, at: RobotAddress = LOCAL, count: Count = None) -> int:
    """Measure bandwidth and size of messages, one line per second.

    Example: gigabrain topic bw "robot/*" -n 1

    Args:
        topic: Name such as scan, or key expression such as "robot/*".
        count: End after this many seconds with messages.
    """
    return _measure("bw", topic, at, count)


def delay(topic: Topic, /, *, at: RobotAddress = LOCAL, count: Count = None) -> int:
    """Measure the delay of messages by the clocks of both hosts, one line per second.

    Example: gigabrain topic delay cmd_vel

    Args:
        topic: Name such as scan, or key expression such as "robot/*".
        count: End after this many seconds with messages.
    """
    return _measure("delay", topic, at, count)


def _measure(
    what: Literal["hz", "bw", "delay"], topic: str, at: RobotAddress, count: int | None
) -> int:
    from gigabrain_zenoh.diagnostics.listener import open_topic
    from gigabrain_zenoh.diagnostics.topics import measure

    check_positive(count=count)

    async def run() -> int:
        async with open_topic(at.where(), topic) as (bus, aim):
            return await measure(bus, aim, what, count, print_line)

    return run_async(run())


def info(topic: Topic, /, *, at: RobotAddress = LOCAL) -> int:
    """Describe one topic: message, promised rate, senders and receivers.

    Example: gigabrain topic info cmd_vel

    Args:
        topic: Name such as scan.
    """
    from gigabrain_zenoh.diagnostics.listener import open_topic, snapshot, widest_pattern
    from gigabrain_zenoh.diagnostics.topics import describe

    async def run() -> None:
        where = at.where()
        async with open_topic(where, topic) as (bus, aim):
            found = await snapshot(bus, widest_pattern(where))
            for line in describe(aim, found, bus.clock.now_ns()):
                print_line(line)

    run_async(run())
    return 0


def pub(
    name: Topic,
    /,
    *words: str,
    at: RobotAddress = LOCAL,
    rate: float | None = None,
    count: Count = None,
    take: Take = False,
) -> int:
    """Publish a message. On cmd_vel it drives the robot, then the brain drives again.

    Example: gigabrain topic pub cmd_vel linear_x=0.1 angular_z=0.3 --take

    A velocity lasts one second of the robot's time. With --rate it lasts until
    Ctrl-C, or for --count messages.

    Args:
        name: Name of the topic, such as cmd_vel.
        words: field=value, with dots for parts (pose.x=1), or one JSON object.
        rate: Publish at this rate [Hz], until Ctrl-C or --count.
        count: Number of messages.
    """
    from gigabrain_schemas.topics import CMD_VEL
    from gigabrain_zenoh.diagnostics.publishing import drive, parse_message
    from gigabrain_zenoh.diagnostics.topic_names import (
        COMMAND_OF_SERVICE,
        no_topic,
        short,
        target,
    )

    check_positive(rate=rate, count=count)
    aim = target(name)
    topic = aim.topic if aim else None
    invalid = "/" not in name or short(name) in COMMAND_OF_SERVICE
    if (aim and "*" in aim.pattern) or (topic is None and invalid):
        raise no_topic(name, ())
    if topic is None or topic is CMD_VEL:  # an unknown key may be the body's control topic
        seconds = None if rate and not count else (count or 1) / (rate or 1.0)
        print_line(run_async(drive(at.where(), name, words, seconds, take=take)))
        return 0
    process = name.rpartition("/")[2] if topic.many else ""
    run_async(_publish(at, topic, parse_message(topic, words), process, rate, count))
    return 0


async def _publish(
    at: RobotAddress,
    topic: "topics.Topic[Any]",
    message: "Message",
    process: str,
    rate: float | None,
    count: int | None,
) -> None:
    from gigabrain_zenoh.diagnostics.publishing import publish
    from gigabrain_zenoh.runtime.connect import joined

    async with joined(at.where(), "pub") as (bus, _):
        print_line(f"sent {await publish(bus, topic, message, rate, count, process)}")


def export(folder: Path) -> None:
    """Write JSON Schema of every message, and the tables of topics and services.

    Example: gigabrain schema export schemas/

    Args:
        folder: Folder to write to; it is created if missing.
    """
    from gigabrain_schemas.golden import export as write

    try:
        written = write(folder)
    except OSError as error:
        raise ConfigError(f"cannot write {folder}: {error.strerror}") from None
    print(f"{len(written)} files in {folder}")
