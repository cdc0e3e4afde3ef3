import io
import json
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console, RenderableType

from gigabrain_drivers.round_trip import RoundTrip
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.topics import CMD_VEL, SCAN
from gigabrain_zenoh.bench.chain import ChainResult, Compared
from gigabrain_zenoh.bench.costs import Hop, Timed
from gigabrain_zenoh.bench.estop import EstopResult, Presses
from gigabrain_zenoh.bench.figures import Figures, figures, over_rounds
from gigabrain_zenoh.bench.first_goal import FirstGoal
from gigabrain_zenoh.bench.listening import Heard, median_ms
from gigabrain_zenoh.bench.runs import relay_roles
from gigabrain_zenoh.bench.stack import Process, StackResult, physics_share, targets
from gigabrain_zenoh.bench.tables import chain_page, estop_page, stack_page, tools_page
from gigabrain_zenoh.bench.with_tools import Beside, Tool, ToolsResult
from gigabrain_zenoh.errors import GigabrainError
from gigabrain_zenoh.percentile import Newest, percentile
from gigabrain_zenoh.settings import Endpoint
from tests.stack import Home

MS = 1_000_000


def one(n: int, p50_ms: float, p99_ms: float) -> Figures:
    return Figures(n=n, p50_ms=p50_ms, p99_ms=p99_ms)


def compared() -> Compared:
    return Compared(
        rate_hz=10.0,
        chain=(one(100, 0.9, 3.0), one(99, 0.6, 1.0), one(101, 0.7, 1.5)),
        relay=(one(100, 0.5, 0.9), one(100, 0.4, 0.8), one(100, 0.6, 1.1)),
        peers=one(100, 0.25, 0.5),
    )


def stack(**changes: object) -> StackResult:
    values = {
        "body": "turtlebot3_waffle",
        "world": "arena",
        "seconds": 20.0,
        "ready_s": 1.2,
        "physics_cpu": 0.04,
        "processes": (
            Process(name="driver", cpu=0.125, rss_bytes=95_000_000),
            Process(name="perception", cpu=0.025, rss_bytes=56_000_000),
            Process(name="safety", cpu=0.0625, rss_bytes=58_500_000),
        ),
    }
    return msgspec.convert(values | changes, StackResult)


def shown(page: RenderableType) -> str:
    console = Console(width=100, no_color=True)
    with console.capture() as capture:
        console.print(page)
    return capture.get()


@pytest.mark.parametrize(
    ("count", "share", "expected"),
    [(1, 0.99, 1), (2, 0.50, 1), (3, 0.50, 2), (100, 0.50, 50), (100, 0.99, 99), (101, 0.99, 100)],
)
def test_a_percentile_is_a_value_that_was_measured(
    count: int, share: float, expected: float
) -> None:
    assert percentile(range(1, count + 1), share) == expected


def test_nothing_has_no_percentile() -> None:
    assert percentile([], 0.5) is None
    assert Newest(3).percentile(0.5) is None


def test_the_oldest_value_gives_way() -> None:
    newest = Newest(3)
    for value in (5.0, 1.0, 9.0, 2.0):
        newest.add(value)
    assert len(newest) == 3
    assert [newest.percentile(share) for share in (0.0, 0.5, 1.0)] == [1.0, 2.0, 9.0]


@given(st.lists(st.floats(0, 9), min_size=1), st.integers(1, 9), st.floats(0, 1))
def test_the_newest_values_are_those_that_came_last(
    values: list[float], most: int, share: float
) -> None:
    newest = Newest(most)
    for value in values:
        newest.add(value)
    assert newest.percentile(share) == percentile(sorted(values[-most:]), share)


def test_a_run_that_measured_nothing_is_no_result() -> None:
    assert figures([0.4, 0.2, 0.3]) == one(3, 0.3, 0.4)
    with pytest.raises(GigabrainError, match="nothing came back"):
        figures([])


def test_one_disturbed_round_does_not_count() -> None:
    assert over_rounds(compared().chain) == one(300, 0.7, 1.5)


def test_a_ratio_is_ours_over_the_bare_relays() -> None:
    assert compared().ratio_p50 == pytest.approx(1.4)
    assert compared().ratio_p99 == pytest.approx(1.5 / 0.9)


