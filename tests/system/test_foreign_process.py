"""A package may bring its own process: entry point `gigabrain.processes`, one row."""

import os
import shutil
from pathlib import Path

import msgspec
import pytest

from gigabrain_schemas.requests import DescribeRequest
from gigabrain_schemas.topics import DESCRIBE
from gigabrain_zenoh.config.settings import Endpoint, ProcessConfig
from gigabrain_zenoh.errors import ConfigError, UnknownName
from gigabrain_zenoh.launch.deployment import Deployment, check_keys, load_deployment
from gigabrain_zenoh.launch.processes import grants, names_by_role, process_type
from gigabrain_zenoh.launch.specs import process_specs
from gigabrain_zenoh.runtime.connect import connect
from gigabrain_zenoh.security.acl import Table, access_control
from gigabrain_zenoh.security.authority import issue, new_fleet
from gigabrain_zenoh.testing.processes import Home, free_port
from gigabrain_zenoh.testing.waiting import until

ROW = '''"""The row of a lamp."""

from msgspec import Struct

from gigabrain_zenoh.launch.process import ProcessType


class LampConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings in the `lamp` part of a deployment file."""

    port: str
    state_dir: str = ""


LAMP = ProcessType("lamp_node:run", LampConfig, looks_on=True, writes=("robot/lamp/**",))
'''
NODE = '''"""A lamp that hangs once it is told to."""

import logging
import time
from pathlib import Path


async def run(config, bus, ready):
    logging.getLogger(__name__).info("the lamp at %s", config.port)
    hang = Path(config.port)
    ready()
    async for _ in bus.clock.every(50_000_000):
        while hang.exists():
            time.sleep(0.05)
'''


@pytest.fixture(autouse=True)
def package(site: Path) -> Path:
    """Write the package's modules and metadata into `site`, as pip does; return `site`."""
    info = site / "lamp-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: lamp\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[gigabrain.processes]\nlamp = lamp_row:LAMP\n")
    (site / "lamp_row.py").write_text(ROW)
    (site / "lamp_node.py").write_text(NODE)
    return site


class HomeWithLamp(Home):
    """A home folder where the package is installed."""

    def __init__(self, folder: Path, site: Path) -> None:
        super().__init__(folder)
        self._site = site

    @property
    def environment(self) -> dict[str, str]:
        """Return the environment of its processes."""
        found = super().environment
        return found | {"PYTHONPATH": f"{found['PYTHONPATH']}{os.pathsep}{self._site}"}


def written(folder: Path, text: str) -> Path:
    path = folder / "robot.yaml"
    path.write_text(text)
    return path


def test_deployment_files_can_have_its_settings_which_are_checked(tmp_path: Path) -> None:
    placed = "hosts: {robot: [router, driver, lamp]}\n"
    deployment = load_deployment(written(tmp_path, placed + "lamp: {port: /dev/lamp}\n"))
    spec = process_specs(deployment, "robot", tmp_path, tmp_path / "state")[-1]
    process = msgspec.json.decode(spec.config, type=ProcessConfig)
    assert process.settings == {"port": "/dev/lamp", "state_dir": str(tmp_path / "state")}
    assert (spec.name, spec.after, spec.beats) == ("lamp", ("router",), True)
    with pytest.raises(ConfigError, match=r"robot\.yaml:2: lamp\.port: expected a string, got 7"):
        load_deployment(written(tmp_path, placed + "lamp: {port: 7}\n"))
    with pytest.raises(ConfigError, match=r"robot\.yaml:1: hosts: lamp needs settings; add a part"):
        load_deployment(written(tmp_path, placed))
    with pytest.raises(ConfigError, match=r"robot\.yaml:1: .* got 'lamb'; did you mean 'lamp'"):
        load_deployment(written(tmp_path, "hosts: {robot: [lamb]}\n"))
    with pytest.raises(UnknownName, match=r"no process 'lamb'; did you mean 'lamp'\?"):
        process_type("lamb")


def test_it_needs_its_own_identity_besides_that_of_its_host(tmp_path: Path) -> None:
    fleet, host = tmp_path / "home", tmp_path / "home" / "robot@red"
    new_fleet("home", fleet)
    issue(fleet, "robot", robot="red")
    deployment = Deployment(namespace="red", keys=str(host), hosts={"h": ("lamp",)})
    with pytest.raises(ConfigError, match="keys issue process --process lamp --robot red`, and"):
        check_keys(deployment, "h")
    shutil.copytree(issue(fleet, "process", robot="red", process="bulb"), host / "lamp")
    with pytest.raises(ConfigError, match=r"process\.bulb@red; expected process\.lamp@red"):
        check_keys(deployment, "h")
    shutil.rmtree(host / "lamp")
    shutil.copytree(issue(fleet, "process", robot="red", process="lamp"), host / "lamp")
    check_keys(deployment, "h")


def test_it_may_publish_its_declared_keys_its_health_and_its_log() -> None:
    table = Table(names_by_role(), grants=grants())
    rules = {rule["id"]: rule for rule in access_control(["red"], table)["rules"]}
    assert rules["process.lamp@red says"]["key_exprs"] == [
        "red/robot/health/lamp", "red/robot/lamp/**", "red/robot/log",
    ]  # fmt: skip


@pytest.mark.slow
async def test_up_starts_a_packaged_process_and_restarts_it_when_it_hangs(
    tmp_path: Path, package: Path
) -> None:
    home, hang = HomeWithLamp(tmp_path / "home", package), tmp_path / "hang"
    router = f"tcp/127.0.0.1:{free_port()}"
    file = home.deployment(
        body="mock", router=router, hosts={"robot": ["router", "lamp"]}, lamp={"port": str(hang)}
    )
    try:
        up = home.start("up", str(file))
        async with connect(Endpoint(connect=(router,)), "test", timeout_s=None) as bus:

            async def pid() -> int:
                (answer,) = await bus.ask(DESCRIBE, DescribeRequest(), name="lamp", timeout_s=20)
                return answer.pid

            await until(lambda: "ready" in up.out and "the lamp at" in up.out, "it runs")
            before = await pid()
            hang.touch()
            await until(lambda: "lamp has made no progress for 5 s" in up.out, "it is noticed")
            hang.unlink()
            await until(lambda: up.out.count("the lamp at") == 2, "it runs again")
            assert await pid() != before
    finally:
        home.close()
