"""Topics and messages in the tools: names, rates, summaries of arrays, and typed messages."""

import asyncio
import json
import math
import subprocess
import sys
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import CmdVel, OccupancyGrid, WorldModel
from gigabrain_schemas.examples import EXAMPLES, example
from gigabrain_schemas.requests import DescribeRequest, Description
from gigabrain_schemas.sensors import Image, LaserScan
from gigabrain_schemas.topics import CMD_VEL, DESCRIBE, INTENT, SCAN, SERVICES, STATE, TOPICS, WORLD
from gigabrain_zenoh import codec
from gigabrain_zenoh.diagnostics.discovery import (
    Flow,
    TopicPattern,
    discover,
    find_processes,
    flows,
    topic_pattern,
    unknown_topic,
)
from gigabrain_zenoh.diagnostics.listener import MAX_QUEUED, RawMessage, messages, snapshot
from gigabrain_zenoh.diagnostics.message_text import (
    as_json,
    in_a_line,
    lines,
    pick,
    read,
    summary,
    tree,
)
from gigabrain_zenoh.diagnostics.publishing import parse_message
from gigabrain_zenoh.diagnostics.topic_stats import TopicMonitor
from gigabrain_zenoh.diagnostics.topics import (
    EchoOptions,
    describe,
    echo,
    message_lines,
    rows,
    stats_text,
)
from gigabrain_zenoh.errors import BodyLost, ConfigError, Refused, UnknownName
from gigabrain_zenoh.runtime.services import NameClaim, publish_health
from gigabrain_zenoh.testing.in_memory import Net
from gigabrain_zenoh.testing.waiting import settle

WITHOUT_RECORDING = """
import sys
sys.modules |= dict.fromkeys(("mcap", "foxglove", "zstandard", "lz4"))
from gigabrain_zenoh.diagnostics import discovery, doctor, log_reader, publishing
from gigabrain_zenoh.diagnostics import top, topics, why
"""
SCAN_BYTES = codec.encode(example(LaserScan))


def test_the_tools_need_no_package_for_recordings() -> None:
    subprocess.run([sys.executable, "-c", WITHOUT_RECORDING], check=True)


@pytest.mark.parametrize(
    ("name", "pattern", "of"),
    [
        ("scan", "robot/scan", SCAN),
        ("robot/scan", "robot/scan", SCAN),
        ("health", "robot/health/*", next(t for t in TOPICS if t.key == "robot/health")),
        (
            "health/driver",
            "robot/health/driver",
            next(t for t in TOPICS if t.key == "robot/health"),
        ),
        ("robot/*", "robot/*", None),
        ("weather/today", "weather/today", None),
    ],
)
def test_topics_are_found_by_the_names_that_people_use(name: str, pattern: str, of: object) -> None:
    assert topic_pattern(name, {"weather/today"}) == TopicPattern(pattern, of)  # type: ignore[arg-type]


def test_an_unknown_topic_is_answered_with_the_nearest_that_is_alive() -> None:
    assert topic_pattern("wether/today", {"weather/today"}) is None
    assert "did you mean 'weather/today'" in str(unknown_topic("wether/today", {"weather/today"}))
    assert "did you mean 'cmd_vel'" in str(unknown_topic("cmdvel", ()))
    for service in SERVICES:
        assert "is a service, not a topic; use: gigabrain " in str(unknown_topic(service.key, ()))


@pytest.mark.parametrize("name", ["robot/scan*", "robot/sc*an", "health/dr*", "health/dr?ver"])
def test_a_wrong_key_expression_is_refused_before_zenoh_gets_it(name: str) -> None:
    with pytest.raises(ConfigError, match="expected a key expression, got 'robot/"):
        topic_pattern(name)


def test_an_old_name_of_a_topic_still_finds_it() -> None:
    for old, new in (("granted", "request_log"), ("robot/heard/driver", "input_log/driver")):
        assert topic_pattern(old) == topic_pattern(new) is not None


