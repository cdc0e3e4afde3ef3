"""`gigabrain topic` and `schema export`: messages on the bus, and their definitions."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from gigabrain_zenoh.cli.options import (
    LOCAL,
    Count,
    JsonLines,
    Lines,
    RobotAddress,
    Take,
    Topic,
    TopicName,
    check_positive,
    on_bus,
    print_json,
    print_line,
    print_table,
)
from gigabrain_zenoh.host.files import cannot_write
from gigabrain_zenoh.host.signals import run_async

if TYPE_CHECKING:
    from gigabrain_zenoh.bus.bus import Bus
    from gigabrain_zenoh.diagnostics.topics import TopicRow


def list_(*, at: RobotAddress = LOCAL, all_topics: bool = False, json: JsonLines = False) -> None:
    """List topics: rate, size, age, senders and receivers.

    Example: gigabrain topic list

    Args:
        all_topics: Also list topics without senders and receivers.
    """
    from gigabrain_zenoh.diagnostics.listener import snapshot, widest_pattern
    from gigabrain_zenoh.diagnostics.topics import rows, topic_table

    async def find(bus: "Bus") -> "list[TopicRow]":
        found = await snapshot(bus, widest_pattern(at.where()))
        return rows(found, bus.clock.now_ns(), all_topics=all_topics)

    listed = on_bus(at, find)
    if not json:
        print_table(topic_table(listed))
        return
    for row in listed:
        print_json(row)


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
        fields: Dotted names of fields, separated by commas.
        within: Exit with code 1 if no message arrives in this time [s].
    """
    from gigabrain_zenoh.diagnostics.listener import open_topic
    from gigabrain_zenoh.diagnostics.topics import EchoOptions
    from gigabrain_zenoh.diagnostics.topics import echo as run_echo

    check_positive(count=count, within=within)
    chosen = tuple(field.strip() for field in fields.split(",") if field.strip())
    options = EchoOptions(json=json, fields=chosen, count=count, within_s=within)

    async def run() -> int:
        async with open_topic(at.where(), topic, looks_on=True) as (bus, wanted):
            return await run_echo(bus, wanted, options, print_line)

    return run_async(run())


def hz(topic: Topic, /, *, at: RobotAddress = LOCAL, count: Lines = None) -> int:
    """Measure rates and gaps of messages, one line per second.

    Example: gigabrain topic hz scan -n 5
    """
    return _measure("hz", topic, at, count)


def bw(topic: Topic, /, *, at: RobotAddress = LOCAL, count: Lines = None) -> int:
    """Measure bandwidth and size of messages, one line per second.

    Example: gigabrain topic bw "robot/*" -n 1
    """
    return _measure("bw", topic, at, count)


def delay(topic: Topic, /, *, at: RobotAddress = LOCAL, count: Lines = None) -> int:
    """Measure the delay of messages by the clocks of both hosts, one line per second.

    Example: gigabrain topic delay cmd_vel
    """
    return _measure("delay", topic, at, count)


def _measure(
    what: Literal["hz", "bw", "delay"], topic: str, at: RobotAddress, count: int | None
) -> int:
    from gigabrain_zenoh.diagnostics.listener import open_topic
    from gigabrain_zenoh.diagnostics.topics import measure

    check_positive(count=count)

    async def run() -> int:
        async with open_topic(at.where(), topic) as (bus, wanted):
            return await measure(bus, wanted, what, count, print_line)

    return run_async(run())


def info(topic: TopicName, /, *, at: RobotAddress = LOCAL) -> None:
    """Describe one topic: message, promised rate, senders and receivers.

    Example: gigabrain topic info cmd_vel
    """
    from gigabrain_zenoh.diagnostics.listener import open_topic, snapshot, widest_pattern
    from gigabrain_zenoh.diagnostics.topics import describe

    async def run() -> None:
        where = at.where()
        async with open_topic(where, topic) as (bus, wanted):
            found = await snapshot(bus, widest_pattern(where))
            for line in describe(wanted, found, bus.clock.now_ns()):
                print_line(line)

    run_async(run())


def pub(
    name: TopicName,
    /,
    *words: str,
    at: RobotAddress = LOCAL,
    rate: float | None = None,
    count: Count = None,
    take: Take = False,
) -> None:
    """Publish a message. On cmd_vel it drives the robot, then the brain drives again.

    Example: gigabrain topic pub cmd_vel linear_x=0.1 angular_z=0.3 --take

    A velocity lasts one second of the robot's time. With --rate it lasts until
    Ctrl-C, or for --count messages.

    Args:
        words: field=value, with dots for parts (pose.x=1), or one JSON object.
        rate: Publish at this rate [Hz], until Ctrl-C or --count.
    """
    from gigabrain_schemas.topics import CMD_VEL
    from gigabrain_zenoh.diagnostics.discovery import (
        COMMAND_OF_SERVICE,
        short_name,
        topic_pattern,
        unknown_topic,
    )
    from gigabrain_zenoh.diagnostics.publishing import drive, parse_message, publish

    check_positive(rate=rate, count=count)
    wanted = topic_pattern(name)
    topic = wanted.topic if wanted else None
    invalid = "/" not in name or short_name(name) in COMMAND_OF_SERVICE
    if (wanted and "*" in wanted.pattern) or (topic is None and invalid):
        raise unknown_topic(name, ())
    if topic is None or topic is CMD_VEL:  # an unknown key may be the body's control topic
        seconds = None if rate and not count else (count or 1) / (rate or 1.0)
        print_line(run_async(drive(at.where(), name, words, seconds, take=take)))
        return
    process = name.rpartition("/")[2] if topic.many else ""
    message = parse_message(topic, words)
    sent = on_bus(at, lambda bus: publish(bus, topic, message, rate, count, process), "pub")
    print_line(f"sent {sent}")


def export(folder: Path) -> None:
    """Write JSON Schema of every message, and the tables of topics and services.

    Example: gigabrain schema export schemas/

    Args:
        folder: Folder to write to; it is created if missing.
    """
    from gigabrain_schemas.examples import export as write

    try:
        written = write(folder)
    except OSError as error:
        raise cannot_write(folder, error) from None
    print(f"{len(written)} files in {folder}")
