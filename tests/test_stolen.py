"""What a hypervisor takes from a core is seen, whichever core somebody happens to run on."""

import asyncio
import os
from pathlib import Path

import pytest

from gigabrain_zenoh.faults import waiting
from gigabrain_zenoh.faults.stolen import StolenTime
from gigabrain_zenoh.faults.waiting import StallWatch

TICKS_HZ = os.sysconf("SC_CLK_TCK")


def tell(file: Path, *stolen_s: float) -> Path:
    """A /proc/stat of a machine from whose cores so much was stolen."""
    cores = [f"cpu{i} 9 9 9 9 9 9 9 {round(s * TICKS_HZ)} 0 0" for i, s in enumerate(stolen_s)]
    total = f"cpu 9 9 9 9 9 9 9 {round(sum(stolen_s) * TICKS_HZ)} 0 0"
    file.write_text("\n".join([total, *cores, "intr 9 9 9 9 9 9 9 9 9 9", "ctxt 9"]) + "\n")
    return file


def test_the_core_that_lost_most_counts_and_not_their_sum(tmp_path: Path) -> None:
    file = tell(tmp_path / "stat", 1.0, 2.0)
    stolen = StolenTime(file)
    assert stolen.most_s() == 0.0
    tell(file, 1.02, 2.05)
    assert stolen.most_s() == 0.05
    assert stolen.most_s() == 0.0


def test_a_core_that_has_just_come_has_lost_nothing(tmp_path: Path) -> None:
    stolen = StolenTime(tell(tmp_path / "stat", 1.0))
    tell(tmp_path / "stat", 1.0, 5.0)
    assert stolen.most_s() == 0.0


@pytest.mark.parametrize("text", [None, "", "cpu0 1 2\n"])
def test_where_nobody_tells_nothing_was_stolen(tmp_path: Path, text: str | None) -> None:
    file = tmp_path / "stat"
    if text is not None:
        file.write_text(text)
    stolen = StolenTime(file)
    assert stolen.most_s() == 0.0


async def test_the_fault_suite_hears_of_a_core_that_stood_still_though_its_own_ran(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tell(tmp_path / "stat", 1.0, 1.0)
    monkeypatch.setattr(waiting, "StolenTime", lambda: StolenTime(file))
    stalls = StallWatch()
    stalls.start()
    try:
        await asyncio.sleep(0)
        tell(file, 1.0, 61.0)
        assert await stalls.longest_s() >= 60.0
    finally:
        stalls.close()