def monitor_of(
    times_ms: list[float], size: int = 4, delay_ms: float = 3.0
) -> tuple[TopicMonitor, int]:
    """Return a monitor that received messages at these times, and the time of the last."""
    now = [0]
    monitor = TopicMonitor(lambda: now[0], lambda: now[0])
    for i, at in enumerate(times_ms, 1):
        now[0] = round(at * 1e6)
        message = CmdVel(
            linear_x=0.0, source="x" * size, seq=i, stamp_ns=round((at - delay_ms) * 1e6)
        )
        monitor.add("robot/cmd_vel", "", codec.encode(message))
    return monitor, now[0]


def test_the_number_of_counted_keys_is_bounded() -> None:
    monitor = TopicMonitor()
    monitor.add("robot/scan", "", b"")
    for n in range(10_000):
        monitor.add(f"robot/{n}", "", b"")
    monitor.add("robot/scan", "", b"")
    assert len(monitor.streams()) == 1000
    assert len(monitor.streams()["robot/scan"].arrivals) == 2


def test_rates_gaps_and_delays_are_those_of_the_arrivals() -> None:
    monitor, _ = monitor_of([100, 120, 140, 160, 220])
    figures = monitor.stats(0)["robot/cmd_vel"]
    assert figures.count == 5
    assert figures.hz == pytest.approx(4 / 0.12)
    assert (figures.gap_min_ms, figures.gap_max_ms) == (20.0, 60.0)
    assert figures.gap_std_ms == pytest.approx(17.3205, abs=1e-3)
    assert (figures.delay_min_ms, figures.delay_median_ms, figures.delay_max_ms) == (3.0, 3.0, 3.0)
    assert figures.bytes_s == pytest.approx(figures.size * 5 / 0.22)
    assert stats_text("hz", figures, CMD_VEL) == (
        "33.33 Hz  promised 50  gap min 20.0 ms  max 60.0  std 17.3"
    )
    assert stats_text("delay", figures, None) == "delay median 3.00 ms  min 3.00  max 3.00"


def test_only_what_came_lately_counts_and_silence_has_no_figures() -> None:
    monitor, now = monitor_of([100, 1200])
    assert monitor.stats(round(1e9))["robot/cmd_vel"].count == 1
    assert monitor.stats(now) == {}
    assert monitor.streams()["robot/cmd_vel"].age_s(now + 10**9) == 1.0


def test_messages_that_never_came_are_counted() -> None:
    monitor, _ = monitor_of([100])
    monitor.add("robot/cmd_vel", "", codec.encode(CmdVel(linear_x=0.0, source="xxxx", seq=5)))
    assert monitor.missing("robot/cmd_vel") == 3


def test_arrays_are_summarised_and_what_is_no_number_is_counted() -> None:
    told = summary(np.array([1.0, 3.0, 2.0, np.nan, np.inf, -np.inf]))
    assert str(told) == "6 values, min 1, median 2, max 3, 1 nan, 2 inf"
    assert str(summary([])) == "0 values"
    assert str(summary([math.nan])) == "1 values, 1 nan"


def test_a_scan_is_shown_in_words_and_whole_in_json() -> None:
    assert read("robot/scan", SCAN_BYTES, whole=False)["ranges"].nan == 1
    text = list(message_lines(RawMessage("robot/scan", SCAN_BYTES), EchoOptions()))
    assert text[0] == "--- robot/scan"
    assert "ranges: 8 values, min 0.83, median 1.25, max 3.49, 1 nan, 2 inf" in text
    (line,) = message_lines(RawMessage("robot/scan", SCAN_BYTES), EchoOptions(json=True))
    ranges = json.loads(line)["ranges"]
    assert [round(r, 2) if isinstance(r, float) else r for r in ranges] == [
        0.83, 1.25, 3.49, "inf", "inf", None, 2.5, 0.9,
    ]  # fmt: skip


def test_a_picture_is_never_printed_whole() -> None:
    told = tree(example(Image), whole=True)
    assert told["data"].count == 6
    grid = tree(example(OccupancyGrid), whole=True)
    assert grid["cells"] == [0, 0, 100, -1, 0, 37, 100, -1]


