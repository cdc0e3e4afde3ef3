"""Three hosts with keys, as `deploy/three_hosts.yaml` has them, and who may do what from where."""

import re
from pathlib import Path

import pytest

from gigabrain_zenoh.client.robot import Robot
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.qa.probe import probing
from gigabrain_zenoh.security.authority import issue, new_fleet
from gigabrain_zenoh.testing.processes import Home
from gigabrain_zenoh.testing.waiting import until
from tests.places import ROOT
from tests.system.netns import network

HOSTS = ("robot", "brain", "operator")


def keyed(folder: Path, address: str) -> Path:
    """The deployment at an address of its own, and the keys beside it."""
    new_fleet("home", folder / "home")
    issue(folder / "home", "robot", hosts=(address,))
    for role in ("brain", "operator", "viewer"):
        issue(folder / "home", role)
    text = (ROOT / "deploy" / "three_hosts.yaml").read_text()
    text = re.sub(r"^router: \S+", f"router: tcp/{address}:7447", text, flags=re.MULTILINE)
    text = re.sub(r"^keys: keys", "keys: home", text, flags=re.MULTILINE)
    file = folder / "three_hosts.yaml"
    file.write_text(text)
    return file


@pytest.mark.slow
async def test_three_hosts_with_keys_drive_and_each_may_do_what_it_is_there_for(
    tmp_path: Path,
) -> None:
    with network(*HOSTS, subnet=80) as net:
        address = net.address["robot"]
        file = keyed(tmp_path, address)
        homes = {name: Home(tmp_path / name, net.hosts[name].inside) for name in HOSTS}
        try:
            for name in HOSTS:
                homes[name].start("up", str(file), "--host", name)
            router, keys = f"tls/{address}:7447", str(tmp_path / "home" / "operator")
            where = ("--connect", router, "--keys")
            async with probing(Endpoint(connect=(router,), keys=keys)) as robot:
                await robot.ticks(50)
                assert robot.state.gate.mode == "latched"
                await Robot(robot.bus).release()
                await robot.driving_straight(0.15, by_hand=True)
                viewer = await homes["operator"].run(
                    "estop", *where, str(tmp_path / "home" / "viewer")
                )
                assert (await viewer.ended(), robot.state.gate.estop_generation) == (3, 0)
                assert "NOT CONFIRMED" in viewer.out + viewer.err
                pressed = await homes["operator"].run("estop", *where, keys)
                assert "CONFIRMED" in pressed.out
                await until(lambda: robot.state.gate.mode == "latched", "the e-stop is heard of")
                brain = await homes["brain"].run(
                    "release", *where, str(tmp_path / "home" / "brain")
                )
                assert await brain.ended() != 0
                await robot.at_rest(30)
                assert robot.state.gate.mode == "latched"
                released = await homes["operator"].run("release", *where, keys)
                assert await released.ended() == 0
                await robot.driving_straight(0.15, by_hand=True)
        finally:
            for home in homes.values():
                home.close()
        assert list((homes["operator"].folder / "state").rglob("*.mcap"))


@pytest.mark.slow
async def test_a_stranger_on_the_network_gets_nothing_and_is_written_down(tmp_path: Path) -> None:
    with network("robot", "stranger", subnet=81) as net:
        address = net.address["robot"]
        file = keyed(tmp_path, address)
        new_fleet("other", tmp_path / "other")
        issue(tmp_path / "other", "operator")
        homes = {n: Home(tmp_path / n, net.hosts[n].inside) for n in ("robot", "stranger")}
        try:
            homes["robot"].start("up", str(file), "--host", "robot")
            keys = str(tmp_path / "home" / "operator")
            endpoint = Endpoint(connect=(f"tls/{address}:7447",), keys=keys)
            async with probing(endpoint) as robot:
                for line in (
                    ("--connect", f"tcp/{address}:7447"),
                    (
                        "--connect",
                        f"tls/{address}:7447",
                        "--keys",
                        str(tmp_path / "other/operator"),
                    ),
                ):
                    tried = await homes["stranger"].run("estop", *line)
                    assert await tried.ended() != 0
                    assert " CONFIRMED" not in tried.out.replace("NOT CONFIRMED", "")
                told = await homes["robot"].run(
                    "audit", "--connect", f"tls/{address}:7447", "--keys", keys
                )
                assert "a client was refused a session" in told.out
                assert robot.state.gate.estop_generation == 0
        finally:
            for home in homes.values():
                home.close()