def test_what_a_hop_does_not_do_itself_is_the_rest() -> None:
    hop = Hop(name="scan → world", took=1.0, put=0.1, bridge=0.05, decode=0.02, step=0.23)
    assert hop.rest == pytest.approx(0.6)


def test_work_is_timed_by_name_and_its_result_handed_on() -> None:
    timed = Timed()
    assert timed("step", lambda: 7) == 7
    assert timed.median("step") >= 0.0
    for duration_ns in (MS, 5 * MS, 2 * MS):
        timed.add("put", duration_ns)
    assert timed.median("put") == 2.0
    assert timed.median("never done") == 0.0


def test_a_hop_lasts_from_its_first_message_of_a_tick_to_the_next_ones() -> None:
    heard = Heard()
    for tick, left_ms in ((5, 100), (10, 200), (15, 300)):
        heard.hear("robot/scan", CmdVel(linear_x=0.0, basis=tick, stamp_ns=left_ms * MS))
    for tick, left_ms in ((5, 101), (10, 203), (10, 220)):  # the last repeats what it rests on
        heard.hear("robot/cmd_vel", CmdVel(linear_x=0.0, basis=tick, stamp_ns=left_ms * MS))
    assert heard.between(SCAN, CMD_VEL) == 2.0
    assert not heard.complete
    assert median_ms({1: 0, 2: 0, 3: 0}, {2: 4 * MS, 3: 8 * MS, 4: MS}) == 6.0


def test_the_relay_is_a_ring_with_one_source() -> None:
    here = Endpoint(connect=("tcp/127.0.0.1:7447",))
    roles = relay_roles(50.0, 2.0, (1600, 240, 490, 125), [here] * 4)
    assert [role.gets for role in roles[1:]] == [role.puts for role in roles[:-1]]
    assert roles[0].gets == roles[-1].puts
    assert [role.size for role in roles] == [1600, 240, 490, 125]
    assert [role.rate_hz for role in roles] == [50.0, 0.0, 0.0, 0.0]


def test_a_scan_is_timed_until_the_first_command_that_rests_on_it() -> None:
    trip = RoundTrip()
    trip.sent(5, 100 * MS)
    trip.answered(0, 101 * MS, counts=True)
    trip.answered(5, 103 * MS, counts=True)
    trip.answered(5, 120 * MS, counts=True)
    assert trip.scan_tick == 5
    assert trip.report() == {
        "scan_to_cmd_n": 1, "scan_to_cmd_p50_ms": 3.0, "scan_to_cmd_p99_ms": 3.0,
    }  # fmt: skip


def test_a_scan_that_was_skipped_counts_until_a_newer_one_is_answered() -> None:
    trip = RoundTrip()
    trip.sent(5, 100 * MS)
    trip.sent(6, 120 * MS)
    trip.answered(6, 124 * MS, counts=True)
    assert trip.report() == {
        "scan_to_cmd_n": 2, "scan_to_cmd_p50_ms": 4.0, "scan_to_cmd_p99_ms": 24.0,
    }  # fmt: skip


def test_a_brain_that_is_still_starting_is_not_timed() -> None:
    trip = RoundTrip()
    trip.sent(5, 100 * MS)
    trip.answered(5, 900 * MS, counts=False)
    assert trip.report()["scan_to_cmd_n"] == 0
    assert trip.report()["scan_to_cmd_p50_ms"] is None


def test_what_the_whole_robot_costs_leaves_its_physics_out() -> None:
    assert stack().cpu_without_physics == pytest.approx(0.1725)
    assert stack(physics_cpu=None).cpu_without_physics == pytest.approx(0.2125)
    assert physics_share({"physics_cpu_s": 1.5}, {"physics_cpu_s": 2.5}, 20.0) == 0.05
    assert physics_share({}, {"physics_cpu_s": 2.5}, 20.0) is None


