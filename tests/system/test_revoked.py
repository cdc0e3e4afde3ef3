"""Lost keys are called back: at a real router, and on disk."""

import shutil
from pathlib import Path

import pytest

from gigabrain_zenoh.security.authority import issue, revoke
from gigabrain_zenoh.testing.processes import Home, SampleCollector, repeat
from tests.system.keys import site
from tests.system.test_acl import answer, ask, asked_until_answered

HELLO = "red/robot/teleop"


@pytest.fixture
def own(fleet: Path, tmp_path: Path) -> Path:
    """A fleet's folder that a test may change."""
    return Path(shutil.copytree(fleet, tmp_path / "fleet"))


async def test_who_was_called_back_can_do_nothing_and_the_next_of_that_role_all(own: Path) -> None:
    revoke(own, "operator")
    assert issue(own, "operator").name == "operator-2"
    async with site(own) as net:
        robot = await net.client("robot@red", "red")
        robot.serve("robot/release", answer)
        ear = SampleCollector(robot, "robot/teleop")
        old, new, of_red = (net.raw(name) for name in ("operator", "operator-2", "operator@red"))
        await asked_until_answered(new, "red/robot/release")
        assert await ask(old, "red/robot/release") == []
        old.put(HELLO, b"old")
        await repeat(lambda: new.put(HELLO, b"new"), lambda: ear.samples)
        await repeat(
            lambda: of_red.put(HELLO, b"red"), lambda: ("robot/teleop", b"red") in ear.samples
        )
        assert ("robot/teleop", b"old") not in ear.samples


async def test_keys_are_called_back_by_command(own: Path, home: Home) -> None:
    said = await home.run("keys", "revoke", "operator", "--robot", "red", "--dir", str(own))
    assert f"{own}/router/generations.json: copy it to" in said.out
    assert said.out.endswith(f"gigabrain keys issue operator --robot red --dir {own}\n")
    listed = home.start("keys", "list", "--dir", str(own))
    assert await listed.ended() == 1
    assert "operator@red was revoked; delete it" in listed.out
    router = await home.run("keys", "zenohd", "--robot", "red", "--dir", str(own))
    assert '"operator@red~2"' in router.out
