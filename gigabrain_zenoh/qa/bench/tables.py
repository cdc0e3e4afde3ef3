"""The results as tables for people."""

from rich.console import Group, JustifyMethod
from rich.table import Table
from rich.text import Text

from gigabrain_zenoh.qa.bench.chain import TARGET_P50, TARGET_P99, ChainResult, Compared
from gigabrain_zenoh.qa.bench.costs import Hop
from gigabrain_zenoh.qa.bench.estop import MAX_MS, P99_MS, TRAVEL_M, EstopResult
from gigabrain_zenoh.qa.bench.figures import Figures, over_rounds
from gigabrain_zenoh.qa.bench.first_goal import FirstGoal
from gigabrain_zenoh.qa.bench.stack import StackResult, Target, targets
from gigabrain_zenoh.qa.bench.with_tools import ADDED, ToolsResult

MB = 1e6


def chain_page(result: ChainResult) -> Group:
    """What `gigabrain bench chain` prints."""
    runs = f"runs of {result.seconds:g} s in turns, median of {len(result.rates[0].chain)}"
    sent = ", ".join(str(size) for size in result.payload_bytes)
    return Group(
        _title(f"Scan to command ({runs})"),
        _compared(result.rates),
        Text(
            f"The relay is four plain Zenoh processes on a router like ours, which put what they "
            f"get ({sent} bytes). Our router, driver, perception, decision, control and safety run "
            "as under `gigabrain up`: safety is no part of the chain, but without it the gate "
            "stays shut.",
            style="dim",
        ),
        _title(f"Where it goes [ms] (with somebody listening: {result.overheard.p50_ms:.2f} ms)"),
        _hops(result.hops),
        Text(
            "Work of each kind is timed by itself in a process that sleeps a tick in between, as "
            "ours do. The rest is Zenoh, the kernel, and waiting for a core that another process "
            "uses.",
            style="dim",
        ),
    )


def tools_page(result: ToolsResult) -> Group:
    """What `gigabrain bench chain --with tools` prints."""
    table = _table("rate", "tools", "n", "p50 [ms]", "p99 [ms]", "added to p99")
    for one in result.rates:
        _figures(table, f"{one.rate_hz:g} Hz", "none", over_rounds(one.alone))
        added = _added(one.added_p99)
        added.stylize(_style(one.added_p99[1], ADDED))
        _figures(table, "", "all", over_rounds(one.tools), added)
        _figures(table, "", "none again", over_rounds(one.again), _added(one.noise_p99))
        table.add_section()
    needs = _table("tool", "CPU of one core", "at most")
    for tool in result.tools:
        percent, limit = 100 * tool.cpu, tool.limit
        used = Text(f"{percent:.1f} %", style=_style(percent, limit) if limit else "")
        needs.add_row(tool.name, used, f"{limit:g} %" if limit else "")
    runs = f"runs of {result.seconds:g} s in turns, median of {len(result.rates[0].alone)}"
    about = (
        f"The recorder took {result.recorded_hz:.0f} messages a second, with what viewers draw. "
        "One viewer reads all that the page sends and another all that the bridge has; they draw "
        "nothing, and are not counted."
    )
    noise = (
        f"At most {ADDED:g} % may be added. What is added is told round by round against the chain "
        "alone before and after it (least to most), and the chain alone against itself."
    )
    if any(one.noisy for one in result.rates):
        noise += " The machine by itself does more than that here: too noisy to judge by."
    return Group(
        _title(f"Scan to command with tools beside it ({runs})"), table, Text(noise, style="dim"),
        needs, Text(about, style="dim"),
    )  # fmt: skip


def _added(spread: tuple[float, float, float]) -> Text:
    least, median, most = spread
    return Text(f"{median:+.0f} % ({least:+.0f} to {most:+.0f})")


def _style(value: float, limit: float) -> str:
    return "green" if value <= limit else "yellow"


