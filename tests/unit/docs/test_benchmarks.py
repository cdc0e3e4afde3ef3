"""The tables of measurements are those of the stored results."""

import msgspec
import pytest

from docs.site import benchmarks
from gigabrain_zenoh.qa.bench.plan import PlanResult, SizeFigures, Timing

PAGES = {page.name: page for page in sorted(benchmarks.PAGES.glob("*.md"))}


@pytest.mark.parametrize("name", PAGES)
def test_a_page_has_the_tables_of_the_results(name: str) -> None:
    text = PAGES[name].read_text()
    assert text == benchmarks.made(text)  # else: make golden


def test_every_result_is_on_one_page() -> None:
    text = "".join(page.read_text() for page in PAGES.values())
    shown = [found[1] for found in benchmarks.BLOCK.finditer(text)]
    assert sorted(shown) == sorted(path.stem for path in benchmarks.RESULTS.glob("*.json"))


def test_a_table_names_command_date_and_machine() -> None:
    for path in benchmarks.RESULTS.glob("*.json"):
        one = benchmarks.load(path.stem)
        assert min(len(one.command), len(one.machine)) > 0, path
        assert one.date.startswith("20"), path
        assert {len(row) for row in one.rows} == {len(one.columns)}, path


def test_what_a_benchmark_wrote_becomes_the_table_that_it_printed() -> None:
    timing = Timing(what="optimal path, office", n=20, p50_ms=32.44, p95_ms=53.9, cpu_p50_ms=32.0)
    size = SizeFigures(size=2000, path_m=72.1, timings=(timing,), ratio=1.0)
    written = msgspec.json.encode(PlanResult(seed=0, sizes=(size,)))
    found = benchmarks.measured("plan", written, "gigabrain bench plan")
    assert found.columns == ("map", "what", "n", "p50 [ms]", "p95 [ms]", "CPU p50 [ms]")
    assert found.rows[0] == ("2000²", "optimal path, office, 72 m", "20", "32.4", "53.9", "32.0")
    assert found.command == "`gigabrain bench plan`"
    assert "cores" in found.machine
