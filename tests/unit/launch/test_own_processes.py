"""Processes of one's own in a deployment file: where they run, and errors with their line."""

from pathlib import Path
from typing import Any

import msgspec
import pytest

from gigabrain_zenoh.cli.processes import HostOptions, router
from gigabrain_zenoh.config.settings import Endpoint, ProcessConfig, RouterConfig
from gigabrain_zenoh.decision import behaviours
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.launch.deployment import Deployment, load_deployment
from gigabrain_zenoh.launch.own_processes import check_installed, load_own, unknown_to_router
from gigabrain_zenoh.launch.processes import (
    PROCESSES,
    load_process,
    own_processes,
    process_type,
    process_types,
)
from gigabrain_zenoh.launch.specs import process_specs
from gigabrain_zenoh.perception import perceptors
from gigabrain_zenoh.testing.in_memory import Net

MODULE = '''"""A lamp."""

from msgspec import Struct


class Config(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the lamp."""

    watts: float = 5.0


async def run(config, bus, ready):
    """Shine."""
'''
HEAD = "router: tcp/127.0.0.1:7447\n"
MINE = HEAD + "processes:\n  mine:\n    module: my_lamp.node\n"


@pytest.fixture(autouse=True)
def lamp(site: Path) -> None:
    """Write the modules into `site`, as pip would install them."""
    (site / "my_lamp").mkdir()
    (site / "my_lamp" / "__init__.py").write_text("raise RuntimeError('nobody may import this')\n")
    (site / "my_lamp" / "node.py").write_text(MODULE)
    (site / "lone_lamp.py").write_text(MODULE)


def written(folder: Path, text: str) -> Path:
    path = folder / "robot.yaml"
    path.write_text(text)
    return path


def test_the_only_host_runs_it_and_its_row_is_like_ours(tmp_path: Path) -> None:
    text = MINE + "    settings: {watts: 7}\n    writes: [robot/lamp/**]\n"
    path = written(tmp_path, text)
    deployment = load_deployment(path)
    check_installed(deployment, "robot", str(path))
    assert deployment.hosts["robot"][-1] == "mine"
    assert own_processes(deployment)["mine"].writes == ("robot/lamp/**",)
    *ours, spec = process_specs(deployment, "robot", tmp_path, tmp_path, file=str(path))
    assert (spec.name, spec.after, spec.beats, spec.optional) == ("mine", ("router",), True, True)
    assert not any(one.optional for one in ours)
    config = msgspec.json.decode(spec.config, type=ProcessConfig)
    assert (config.module, config.settings) == ("my_lamp.node", {"watts": 7})
    router = msgspec.json.decode(ours[0].config, type=ProcessConfig)
    assert router.settings["watches"] == ["mine"]
    assert router.endpoint.grants["mine"] == ("robot/lamp/**",)


def test_what_a_package_offers_by_mistake_harms_only_who_names_it(
    site: Path, tmp_path: Path
) -> None:
    info = site / "wrong-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: wrong\nVersion: 1.0\n")
    groups = "[gigabrain.processes]\nbulb = lone_lamp:run\n"
    groups += "[gigabrain.behaviours]\nbulb = lone_lamp\n"
    groups += "[gigabrain.perceptors]\nbulb = lone_lamp:Config\n"
    (info / "entry_points.txt").write_text(groups)
    assert "bulb" not in process_types()
    assert load_deployment(written(tmp_path, HEAD)).router == "tcp/127.0.0.1:7447"
    for kind, load, what in (
        ("process", process_type, "lone_lamp:run: a function without run"),
        ("behaviour", behaviours.load, "lone_lamp: a module without step"),
        ("perceptor", perceptors.load, "lone_lamp:Config: a StructMeta without Config"),
    ):
        with pytest.raises(ConfigError) as refused:
            load("bulb")
        expected = f"{kind} 'bulb' of {what}; see docs/how-to/your_own_process.md"
        assert str(refused.value) == expected


def test_a_router_by_hand_misses_no_process_that_nobody_has_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[RouterConfig] = []

    def run_at(_: HostOptions, at: Endpoint, name: str, settings: dict[str, Any]) -> int:
        assert (name, "ros2" in at.grants) == ("router", True)
        ran.append(msgspec.convert(settings, RouterConfig))
        return 0

    monkeypatch.setattr(HostOptions, "run_at", run_at)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    router()
    assert [one.watches for one in ran] == [()]


def test_hosts_may_place_it_and_several_hosts_must(tmp_path: Path) -> None:
    hosts = "hosts: {robot: [router, driver], laptop: [perception%s]}\n"
    placed = load_deployment(written(tmp_path, MINE + hosts % ", mine"))
    assert placed.hosts["laptop"] == ("perception", "mine")
    with pytest.raises(
        ConfigError, match=r"robot\.yaml:5: hosts: mine runs on none; add it to one"
    ):
        load_deployment(written(tmp_path, MINE + hosts % ""))