def _compared(rates: tuple[Compared, ...]) -> Table:
    table = _table("rate", "who", "n", "p50 [ms]", "p99 [ms]", "ratio p50", "ratio p99")
    for one in rates:
        rate = f"{one.rate_hz:g} Hz"
        _figures(table, rate, "bare relay", over_rounds(one.relay))
        ratios = (_ratio(one.ratio_p50, TARGET_P50), _ratio(one.ratio_p99, TARGET_P99))
        _figures(table, "", "gigabrain", over_rounds(one.chain), *ratios)
        _figures(table, "", "no router", one.peers)
        table.add_section()
    return table


def _figures(table: Table, rate: str, who: str, one: Figures, *ratios: Text) -> None:
    table.add_row(rate, who, str(one.n), f"{one.p50_ms:.2f}", f"{one.p99_ms:.2f}", *ratios)


def _ratio(value: float, limit: float) -> Text:
    return _within(value, limit, 2)


def _hops(hops: tuple[Hop, ...]) -> Table:
    table = _table("hop", "took", "encode, put", "bridge", "decode", "step", "rest")
    for hop in hops:
        parts = (hop.took, hop.put, hop.bridge, hop.decode, hop.step, hop.rest)
        table.add_row(hop.name, *(f"{part:.3f}" for part in parts))
    return table


def stack_page(result: StackResult) -> Group:
    """What `gigabrain bench stack` prints."""
    title = f"{result.body} in {result.world} at real time, {result.seconds:g} s"
    table = _table("process", "CPU", "memory")
    for process in result.processes:
        table.add_row(process.name, f"{process.cpu:.1%}", f"{process.rss_bytes / MB:.0f} MB")
    held = _table("figure", "measured", "at most", "")
    for target in targets(result):
        held.add_row(*_target(target))
    page = Group(_title(title), table, _title("Targets (CPU of one core)"), held)
    if goal := result.first_goal:
        page.renderables.append(Text(_told(goal), style="dim"))
    return page


def _told(goal: FirstGoal) -> str:
    return (
        f"The first goal was accepted after {goal.accepted_cpu_s:.2f} s of CPU ({goal.told}), and "
        f"driven to after {goal.drives_s:.2f} s with {goal.drives_cpu_s:.2f} s of CPU."
    )


def estop_page(result: EstopResult) -> Group:
    """What `gigabrain bench estop` prints."""
    table = _table("network", "presses", "p50 [ms]", "p99 [ms]", "max [ms]", "travel [m]")
    for one in result.rounds:
        travel = max(one.travel_m, default=0.0)
        table.add_row(
            one.name,
            f"{len(one.ms)}",
            f"{one.p(0.5):.1f}",
            _within(one.p(0.99), P99_MS, 1),
            _within(max(one.ms), MAX_MS, 1),
            _within(travel, TRAVEL_M, 3),
        )
    title = f"E-stop of {result.body}: from the press to the answer that it stands"
    flood = (
        "flooded: a hundred pictures of 1 MB and a thousand commands of a stranger's a second. "
        "The travel is by odometry, of the presses at 0.26 m/s; half of the way is braking."
    )
    return Group(_title(title), table, Text(flood, style="dim"))


def _within(value: float, limit: float, digits: int) -> Text:
    return Text(f"{value:.{digits}f} (≤ {limit:g})", style=_style(value, limit))


def _target(target: Target) -> tuple[str, str, str, Text]:
    verdict = Text("ok", style="green") if target.ok else Text("over", style="yellow")
    value, limit = f"{target.value:.2f} {target.unit}", f"{target.limit:g} {target.unit}"
    return target.name, value, limit, verdict


def _title(text: str) -> Text:
    return Text(f"\n{text}", style="bold")


def _table(first: str, *others: str) -> Table:
    table = Table()
    table.add_column(first, no_wrap=True)
    for name in others:
        justify: JustifyMethod = "left" if name in ("who", "tools") else "right"
        table.add_column(Text(name), justify=justify, no_wrap=True)
    return table