@pytest.mark.parametrize("name", sorted(EXAMPLES))
def test_every_message_can_be_shown(name: str) -> None:
    for whole in (False, True):
        value = tree(EXAMPLES[name], whole=whole)
        assert list(lines(value))
        assert json.loads(as_json(value)).keys() == value.keys()


@given(st.binary(max_size=200), st.sampled_from(["robot/scan", "somebody/else"]))
def test_nothing_that_comes_can_break_the_display(payload: bytes, key: str) -> None:
    for how in (EchoOptions(), EchoOptions(json=True)):
        for line in message_lines(RawMessage(key, payload), how):
            assert "\n" not in line
            assert "\x1b" not in line


def test_foreign_messages_are_shown_as_far_as_they_can_be_read() -> None:
    assert read("theirs", b'{"a": 1}', whole=False) == {"a": 1}
    assert read("theirs", msgspec.msgpack.encode({"a": 1}), whole=False) == {"a": 1}
    assert read("theirs", b"hello", whole=False) == {"raw": "hello"}
    assert read("theirs", bytes([255, 1]), whole=False) == {"raw": "ff 01"}
    told = read("robot/scan", b"hello", whole=False)
    assert told["invalid"].startswith("not a valid LaserScan")


def test_fields_are_picked_by_dotted_names() -> None:
    value = tree(example(RobotState), whole=False)
    assert pick(value, ("velocity.linear_x", "joints.0.name", "joints.9.name")) == {
        "velocity.linear_x": 0.198,
        "joints.0.name": "wheel_left_joint",
        "joints.9.name": None,
    }
    without = tree(msgspec.structs.replace(example(RobotState), battery=None), whole=False)
    assert pick(without, ("battery.percentage",)) == {"battery.percentage": None}
    with pytest.raises(UnknownName, match=r"no field 'velocity.linar_x'; did you mean 'velocity"):
        pick(value, ("velocity.linar_x",))
    assert in_a_line({"a": [1.5, None, True]}) == "{a: [1.5, -, true]}"


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["linear_x=0.1", "source=me"], CmdVel(linear_x=0.1, source="me")),
        (["linear_x=-1", "angular_z=2e-1"], CmdVel(linear_x=-1, angular_z=0.2)),
        (['{"linear_x": 0.5}'], CmdVel(linear_x=0.5)),
    ],
)
def test_what_is_typed_becomes_a_message(words: list[str], expected: CmdVel) -> None:
    assert parse_message(CMD_VEL, words) == expected


def test_parts_lists_and_texts_can_be_typed() -> None:
    words = ["behaviour=by_hand", "reason=on and on", "twist.linear_x=1", "trajectory=[[1,0,0,0]]"]
    made: Any = parse_message(INTENT, words)
    assert (made.twist.linear_x, made.reason, len(made.trajectory)) == (1.0, "on and on", 1)


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["liner_x=1"], "no field of CmdVel 'liner_x'; did you mean 'linear_x'?"),
        (["linear_x"], "'linear_x': expected field=value, or one JSON object"),
        (["linear_x=fast"], "linear_x: expected a number, got a string"),
        (["linear_x=nan"], "linear_x: expected a number, got a string"),
        (["linear_x=1e30"], "linear_x: expected a number <= 100.0"),
        (["{linear_x: 1}"], "not JSON"),
        ([], "missing required field `linear_x`"),
        (["linear_x=1", "linear_x.a=2"], "'linear_x.a=2': linear_x already has a value"),
    ],
)
def test_what_is_mistyped_is_answered_with_what_was_expected(
    words: list[str], complaint: str
) -> None:
    with pytest.raises(ConfigError) as refused:
        parse_message(CMD_VEL, words)
    assert complaint in str(refused.value)


@pytest.fixture
async def net() -> Net:
    return Net()


async def test_echo_shows_what_comes_and_ends_after_so_many(net: Net) -> None:
    out: list[str] = []
    how = EchoOptions(count=2, fields=("linear_x",))
    work = asyncio.ensure_future(
        echo(net.one, TopicPattern("robot/cmd_vel", CMD_VEL), how, out.append)
    )
    await settle()
    for speed in (0.1, 0.2, 0.3):
        net.two.publish(CMD_VEL, CmdVel(linear_x=speed))
    assert await work == 0
    assert out == ["linear_x=0.1", "linear_x=0.2"]


