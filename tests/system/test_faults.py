"""The fault suite: its frame, and every fault once, in its short form, on real processes."""

import asyncio

import pytest

from gigabrain_zenoh.qa.faults.fault import FaultResult, FaultRow
from gigabrain_zenoh.qa.faults.rig.rig import Options
from gigabrain_zenoh.qa.faults.suite import FAULTS, run_suite


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[int, FaultResult]:
    """What came of each fault, judged by ticks alone; they share robots, so they run in one go."""
    options = Options(wall=False)
    done = asyncio.run(run_suite(FAULTS, options, tmp_path_factory.mktemp("faults")))
    return {result.number: result for result in done}


@pytest.mark.system
@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_the_robot_stops_whatever_breaks(fault: FaultRow, results: dict[int, FaultResult]) -> None:
    result = results[fault.number]
    if result.verdict == "skipped":
        pytest.skip(result.reason)
    assert result.verdict == "passed", result.tries
