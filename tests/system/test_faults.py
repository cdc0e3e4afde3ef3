"""The fault suite on real processes: some of its rows here, all in `make qa`."""

import asyncio

import pytest

from gigabrain_zenoh.qa.faults.rig import Options
from gigabrain_zenoh.qa.faults.suite import FAULTS, run_suite
from gigabrain_zenoh.qa.judging import FaultResult, FaultRow

# one of each kind: process, gate, link, router, e-stop, camera
QUICK = (
    "decision-killed",
    "gate-killed",
    "serial-unplugged",
    "router-killed",
    "e-stop-pressed",
    "camera-killed-or-frozen",
)
ROWS = [
    pytest.param(fault, id=fault.name, marks=() if fault.name in QUICK else pytest.mark.qa)
    for fault in FAULTS
]


@pytest.fixture(scope="module")
def results(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> dict[int, FaultResult]:
    """Run all chosen rows at once, because they share robots; return their results in ticks."""
    own = [i for i in request.session.items if i.path == request.path]
    chosen = [fault for fault in FAULTS if any(f"[{fault.name}]" in item.name for item in own)]
    folder, options = tmp_path_factory.mktemp("faults"), Options(wall=False)
    done = asyncio.run(run_suite(chosen, options, folder))
    return {result.number: result for result in done}


@pytest.mark.slow
@pytest.mark.parametrize("fault", ROWS)
def test_the_robot_stops_at_each_fault(fault: FaultRow, results: dict[int, FaultResult]) -> None:
    result = results[fault.number]
    if result.verdict == "skipped":
        pytest.skip(result.reason)
    if all(run.disturbed and run.measured for run in result.tries) and result.reason:
        pytest.skip(
            f"a thread waited for a core in every run, so limits say nothing: {result.reason}"
        )
    assert result.verdict == "passed", f"{result.reason}, in {result.tries}"