async def test_a_process_that_refuses_to_answer_hides_no_other(net: Net) -> None:
    async def refuse(_: DescribeRequest) -> Description:
        raise Refused("too many others ask for robot/describe/one; try again")

    net.one.serve(DESCRIBE, refuse, name="one")
    await NameClaim(net.two).acquire()
    assert list(await discover(net.one)) == ["two"]


async def test_echo_reports_a_silent_topic_after_its_time_limit(net: Net) -> None:
    await NameClaim(net.two).acquire()
    how = EchoOptions(within_s=0.01)
    with pytest.raises(BodyLost) as told:
        await echo(net.one, TopicPattern("robot/world", WORLD), how, lambda _: None)
    assert "robot/world (senders: none; receivers: none)" in str(told.value)


async def test_a_field_that_is_not_there_ends_echo_with_the_nearest(net: Net) -> None:
    how = EchoOptions(fields=("linar_x",))
    work = asyncio.ensure_future(echo(net.one, TopicPattern("robot/cmd_vel", CMD_VEL), how, print))
    await settle()
    net.two.publish(CMD_VEL, CmdVel(linear_x=0.1))
    with pytest.raises(UnknownName, match="did you mean 'linear_x'"):
        await work


async def test_the_table_names_senders_receivers_sizes_and_strangers(net: Net) -> None:
    net.one.subscribe(STATE, lambda *_: None)
    await NameClaim(net.one).acquire()
    await NameClaim(net.two).acquire()
    looking = asyncio.ensure_future(snapshot(net.bus("tool"), seconds=0.05))
    await settle()
    net.two.publish(STATE, example(RobotState))
    net.network.deliver("weather/today", b"rain")
    found = await looking
    told = {row.key: row for row in rows(found, net.clock.now_ns())}
    assert (told["robot/state"].senders, told["robot/state"].receivers) == (("two",), ("one",))
    assert (told["robot/state"].type, told["robot/state"].promised_hz) == ("RobotState", 50)
    assert (told["weather/today"].type, told["weather/today"].size) == (None, 4)
    text = list(describe(TopicPattern("robot/state", STATE), found, net.clock.now_ns()))
    assert text[0] == "robot/state"
    assert any("from two to one" in line for line in text)
    assert any("joints: tuple[Joint, ...]" in line for line in text)


async def test_flows_are_what_really_goes_from_one_to_another(net: Net) -> None:
    net.one.subscribe(STATE, lambda *_: None)
    net.one.subscribe(SCAN, lambda *_: None)
    for bus in (net.one, net.two):
        await NameClaim(bus).acquire()
    health = asyncio.ensure_future(publish_health(net.two))
    await net.clock.advance(0)
    for _ in range(10):
        net.two.publish(SCAN, example(LaserScan))
    net.two.publish(WORLD, example(WorldModel))  # which nobody hears
    counting = asyncio.ensure_future(find_processes(net.bus("tool"), 0.05))
    await net.clock.advance(0)
    await net.clock.advance(10**9)
    nodes = await counting
    health.cancel()
    found = flows(nodes.described.values(), nodes.health)
    assert found == [Flow("two", "robot/scan", "one", 10.0)]


async def test_what_arrives_while_the_output_blocks_is_held_up_to_a_bound() -> None:
    freed: list[int] = []

    class Payload(bytes):
        def __del__(self) -> None:
            freed.append(1)

    net = Net()
    shown = messages(net.one, TopicPattern("robot/image/front", None))
    first = asyncio.ensure_future(anext(shown))
    await settle()
    for number in range(MAX_QUEUED + 744):  # the loop does not run meanwhile: its output blocks
        net.network.deliver("robot/image/front", Payload(b"%d" % number))
    assert len(freed) == 744
    assert await first == 744
    assert await anext(shown) == RawMessage("robot/image/front", b"744")
    await net.one.close()
    await net.two.close()