def test_targets_are_held_against_the_figures() -> None:
    reached = [(t.name, round(t.value, 2), t.limit, t.ok) for t in targets(stack())]
    assert reached == [
        ("all ready after", 1.2, 1.5, True),
        ("CPU without physics", 17.25, 30.0, True),
        ("physics and lidar", 4.0, 5.0, True),
        ("largest without MuJoCo (safety)", 58.5, 70.0, True),
    ]
    assert [t.ok for t in targets(stack(ready_s=1.6, physics_cpu=0.06))] == [
        False, True, False, True,
    ]  # fmt: skip
    goal = FirstGoal(
        accepted_s=1.9, accepted_cpu_s=1.7, told="goal-1: accepted", drives_s=4.0, drives_cpu_s=5.1
    )
    held = {target.name: target for target in targets(stack(first_goal=goal))}
    assert held["first goal accepted after"].ok
    assert not msgspec.structs.replace(held["first goal accepted after"], value=2.1).ok
    without_mujoco = targets(stack(physics_cpu=None))
    assert [t.name for t in without_mujoco][1:] == [
        "CPU without physics",
        "largest without MuJoCo (driver)",
    ]
    assert not without_mujoco[-1].ok


def test_the_pages_say_it_all() -> None:
    hop = Hop(name="scan → world", took=1.0, put=0.1, bridge=0.05, decode=0.02, step=0.23)
    result = ChainResult(
        seconds=10.0,
        payload_bytes=(1604, 236, 490, 124),
        rates=(compared(),),
        overheard=one(40, 1.25, 2.0),
        hops=(hop,),
    )
    page = shown(chain_page(result))
    for text in ("10 Hz", "0.70", "1.40 (≤ 1.5)", "1.67 (≤ 2)", "safety", "scan → world", "0.600"):
        assert text in page
    page = shown(stack_page(stack(ready_s=1.6)))
    for text in ("perception", "2.5%", "56 MB", "1.60 s", "over", "17.25 %"):
        assert text in page
    assert "first goal" not in page
    goal = FirstGoal(
        accepted_s=1.95, accepted_cpu_s=1.7, told="goal-1: ok", drives_s=4.0, drives_cpu_s=5.1
    )
    page = shown(stack_page(stack(first_goal=goal)))
    for text in ("1.95 s", "after 1.70 s of CPU (goal-1: ok)", "4.00 s with 5.10 s of CPU"):
        assert text in " ".join(page.split())


async def test_the_chain_is_timed_beside_a_bare_relay(home: Home, tmp_path: Path) -> None:
    report = tmp_path / "chain.json"
    options = ("--seconds", "1", "--rounds", "1", "--rates", "50", "--json", str(report))
    command = await home.run("bench", "chain", *options)
    assert await command.ended() == 0, command.err
    result = json.loads(report.read_bytes())
    (rate,) = result["rates"]
    for runs in (rate["chain"], rate["relay"], [rate["peers"]]):
        assert runs[0]["n"] >= 10
        assert 0 < runs[0]["p50_ms"] <= runs[0]["p99_ms"]
    assert [hop["name"] for hop in result["hops"]] == [
        "scan → world", "world → intent", "intent → cmd_vel", "cmd_vel → driver",
    ]  # fmt: skip
    assert result["payload_bytes"][0] > 1440  # 360 beams
    assert "ratio p50" in command.out


async def test_a_whole_robot_is_measured(home: Home, tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    pytest.importorskip("gtsam")
    report = tmp_path / "stack.json"
    command = home.start("bench", "stack", "--seconds", "2", "--goal", "--json", str(report))
    assert await command.ended(600.0) == 0, command.err  # where nothing is kept yet, it compiles
    result = json.loads(report.read_bytes())
    names = [process["name"] for process in result["processes"]]
    assert names == ["router", "driver", "perception", "decision", "control", "safety"]
    assert all(process["rss_bytes"] > 1e7 for process in result["processes"])
    assert result["ready_s"] > 0
    assert result["physics_cpu"] > 0
    goal = result["first_goal"]
    assert goal["told"].startswith("goal-1: ")
    assert 0 < goal["accepted_s"] < goal["drives_s"]
    assert 0 < goal["accepted_cpu_s"] <= goal["drives_cpu_s"]
    assert "physics and lidar" in command.out


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (("chain", "--rates", "51"), "--rates: expected above 0, at most 50, got 51"),
        (("chain", "--seconds", "0"), "--seconds: expected a number above 0, got 0"),
        (("stack", "--body", "turtlebot3_wafle"), "did you mean 'turtlebot3_waffle'?"),
    ],
)
async def test_what_cannot_be_measured_is_refused(
    home: Home, options: tuple[str, ...], complaint: str
) -> None:
    command = await home.run("bench", *options)
    assert complaint in command.err
    assert await command.ended() == 2


