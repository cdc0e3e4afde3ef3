"""A user's process with keys may send what it declares; the rest is refused and audited."""

import asyncio
import os
import shutil
from pathlib import Path

from gigabrain_schemas.brain import CmdVel, Twist
from gigabrain_schemas.topics import CMD_VEL, Topic
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.runtime.connect import connect
from gigabrain_zenoh.security.authority import issue, new_fleet
from gigabrain_zenoh.testing.processes import Home, free_port
from gigabrain_zenoh.testing.waiting import until

LAMP = Topic("robot/lamp/on", Twist, 5)
SOURCE = '''"""Shines as declared, and drives as nobody has allowed."""

from gigabrain_schemas.brain import CmdVel, Twist
from gigabrain_schemas.topics import CMD_VEL, Topic

LAMP = Topic("robot/lamp/on", Twist, 5)


async def run(config, bus, ready):
    ready()
    async for _ in bus.clock.every(50_000_000):
        bus.publish(LAMP, Twist(linear_x=0.0))
        bus.publish(CMD_VEL, CmdVel(linear_x=0.3, source="control"), basis=bus.time.tick)
'''


async def test_undeclared_messages_reach_nobody_and_are_audited(tmp_path: Path) -> None:
    site, fleet = tmp_path / "site", tmp_path / "fleet"
    site.mkdir()
    (site / "greedy.py").write_text(SOURCE)
    new_fleet("home", fleet)
    host = issue(fleet, "robot")
    shutil.copytree(issue(fleet, "process", process="mine"), host / "mine")
    viewer = str(issue(fleet, "viewer"))

    class HomeWithModule(Home):
        """A home folder where the module is installed."""

        @property
        def environment(self) -> dict[str, str]:
            """Return the environment of its processes."""
            found = super().environment
            return found | {"PYTHONPATH": f"{found['PYTHONPATH']}{os.pathsep}{site}"}

    home, router = HomeWithModule(tmp_path / "home"), f"tls/127.0.0.1:{free_port()}"
    file = home.deployment(
        body="mock",
        router=router,
        keys=str(host),
        hosts={"robot": ["router", "driver", "perception", "control", "safety"]},
        processes={"mine": {"module": "greedy", "writes": ["robot/lamp/**"]}},
    )
    shone: list[Twist] = []
    driven: list[CmdVel] = []
    try:
        up = home.start("up", str(file))
        at = Endpoint(connect=(router,), keys=viewer)
        async with asyncio.timeout(90), connect(at, "test", timeout_s=None) as bus:
            bus.subscribe(LAMP, lambda _key, one: shone.append(one))
            bus.subscribe(CMD_VEL, lambda _key, one: driven.append(one))
            await until(lambda: len(shone) > 20 and len(driven) > 20, "both are heard", 60)
        audit = await home.run("audit")
        assert "process.mine at tls/127.0.0.1" in audit.out, up.out
        assert "may not put robot/cmd_vel" in audit.out
    finally:
        home.close()
    assert {one.linear_x for one in driven} == {0.0}  # only control's commands arrive
