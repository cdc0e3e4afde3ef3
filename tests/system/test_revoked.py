"""Revoked keys: at a real router, and on disk."""

import shutil
from pathlib import Path

import pytest

from gigabrain_zenoh.security.authority import issue, revoke
from gigabrain_zenoh.testing.processes import Home, SampleCollector, repeat
from tests.system.keys import site
from tests.system.test_acl import answer, ask, query_until_answered

HELLO = "red/robot/teleop"


@pytest.fixture
def own_fleet(fleet: Path, tmp_path: Path) -> Path:
    """Return a copy of the fleet's folder that the test may change."""
    return Path(shutil.copytree(fleet, tmp_path / "fleet"))


async def test_a_revoked_operator_has_no_rights_and_its_successor_has_all(own_fleet: Path) -> None:
    revoke(own_fleet, "operator")
    assert issue(own_fleet, "operator").name == "operator-2"
    async with site(own_fleet) as net:
        robot = await net.client("robot@red", "red")
        robot.serve("robot/release", answer)
        ear = SampleCollector(robot, "robot/teleop")
        old, new, of_red = (net.raw(name) for name in ("operator", "operator-2", "operator@red"))
        await query_until_answered(new, "red/robot/release")
        assert await ask(old, "red/robot/release") == []
        old.put(HELLO, b"old")
        await repeat(lambda: new.put(HELLO, b"new"), lambda: ear.samples)
        await repeat(
            lambda: of_red.put(HELLO, b"red"), lambda: ("robot/teleop", b"red") in ear.samples
        )
        assert ("robot/teleop", b"old") not in ear.samples


async def test_keys_are_revoked_by_command(own_fleet: Path, home: Home) -> None:
    revoked = await home.run(
        "keys", "revoke", "operator", "--robot", "red", "--dir", str(own_fleet)
    )
    assert f"{own_fleet}/router/generations.json: copy it to" in revoked.out
    assert revoked.out.endswith(f"gigabrain keys issue operator --robot red --dir {own_fleet}\n")
    listed = home.start("keys", "list", "--dir", str(own_fleet))
    assert await listed.ended() == 1
    assert "operator@red was revoked; delete it" in listed.out
    router = await home.run("keys", "zenohd", "--robot", "red", "--dir", str(own_fleet))
    assert '"operator@red~2"' in router.out
