"""Bounded memory for names that other processes choose."""

from msgspec.structs import replace

from gigabrain_schemas.examples import EXAMPLES
from gigabrain_schemas.safety import Health
from gigabrain_schemas.topics import BODY, HEALTH
from gigabrain_zenoh.bus.input_log import MAX_KEYS, PublishedInputLogger
from gigabrain_zenoh.host.bounded import put_newest
from gigabrain_zenoh.safety.health import Host
from gigabrain_zenoh.safety.node import InputCollector
from gigabrain_zenoh.testing.in_memory import Net
from gigabrain_zenoh.testing.samples import WAFFLE, body
from gigabrain_zenoh.testing.waiting import settle
from gigabrain_zenoh.ui.page.frames import PageView
from gigabrain_zenoh.ui.run_report import RunMonitor


def health(name: str) -> Health:
    one = EXAMPLES["Health"]
    assert isinstance(one, Health)
    return replace(one, process=name)


def test_the_oldest_gives_way() -> None:
    held: dict[str, int] = {}
    for n, key in enumerate("abcad"):
        put_newest(held, key, n, 3)
    assert held == {"c": 2, "a": 3, "d": 4}


def test_an_input_log_keeps_the_newest_number_of_so_many_keys() -> None:
    input_log = PublishedInputLogger(lambda _: None, lambda: 0)
    for n in range(10_000):
        input_log.note(f"robot/health/{n}", 1)
    assert len(input_log._last) == MAX_KEYS == 512


async def test_who_watches_keeps_the_health_of_64_processes() -> None:
    net, told = Net(), list[str]()
    watch, scene = RunMonitor(net.one), PageView(net.one, lambda slot, _frame: told.append(slot))
    for n in range(500):
        net.two.publish(HEALTH, health(f"stranger-{n}"), name=f"stranger-{n}")
    net.two.publish(HEALTH, health("driver"), name="driver")
    await settle()
    assert len(watch.health) == 64
    assert "driver" in watch.health
    assert len([slot for slot, _ in scene.kept_frames() if slot.startswith("health/")]) == 64


async def test_safety_listens_to_one_other_control_topic_at_a_time() -> None:
    net = Net()
    InputCollector(net.one, lambda _: None, lambda _now: Host())
    before = len(net.one.listens)
    for n in range(50):
        net.two.publish(BODY, body(replace(WAFFLE, control_topic=f"robot/cmd_{n}")))
    await settle()
    assert len(net.one.listens) == before + 1
    net.two.publish(BODY, body())
    await settle()
    assert len(net.one.listens) == before
