"""`top`, `graph`, `node`, `log` and `param`, without a robot beside them."""

import asyncio
import json
import logging
from collections.abc import Iterator
from pathlib import Path

import pytest
from msgspec.structs import replace
from rich.text import Text
from textual.widgets import DataTable

from gigabrain_schemas.examples import example
from gigabrain_schemas.requests import Description, ParamReply, ParamRequest
from gigabrain_schemas.safety import Health, LogRecord
from gigabrain_schemas.topics import LOG, PARAM
from gigabrain_zenoh.config.settings import DecisionConfig, Endpoint
from gigabrain_zenoh.decision import node as decision
from gigabrain_zenoh.diagnostics import log_reader
from gigabrain_zenoh.diagnostics.discovery import (
    Flow,
    Processes,
    chain_flows,
    describe,
    graph_as_dot,
    graph_as_mermaid,
    graph_as_text,
    graph_positions,
    write_graph_png,
)
from gigabrain_zenoh.diagnostics.log_reader import (
    Line,
    LogFilter,
    ago_ns,
    as_line,
    follow_log,
    read,
    run_folder,
)
from gigabrain_zenoh.diagnostics.top import (
    PROCESS_COLUMNS,
    TOPIC_COLUMNS,
    Rows,
    cell_text,
    process_cells,
    sorted_rows,
    sparkline,
    topic_cells,
)
from gigabrain_zenoh.diagnostics.top_app import TopApp
from gigabrain_zenoh.errors import ConfigError, Refused, UnknownName
from gigabrain_zenoh.host.run_folders import hold
from gigabrain_zenoh.runtime.running import announced
from gigabrain_zenoh.runtime.services import serve_params
from gigabrain_zenoh.testing.in_memory import Net

FLOWS = [
    Flow("control", "robot/cmd_vel", "driver", 50.0),
    Flow("driver", "robot/health/driver", "safety", 1.0),
    Flow("driver", "robot/scan", "perception", 10.0),
    Flow("driver", "robot/scan", "safety", 10.0),
]


def test_the_graph_is_drawn_as_text_for_graphviz_and_for_mermaid() -> None:
    found = chain_flows(FLOWS)
    assert list(graph_as_text(found)) == [
        "control",
        "  cmd_vel       50.0 Hz  -> driver",
        "driver",
        "  scan          10.0 Hz  -> perception, safety",
    ]
    assert '  "control" -> "driver" [label="cmd_vel 50 Hz"];' in graph_as_dot(found)
    assert '  control["control"] -->|"cmd_vel 50 Hz"| driver["driver"]' in graph_as_mermaid(found)
    assert len(chain_flows(FLOWS, everything=True)) == 4


def test_the_graph_is_drawn_into_a_picture(tmp_path: Path) -> None:
    write_graph_png(FLOWS, tmp_path / "graph.png")
    assert (tmp_path / "graph.png").read_bytes()[:4] == b"\x89PNG"
    with pytest.raises(ConfigError, match="no such file"):
        write_graph_png(FLOWS, tmp_path / "nowhere" / "graph.png")
    assert list(graph_positions(["safety", "tool", "driver"])) == ["driver", "safety", "tool"]


def test_a_node_is_described_with_what_it_sends_and_counts() -> None:
    nodes = Processes(
        {"driver": example(Description)}, {"driver": replace(example(Health), process="driver")}
    )
    text = "\n".join(describe(nodes, "driver"))
    assert text.startswith("driver: version 0.1.0, pid 4710 on waffle")
    assert "scan_to_world_p50" in text
    with pytest.raises(UnknownName, match="did you mean 'driver'"):
        list(describe(nodes, "drivr"))


class Feed:
    """Two processes and two topics."""

    def refresh(self) -> tuple[Rows, Rows]:
        calm = process_cells(replace(example(Health), process="calm", cpu=0.01), 0.5)
        busy = process_cells(replace(example(Health), process="busy", cpu=0.9), 9.0)
        scan = topic_cells("robot/scan", None, 0.5, 0)
        pose = topic_cells("robot/pose", None, 1.5, 3)
        return {"calm": calm, "busy": busy}, {"robot/scan": scan, "robot/pose": pose}