@pytest.mark.long
@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (MINE + "    modul: x\n", r":5: unknown field 'modul'; did you mean 'module'\?"),
        (HEAD + "processes:\n  mine: {}\n", r":3: processes\.mine: missing field 'module'"),
        (
            HEAD + "processes:\n  Mine: {module: a}\n",
            ":3: processes: expected a string of at most 32 lower-case letters",
        ),
        (HEAD + "processes:\n  mine:\n    module: a-b\n", r":4: processes\.mine\.module: expected"),
        (HEAD + "processes:\n  driver: {module: a}\n", r":3: processes\.driver: a process has tha"),
        (MINE + "perceptors:\n  mine: {}\n", r":3: processes\.mine: a process has that name alre"),
        (
            MINE + "    writes:\n    - robot/intent\n    - robot/state/x\n",
            r":7: processes\.mine\.writes\[1\]: expected robot/state, got 'robot/state/x'",
        ),
        (MINE + "    writes: [lamp]\n", r":5: processes\.mine\.writes\[0\]: expected a key below"),
        (MINE + "    writes: ['robot/**']\n", r":5: .*expected a name after robot/, got"),
        (MINE + "    writes: [robot/image/**]\n", r":5: .*expected robot/image/NAME, got"),
        (MINE + "hosts: {robot: [mime]}\n", r":5: .*got 'mime'; did you mean 'mine'\?"),
    ],
)
def test_an_error_names_its_line(text: str, complaint: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=rf"robot\.yaml{complaint}"):
        load_deployment(written(tmp_path, text))


@pytest.mark.parametrize("module", ["no_lamp", "my_lamp.nod", "my_lamp.node.deeper", "my_lamp:x.y"])
def test_a_module_that_is_not_installed_is_found_before_anything_starts(
    module: str, tmp_path: Path
) -> None:
    path = written(tmp_path, MINE.replace("my_lamp.node", module))
    with pytest.raises(ConfigError, match=r"robot\.yaml:4: processes\.mine\.module: "):
        check_installed(load_deployment(path), "robot", str(path))


def test_a_perceptor_that_no_package_offers_is_found_before_anything_starts(
    tmp_path: Path,
) -> None:
    path = written(tmp_path, HEAD + "perceptors:\n  people: {}\n")
    with pytest.raises(ConfigError, match=r"robot\.yaml:3: .*no perceptor 'people'"):
        check_installed(load_deployment(path), "robot", str(path))


def config_of(path: Path) -> ProcessConfig:
    """Return the configuration that the supervisor passes to `mine`."""
    entry = load_deployment(path).processes["mine"]
    return ProcessConfig(
        name="mine",
        endpoint=Endpoint(),
        module=entry.module,
        settings=entry.settings,
        file=str(path),
    )


def test_its_own_process_finds_its_settings_wrong_and_names_the_line(tmp_path: Path) -> None:
    text = MINE.replace("my_lamp.node", "lone_lamp") + "    settings:\n      watts: %s\n"
    _, node = load_own(config_of(written(tmp_path, text % 3)))
    assert node.args[0].watts == 3.0  # type: ignore[attr-defined]
    with pytest.raises(ConfigError, match=r"robot\.yaml:6: watts: expected a number, got 'much'"):
        load_own(config_of(written(tmp_path, text % "much")))


def test_a_module_without_its_coroutine_says_what_is_expected(tmp_path: Path) -> None:
    path = written(tmp_path, MINE.replace("my_lamp.node", "lone_lamp:shine"))
    with pytest.raises(
        ConfigError, match=r":4: .*has no coroutine 'shine'; expected async def shine\("
    ):
        load_own(config_of(path))


async def test_one_whose_run_is_no_coroutine_is_refused_as_well(site: Path, tmp_path: Path) -> None:
    (site / "lone_lamp.py").write_text(MODULE.replace("async def", "def"))
    _, node = load_own(config_of(written(tmp_path, MINE.replace("my_lamp.node", "lone_lamp"))))
    with pytest.raises(ConfigError, match=r":4: .*has no coroutine 'run'; expected async def run"):
        await node(Net().one, lambda: None)


async def test_one_that_cannot_be_loaded_fails_on_the_bus_where_its_end_is_heard(
    site: Path, tmp_path: Path
) -> None:
    (site / "lone_lamp.py").write_text("raise RuntimeError('no such board')\n")
    mine = MINE.replace("my_lamp.node", "lone_lamp")
    row, node = load_process(config_of(written(tmp_path, mine)))
    assert row.own
    with pytest.raises(RuntimeError, match="no such board"):
        await node(Net().one, lambda: None)


def test_a_process_of_a_package_may_be_unknown_to_the_router_of_another_robot_too() -> None:
    deployment = Deployment(
        hosts={"robot": ("driver", "lamp")},
        namespace="blue",
        keys="home",
        router="tcp/10.0.0.1:7447",
    )
    warning = unknown_to_router(deployment, "robot", PROCESSES)
    assert warning.startswith("lamp: the router at tcp/10.0.0.1:7447 is not in this file, and ")
