"""The benchmark of planning: its maps, its figures, and its table."""

from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from gigabrain_zenoh.cli.bench import _plan_table, plan
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.qa.bench.plan import PlanResult, measure_plan, office, scattered


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> tuple[PlanResult, Path]:
    png = tmp_path_factory.mktemp("plan") / "plan.png"
    return measure_plan((400,), 3, 1, png, lambda text: None), png


@pytest.mark.long
def test_every_path_is_as_cheap_as_dijkstras(measured: tuple[PlanResult, Path]) -> None:
    (size,) = measured[0].sizes
    assert size.ratio == pytest.approx(1.0, abs=1e-9)
    assert measured[0].ok
    assert 12.0 <= size.path_m <= 16.5  # it costs as much as 15 m in the open, within a tenth


def test_all_timings_are_complete_and_ordered(measured: tuple[PlanResult, Path]) -> None:
    (size,) = measured[0].sizes
    assert [one.n for one in size.timings] == [7, 7, 7, 3, 3, 9, 3, 7, 7]
    assert all(0 < one.p50_ms <= one.p95_ms for one in size.timings)


def test_the_picture_shows_the_map(measured: tuple[PlanResult, Path]) -> None:
    assert measured[1].read_bytes().startswith(b"\x89PNG")


def test_a_costlier_path_is_not_ok(measured: tuple[PlanResult, Path]) -> None:
    (size,) = measured[0].sizes
    costlier = PlanResult(
        seed=0, sizes=(type(size)(size=400, path_m=1.0, timings=(), ratio=1.001),)
    )
    assert not costlier.ok


def test_published_figures_are_marked(measured: tuple[PlanResult, Path]) -> None:
    console = Console(width=140)
    with console.capture() as output:
        console.print(_plan_table(measured[0]))
    assert "published │ Nav2 NavFn, about 75 m" in output.get()
    assert "other machines" in output.get()


def test_the_maps_repeat_and_have_the_described_density() -> None:
    one, other = (office(500, np.random.default_rng(3)) for _ in range(2))
    np.testing.assert_array_equal(one, other)
    assert 0.05 < (one == 100).mean() < 0.3
    assert (scattered(500, np.random.default_rng(3)) > 1).mean() == pytest.approx(0.2, abs=0.01)


@pytest.mark.parametrize(("size", "queries"), [((100,), 3), ((400,), 0)])
def test_wrong_options_are_refused(size: tuple[int, ...], queries: int) -> None:
    with pytest.raises(ConfigError, match="--"):
        plan(size=size, queries=queries)