def column(table: DataTable[Text], index: int) -> list[str]:
    return [table.get_row_at(row)[index].plain for row in range(table.row_count)]


@pytest.mark.long
async def test_top_shows_both_tables_and_sorts_them_by_keys() -> None:
    app = TopApp(Feed())
    async with app.run_test(size=(120, 40)) as pilot:
        processes, topics = (
            app.query_one(f"#{name}", DataTable) for name in ("processes", "topics")
        )
        assert column(processes, 0) == ["busy", "calm"]
        assert column(processes, 1) == ["silent", "ok"]
        assert column(topics, 0) == ["pose", "scan"]
        await pilot.press("greater_than_sign", "greater_than_sign")
        assert column(processes, 2) == ["1.0", "90.0"]
        await pilot.press("r")
        assert column(processes, 2) == ["90.0", "1.0"]
        await pilot.press("tab", "less_than_sign", "r")
        assert column(topics, 9) == ["3", "0"]
        await pilot.pause()
        shown = [topics.render_line(y).text for y in range(2)]
        assert shown[0].split()[:3] == ["topic", "Hz", "promised"]
        assert shown[1].split()[:2] == ["pose", "0.0"]
        await pilot.click("#topics", offset=(2, 0))
        assert column(topics, 0) == ["scan", "pose"]
        await pilot.click("#topics", offset=(2, 0))
        assert column(topics, 0) == ["pose", "scan"]
        await pilot.press("space")
        assert "paused" in app.title
        await pilot.press("q")
    assert app.return_code == 0


def test_rows_without_a_value_come_last_whichever_way_they_are_sorted() -> None:
    rows: Rows = {"a": (1.0,), "b": ("",), "c": (2.0,)}
    assert [key for key, _ in sorted_rows(rows, 0, down=False)] == ["a", "c", "b"]
    assert [key for key, _ in sorted_rows(rows, 0, down=True)] == ["c", "a", "b"]
    assert (len(PROCESS_COLUMNS), len(TOPIC_COLUMNS)) == (10, 10)
    assert [cell_text(cell) for cell in ("x", 3, 3.14)] == ["x", "3", "3.1"]


def test_a_sparkline_goes_from_zero_to_the_largest() -> None:
    assert sparkline([0.0, 5.0, 10.0]) == "▁▅█"
    assert (sparkline([]), sparkline([0.0])) == ("", "▁")


def line(t: int, process: str = "driver", level: str = "info", **more: object) -> str:
    return json.dumps({"t": t, "level": level, "process": process, "event": "log", **more}) + "\n"


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make a state folder with an old run and a new one."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "run"))
    base = tmp_path / "gigabrain" / "runs"
    for name in ("20260101T000000Z-demo-1", "20260102T000000Z-red-2"):
        (base / name).mkdir(parents=True)
    new = base / "20260102T000000Z-red-2"
    (new / "driver.jsonl").write_text(
        line(10, text="one") + "not json\n" + '{"t": 3}\n' + line(30, level="error") + '{"t": 4'
    )
    (new / "control.jsonl").write_text(line(20, "control", "warning"))
    return base


def test_the_log_of_the_newest_run_is_read_in_the_order_of_time(runs: Path) -> None:
    folder = run_folder()
    assert folder.name == "20260102T000000Z-red-2"
    assert [entry["t"] for entry in read(folder, LogFilter(), 100)] == [10, 20, 30]
    assert [entry["t"] for entry in read(folder, LogFilter(), 1)] == [30]
    assert [e["t"] for e in read(folder, LogFilter(process="driver"), 9)] == [10, 30]
    assert [e["t"] for e in read(folder, LogFilter(level="warning"), 9)] == [20, 30]
    assert [e["t"] for e in read(folder, LogFilter(since_ns=20), 9)] == [20, 30]
    assert run_folder("demo") == runs / "20260101T000000Z-demo-1"


