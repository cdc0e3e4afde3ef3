"""The router names a process of one's own that is silent, and why it ended."""

from msgspec.structs import replace

from gigabrain_schemas.examples import example
from gigabrain_schemas.safety import Health, LogRecord
from gigabrain_schemas.topics import HEALTH, LOG
from gigabrain_zenoh.runtime.process_watch import ProcessWatch
from gigabrain_zenoh.testing.in_memory import Net

SECOND_NS = 1_000_000_000


def problems(pair: Net, watch: ProcessWatch) -> list[str]:
    watch.look()
    return [one.text for one in pair.one.problems]


async def live(pair: Net, seconds: int, name: str = "mine") -> None:
    for _ in range(seconds):
        pair.two.publish(HEALTH, replace(example(Health), process=name), name=name)
        await pair.clock.advance(SECOND_NS)


async def test_one_that_never_starts_is_named_once_it_had_time_to() -> None:
    pair = Net()
    watch = ProcessWatch(pair.one, ("mine",))
    await live(pair, 19, "others")
    assert problems(pair, watch) == []
    await live(pair, 2, "others")
    assert problems(pair, watch) == ["mine is silent: it hangs or does not run"]
    await live(pair, 1)
    assert problems(pair, watch) == []


async def test_one_that_ends_is_named_with_the_reason_until_it_is_back() -> None:
    pair = Net()
    watch = ProcessWatch(pair.one, ("mine",))
    await live(pair, 3)
    text = "died of KeyError: 'x', in node.py:11"
    pair.two.publish(LOG, LogRecord(process="mine", level="critical", event="died", text=text))
    await pair.clock.advance(3 * SECOND_NS)
    assert problems(pair, watch) == [f"mine {text}"]
    assert pair.one.problems[0].remedy == "read its log with `gigabrain log --process mine`"
    pair.two.publish(LOG, LogRecord(process="mine", level="info", event="ready", text="ready"))
    await live(pair, 1)
    assert problems(pair, watch) == []
    await pair.clock.advance(4 * SECOND_NS)
    assert problems(pair, watch) == ["mine is silent: it hangs or does not run"]


async def test_without_processes_of_ones_own_nothing_is_subscribed() -> None:
    pair = Net()
    ProcessWatch(pair.one, ())
    assert pair.one.listens == []