def test_the_page_of_the_e_stop_shows_each_figure_beside_its_target() -> None:
    idle = Presses(name="idle", ms=(1.0, 2.0, 3.0, 49.0), travel_m=(0.031, 0.042))
    flooded = Presses(name="flooded", ms=(60.0, 101.0), travel_m=())
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(estop_page(EstopResult(body="mock", rounds=(idle, flooded))))
    rows = [line for line in console.export_text().splitlines() if "│" in line]
    assert [cell.strip() for cell in rows[0].split("│")[1:-1]] == [
        "idle", "4", "2.0", "49.0 (≤ 50)", "49.0 (≤ 100)", "0.042 (≤ 0.06)",
    ]  # fmt: skip
    assert [cell.strip() for cell in rows[1].split("│")[1:-1]] == [
        "flooded", "2", "60.0", "101.0 (≤ 50)", "101.0 (≤ 100)", "0.000 (≤ 0.06)",
    ]  # fmt: skip


def beside(again_ms: tuple[float, ...] = (1.0, 2.0, 9.0)) -> ToolsResult:
    return ToolsResult(
        seconds=10.0,
        recorded_hz=318.0,
        rates=(
            Beside(
                rate_hz=10.0,
                alone=(one(100, 0.6, 1.0), one(100, 0.7, 2.0), one(100, 0.8, 9.0)),
                tools=(one(100, 0.7, 1.9), one(100, 0.8, 2.2), one(100, 0.9, 8.1)),
                again=tuple(one(100, 0.7, p99) for p99 in again_ms),
            ),
        ),
        tools=(
            Tool(name="recorder", cpu=0.034, limit=3.0),
            Tool(name="page", cpu=0.017, limit=2.0),
            Tool(name="topic echo", cpu=0.05),
        ),
    )


def test_what_tools_add_is_told_by_the_median_rounds() -> None:
    assert beside().rates[0].added_p99 == pytest.approx((-10.0, 10.0, 90.0))
    page = shown(tools_page(beside()))
    assert "+10 % (-10 to +90)" in page
    assert "+0 % (+0 to +0)" in page
    assert "too noisy" not in page
    assert "318 messages a second" in page
    rows = [line.split() for line in page.splitlines()]
    assert ["│", "recorder", "│", "3.4", "%", "│", "3", "%", "│"] in rows
    assert ["│", "topic", "echo", "│", "5.0", "%", "│", "│"] in rows


def test_a_machine_that_does_more_by_itself_is_said_to_be_too_noisy() -> None:
    noisy = beside((1.2, 2.0, 7.2))
    assert noisy.rates[0].noise_p99 == pytest.approx((-20.0, 0.0, 20.0))
    assert noisy.rates[0].added_p99[1] == pytest.approx(10.0)
    page = " ".join(shown(tools_page(noisy)).split())
    assert "+0 % (-20 to +20)" in page
    assert "more than that here: too noisy to judge by" in page


async def test_the_chain_is_timed_with_all_tools_beside_it(home: Home) -> None:
    result = home.folder / "tools.json"
    ran = await home.run(
        "bench", "chain", "--with", "tools", "--seconds", "2", "--rounds", "1", "--rates", "10",
        "--json", str(result),
    )  # fmt: skip
    assert (await ran.ended(), result.exists()) == (0, True), ran.err
    told = msgspec.json.decode(result.read_bytes(), type=ToolsResult)
    assert [tool.name for tool in told.tools] == ["recorder", "page", "foxglove", "topic echo"]
    assert all(0 < tool.cpu < 1 for tool in told.tools), told.tools
    assert told.recorded_hz > 50
    assert told.rates[0].tools[0].n > 10
