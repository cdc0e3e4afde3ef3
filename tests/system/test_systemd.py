"""The files for service managers and containers, checked without running either."""

import re
import shutil
import subprocess
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml

from gigabrain_zenoh.config.loading import loads
from gigabrain_zenoh.host.network import exposed
from gigabrain_zenoh.launch.deployment import Deployment, load_deployment
from gigabrain_zenoh.qa.probe import probing
from gigabrain_zenoh.testing.processes import Home, endpoint_of
from gigabrain_zenoh.testing.waiting import until
from tests.places import ROOT
from tests.qa.dockerfile_steps import command, extras

UNIT = ROOT / "deploy" / "systemd" / "gigabrain@.service"
DOCKER = ROOT / "deploy" / "docker"


@pytest.fixture(scope="module")
def unit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the unit of the host `robot`, with an existing program."""
    if not shutil.which("systemd-analyze"):
        pytest.skip("no systemd-analyze here")
    path = tmp_path_factory.mktemp("units") / "gigabrain@robot.service"
    path.write_text(UNIT.read_text().replace("/opt/gigabrain/bin/gigabrain", "/bin/true"))
    return path


def analyze(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(("systemd-analyze", *words), capture_output=True, text=True)


def test_systemd_finds_nothing_wrong_with_the_unit(unit: Path) -> None:
    verified = analyze("verify", "--man=no", str(unit))
    assert (verified.returncode, verified.stdout, verified.stderr) == (0, "", "")


def test_the_unit_is_exposed_to_2_of_10_at_most(unit: Path) -> None:
    judged = analyze("security", "--offline=true", "--threshold=20", "--no-pager", str(unit))
    if "unrecognized option" in judged.stderr:
        pytest.skip("this systemd-analyze cannot judge a unit that does not run")
    assert judged.returncode == 0, judged.stdout


def test_the_docs_list_the_rights_of_a_unit_with_can_and_cameras(unit: Path) -> None:
    docs = (ROOT / "docs" / "how-to" / "many_hosts.md").read_text()
    (more,) = re.findall(r"^```text\n(\[Service\]\n.*?)^```", docs, re.MULTILINE | re.DOTALL)
    own = unit.with_name("gigabrain@arm.service")
    own.write_text(f"{unit.read_text()}\n{more}")  # later lines of a list add to it
    verified = analyze("verify", "--man=no", str(own))
    assert (verified.returncode, verified.stderr) == (0, "")
    judged = analyze("security", "--offline=true", "--threshold=25", "--no-pager", str(own))
    if "unrecognized option" in judged.stderr:
        pytest.skip("this systemd-analyze cannot judge a unit that does not run")
    assert judged.returncode == 0, judged.stdout
    assert "AF_CAN" not in UNIT.read_text()  # not allowed by default
    assert {"AF_CAN", "char-video4linux"} <= {*re.split(r"[\s=]", more)}


READ_ONLY_SHELL = """
mount --bind {folder} {folder} && mount -o remount,bind,ro / &&
exec setpriv --no-new-privs --bounding-set=-all --inh-caps=-all -- "$@"
"""


@pytest.fixture
def read_only_home(tmp_path: Path) -> Iterator[Home]:
    """Return a home on an otherwise read-only system, for processes without capabilities."""
    inside = ("unshare", "--mount", "--", "sh", "-c", READ_ONLY_SHELL.format(folder=tmp_path), "sh")
    if not all(map(shutil.which, ("unshare", "setpriv", "mount"))):
        pytest.skip("no unshare, setpriv and mount here")
    if subprocess.run((*inside, "true"), capture_output=True).returncode:
        pytest.skip("no mount namespace here; it needs root")
    refused = subprocess.run((*inside, "touch", str(ROOT / "written")), capture_output=True)
    assert b"Read-only" in refused.stderr
    home = Home(tmp_path / "home", inside)
    yield home
    home.close()


@pytest.mark.slow
async def test_a_robot_runs_without_capabilities_on_a_read_only_system(
    read_only_home: Home,
) -> None:
    file = read_only_home.deployment(resume="auto")
    up = read_only_home.start("up", str(file))
    async with probing(endpoint_of(file)) as robot:
        await robot.driving_straight(0.15, room=0.0)
    (note,) = read_only_home.folder.glob("run/gigabrain/*.json")
    before = note.stat().st_mtime_ns
    await until(lambda: note.stat().st_mtime_ns > before, "the note of a robot that is well")
    assert up.err == ""


def loaded(name: str) -> Any:
    return yaml.safe_load((DOCKER / name).read_text())


def test_the_compose_file_keeps_to_its_schema() -> None:
    schema = yaml.safe_load((ROOT / "tests" / "data" / "compose_spec.json").read_text())
    check = jsonschema.Draft201909Validator(schema)
    document = loaded("compose.yaml")
    check.validate(document)
    document["services"]["robot"]["read_olny"] = True
    with pytest.raises(jsonschema.ValidationError, match="read_olny"):
        check.validate(document)


def test_keys_mounted_as_in_the_compose_file_are_found() -> None:
    schema = yaml.safe_load((ROOT / "tests" / "data" / "compose_spec.json").read_text())
    text = (DOCKER / "compose.yaml").read_text().replace("# - ${KEYS}", "- ${KEYS}")
    document = yaml.safe_load(text)
    jsonschema.Draft201909Validator(schema).validate(document)
    for name, service in document["services"].items():
        assert f"${{KEYS}}/{name}:/etc/gigabrain/keys:ro" in service["volumes"]
    site = (DOCKER / "insecure.yaml").read_text()
    assert "insecure: true" in site
    secure = loads(site.replace("insecure: true", "keys: keys"), Deployment, "insecure.yaml")
    assert (secure.router, secure.keys) == ("tcp/robot:7447", "keys")


def test_the_image_has_the_extras_that_its_default_command_needs() -> None:
    assert command() == ["gigabrain", "up", "demo"]
    demo = load_deployment(ROOT / "deploy" / f"{command()[-1]}.yaml")
    needs = {
        "sim": demo.link == "sim",
        "nav": demo.perception.mapping == "slam" or demo.decision.behaviour == "navigate",
        "page": "page" in str(demo.hosts),
        "record": "recorder" in str(demo.hosts) or "foxglove" in str(demo.hosts),
        "keys": True,  # mounted as compose.yaml says
    }
    assert {name for name, wanted in needs.items() if wanted} <= extras()
    known = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert extras() <= set(known["optional-dependencies"])


def test_no_shipped_deployment_listens_beyond_loopback_without_keys() -> None:
    shipped = sorted((ROOT / "deploy").rglob("*.yaml"))
    found = {
        path.name: load_deployment(path)
        for path in shipped
        if re.search(r"^hosts:|^body:", path.read_text(), re.MULTILINE)
    }
    assert sorted(found) == ["demo.yaml", "insecure.yaml", "three_hosts.yaml"]
    for name, deployment in found.items():
        if name != "insecure.yaml":
            assert not deployment.insecure, name
            assert deployment.keys or not exposed((deployment.router,)), name


def test_the_docs_install_a_deployment_with_keys_as_a_service() -> None:
    docs = (ROOT / "docs" / "how-to" / "many_hosts.md").read_text()
    (installed,) = re.findall(r"install .*(deploy/\S+) /etc/gigabrain/deployment\.yaml", docs)
    deployment = load_deployment(ROOT / installed)
    assert Path(deployment.keys).name == "keys"  # beside the file, as in the docs
    assert re.search(r"cp .*home/robot/.* /etc/gigabrain/keys", docs)
    assert "/etc/gigabrain/deployment.yaml" in UNIT.read_text()


def test_every_container_is_confined() -> None:
    services = loaded("compose.yaml")["services"]
    assert sorted(services) == ["brain", "robot"] == sorted(load_hosts())
    for name, service in services.items():
        assert service["read_only"] is True, name
        assert service["cap_drop"] == ["ALL"], name
        assert service["security_opt"] == ["no-new-privileges:true"], name
        assert not {"privileged", "cap_add", "ports", "network_mode"} & set(service), name
        assert service["command"][-1] == name
    assert loaded("compose.yaml")["networks"] == {"robot": {"internal": True}}


def load_hosts() -> list[str]:
    return list(load_deployment(DOCKER / "insecure.yaml").hosts)


def test_the_image_runs_without_root_and_build_tools_and_copies_existing_files() -> None:
    text = (DOCKER / "Dockerfile").read_text()
    build, final = re.split(r"^FROM .*\n", text, flags=re.MULTILINE)[1:]
    assert re.findall(r"^USER (.*)$", final, re.MULTILINE) == ["10001:10001"]
    assert "pip install" not in final
    assert "apt-get" not in text
    for line in re.findall(r"^COPY (?!--from)(.*) \S+$", build, re.MULTILINE):
        for source in line.split():
            assert (ROOT / source).exists(), source