@pytest.mark.parametrize("t", [10**30, 2**63, -1, True])
def test_a_line_whose_time_is_none_is_left_out(tmp_path: Path, t: int) -> None:
    (tmp_path / "driver.jsonl").write_text(line(t) + line(10))
    (shown,) = read(tmp_path, LogFilter(), 9)
    assert shown["t"] == 10


def test_of_a_long_log_only_the_newest_lines_are_held(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    held: list[int] = []

    class Line(dict[str, object]):
        alive = 0

        def __init__(self, number: int) -> None:
            super().__init__(t=number // 2, level="info", process="driver", number=number)
            Line.alive += 1
            held.append(Line.alive)

        def __del__(self) -> None:
            Line.alive -= 1

    (tmp_path / "driver.jsonl").touch()
    monkeypatch.setattr(log_reader, "_lines", lambda _: map(Line, range(1000)))
    newest = [line["number"] for line in read(tmp_path, LogFilter(), 4)]
    assert newest == [996, 997, 998, 999]
    assert max(held) < 10


def test_the_log_of_a_run_that_goes_on_is_preferred_to_a_newer_one_that_has_ended(
    runs: Path,
) -> None:
    older = runs / "20260101T000000Z-demo-1"
    with announced("waffle", Endpoint(), older):
        assert run_folder() == older
        assert run_folder("red") == runs / "20260102T000000Z-red-2"
    assert run_folder().name == "20260102T000000Z-red-2"


def test_the_newest_run_is_the_last_that_began_also_after_the_clock_has_stepped_back(
    runs: Path,
) -> None:
    last = runs / "20000101T000000Z-demo-3"
    last.mkdir()
    hold(last, number=1)
    assert run_folder() == last
    assert run_folder("demo") == last


def test_what_is_not_there_to_be_read_is_answered_with_what_is(runs: Path) -> None:
    with pytest.raises(UnknownName, match="no run 'blue'"):
        run_folder("blue")
    with pytest.raises(ConfigError, match="no run 'driver'; did you mean `--process driver`"):
        run_folder("driver")
    with pytest.raises(UnknownName, match="did you mean 'driver'"):
        read(run_folder(), LogFilter(process="drivr"), 9)
    with pytest.raises(UnknownName, match="did you mean 'warning'"):
        LogFilter(level="warnin")
    with pytest.raises(ConfigError, match="expected a time such as 90s, 10m, 2h or 1d"):
        ago_ns("soon", 0)
    assert ago_ns("10m", 10**12) == 400 * 10**9


def test_without_a_run_the_error_names_the_command_to_start_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    with pytest.raises(ConfigError, match="start one with `gigabrain demo`"):
        run_folder()


def test_a_record_from_the_bus_is_shown_like_one_from_a_file() -> None:
    told = as_line(example(LogRecord))
    assert (told["process"], told["reason"]) == ("decision", "obstacle ahead")
    assert LogFilter(process="decision").accepts(told)
    assert not LogFilter(level="error").accepts(told)


async def test_lines_logged_while_the_files_are_read_are_shown_once_in_order(net: Net) -> None:
    def publish(t: int) -> None:
        record = replace(example(LogRecord), process="driver", stamp_ns=t)
        net.one.publish(LOG, record, stamp_ns=t)

    def logged() -> list[Line]:
        return [json.loads(line(10)), json.loads(line(20))]

    def show(each: Line) -> None:
        shown.append(each["t"])
        begun.set()

    shown, begun = list[int](), asyncio.Event()
    following = asyncio.create_task(follow_log(net.two, LogFilter(), show, logged))
    await asyncio.sleep(0)
    publish(20)  # which the files have as well
    publish(15)
    await begun.wait()
    publish(10)  # late
    publish(30)
    await asyncio.sleep(0)
    following.cancel()
    assert shown == [10, 15, 20, 30]


@pytest.fixture
def root_level() -> Iterator[None]:
    before = logging.getLogger().level
    yield
    logging.getLogger().setLevel(before)


@pytest.fixture
async def net() -> Net:
    return Net()


async def told(net: Net, name: str = "", value: str = "") -> ParamReply:
    request = ParamRequest(name=name, value=value, source="ann")
    (reply,) = await net.two.ask(PARAM, request, name="one")
    return reply


async def thinking(net: Net) -> "asyncio.Task[None]":
    """Run a decision process in memory."""
    serve_params(net.one)
    running = asyncio.create_task(decision.run(DecisionConfig(), net.one, lambda: None))
    await asyncio.sleep(0)
    return running


async def test_parameters_are_listed_with_what_they_may_be(net: Net) -> None:
    running = await thinking(net)
    reply = await told(net)
    running.cancel()
    assert {one.name: one.value for one in reply.params} == {
        "log_level": logging.getLevelName(logging.getLogger().level).lower(),
        "max_linear_speed": "0.2",
        "max_angular_speed": "0.5",
        "turn": "right",
    }
    assert all(one.expected for one in reply.params)


async def test_a_parameter_is_changed_and_that_is_logged(
    net: Net, root_level: None, caplog: pytest.LogCaptureFixture
) -> None:
    running = await thinking(net)
    assert (await told(net, "log_level", "info")).ok
    reply = await told(net, "max_linear_speed", "0.15")
    assert (await told(net, "turn", "clearer")).ok
    after = {one.name: one.value for one in (await told(net)).params}
    running.cancel()
    assert (reply.ok, reply.text) == (True, "max_linear_speed is 0.15 now, it was 0.2")
    assert (after["max_linear_speed"], after["turn"], after["max_angular_speed"]) == (
        "0.15",
        "clearer",
        "0.5",
    )
    assert "param by ann: max_linear_speed is 0.15 now, it was 0.2" in caplog.messages


@pytest.mark.parametrize(
    ("name", "value", "complaint"),
    [
        ("max_linear_speed", "nan", "max_linear_speed: expected a number above 0, up to 10 [m/s]"),
        ("max_linear_speed", "inf", "max_linear_speed: expected a number above 0"),
        ("max_linear_speed", "0", "max_linear_speed: expected a number above 0"),
        ("max_linear_speed", "-1", "max_linear_speed: expected a number above 0"),
        ("max_linear_speed", "11", "max_linear_speed: expected a number above 0"),
        ("max_linear_speed", "", "max_linear_speed: expected a number above 0"),
        ("turn", "lft", "turn: expected one of: right, left, clearer, got 'lft'"),
        ("log_level", "loud", "log_level: expected one of: debug, info, warning"),
        (
            "max_linear_sped",
            "1",
            "no parameter 'max_linear_sped'; did you mean 'max_linear_speed'?",
        ),
    ],
)
async def test_a_value_that_cannot_be_is_refused_with_what_was_expected(
    net: Net, name: str, value: str, complaint: str
) -> None:
    running = await thinking(net)
    before = (await told(net)).params
    reply = await told(net, name, value)
    running.cancel()
    assert not reply.ok
    assert reply.text.startswith(complaint)
    assert reply.params == before


async def test_the_change_of_a_long_text_is_confirmed(net: Net) -> None:
    held = ["a" * 400]
    net.one.params.add("route", "any text", lambda: held[0], lambda text: held.__setitem__(0, text))
    serve_params(net.one)
    reply = await told(net, "route", "b" * 400)
    assert (reply.ok, held, len(reply.text)) == (True, ["b" * 400], 500)


async def test_a_process_without_settings_still_has_its_log_level(net: Net) -> None:
    serve_params(net.one)
    assert [one.name for one in (await told(net)).params] == ["log_level"]
    with pytest.raises(Refused, match="no parameter 'x'"):
        net.one.params.change("x", "1")
