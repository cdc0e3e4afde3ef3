"""The fault suite on real processes: some rows here, all of them in `make qa`."""

import asyncio

import pytest

from gigabrain_zenoh.qa.faults.rig import Options
from gigabrain_zenoh.qa.faults.suite import FAULTS, run_suite
from gigabrain_zenoh.qa.judging import FaultResult, FaultRow

# a process, the gate, a link, the router, the e-stop, and a camera
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
    """The result of each chosen row, judged by ticks alone; they share robots: one go for all."""
    own = [i for i in request.session.items if i.path == request.path]
    chosen = [fault for fault in FAULTS if any(f"[{fault.name}]" in item.name for item in own)]
    folder, options = tmp_path_factory.mktemp("faults"), Options(wall=False)
    done = asyncio.run(run_suite(chosen, options, folder))
    return {result.number: result for result in done}


@pytest.mark.slow
@pytest.mark.parametrize("fault", ROWS)
def test_the_robot_stops_whatever_breaks(fault: FaultRow, results: dict[int, FaultResult]) -> None:
    result = results[fault.number]
    if result.verdict == "skipped":
        pytest.skip(result.reason)
    if all(run.disturbed and run.measured for run in result.tries) and result.reason:
        pytest.skip(
            f"a thread waited for a core in every run, so limits say nothing: {result.reason}"
        )
    assert result.verdict == "passed", f"{result.reason}, in {result.tries}"
