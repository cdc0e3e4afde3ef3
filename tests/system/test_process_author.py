"""Packages of `gigabrain process new`: they run unchanged, and their own test passes."""

import asyncio
import os
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import get_args

import pytest

from gigabrain_zenoh.decision import behaviours
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.launch.processes import process_type
from gigabrain_zenoh.perception import perceptors
from gigabrain_zenoh.qa.scaffold.packages import Kind, write_package
from gigabrain_zenoh.testing.processes import Home, free_port
from gigabrain_zenoh.testing.waiting import until

KINDS: tuple[Kind, ...] = get_args(Kind)


def install(folder: Path, site: Path) -> None:
    """Move a package into `site` and write its metadata, as pip does."""
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    info = site / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    info.mkdir(parents=True)
    lines = [
        f"[{group}]\n" + "\n".join(f"{name} = {where}" for name, where in points.items())
        for group, points in project["entry-points"].items()
    ]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    )
    package = next(path.parent for path in folder.glob("*/__init__.py"))
    package.rename(site / package.name)


@pytest.mark.parametrize("kind", KINDS)
def test_the_test_of_a_new_package_passes(kind: Kind, tmp_path: Path) -> None:
    folder = write_package(kind, "red_lamp", tmp_path)
    assert folder.name == f"red-lamp-{kind}"
    ran = subprocess.run(
        (sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-c", "pyproject.toml"),
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(folder)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stdout
    assert "1 passed" in ran.stdout


def test_each_kind_of_package_is_found_by_its_name(tmp_path: Path, site: Path) -> None:
    for kind in KINDS:
        install(write_package(kind, f"lamp_{kind}", tmp_path), site)
    assert process_type("lamp_process").writes == ("robot/lamp_process/**",)
    assert perceptors.load("lamp_perceptor").__name__ == "LampPerceptor"
    assert behaviours.load("lamp_behaviour").__name__ == "LampBehaviour"


def test_a_bad_name_is_refused_and_nothing_is_overwritten(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="expected lower-case letters"):
        write_package("process", "Red-Lamp", tmp_path)
    with pytest.raises(ConfigError, match="expected lower-case letters"):
        write_package("behaviour", "none", tmp_path)  # `class None` is invalid
    folder = write_package("process", "lamp", tmp_path)
    (folder / "README.md").write_text("mine")
    with pytest.raises(ConfigError, match="exists; nothing was written"):
        write_package("process", "lamp", tmp_path)
    assert (folder / "README.md").read_text() == "mine"


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        ("process", "camera"),
        ("process", "safety"),
        ("process", "world"),  # also a key of deployment files
        ("process", "map"),  # also a topic
        ("process", "health"),
        ("process", "goal"),
        ("perceptor", "camera"),
        ("behaviour", "avoid"),
    ],
)
def test_a_name_in_use_is_refused(kind: Kind, name: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=f"the name '{name}' is taken; choose another"):
        write_package(kind, name, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_name_used_by_another_kind_is_accepted(tmp_path: Path) -> None:
    assert write_package("behaviour", "camera", tmp_path).is_dir()
    assert write_package("process", "avoid", tmp_path).is_dir()


@pytest.mark.slow
async def test_a_new_process_runs_on_a_robot_as_its_readme_says(tmp_path: Path) -> None:
    site = tmp_path / "site"
    install(write_package("process", "lamp", tmp_path), site)

    class HomeWithLamp(Home):
        """A home folder where the package is installed."""

        @property
        def environment(self) -> dict[str, str]:
            """Return the environment of its processes."""
            found = super().environment
            return found | {"PYTHONPATH": f"{found['PYTHONPATH']}{os.pathsep}{site}"}

    home = HomeWithLamp(tmp_path / "home")
    router = f"tcp/127.0.0.1:{free_port()}"
    names = ["router", "driver", "perception", "decision", "control", "safety", "lamp"]
    try:
        file = home.deployment(
            body="mock", resume="auto", router=router, hosts={"robot": names}, lamp={"hz": 5}
        )
        async with asyncio.timeout(90):
            up = home.start("up", str(file))
            await until(lambda: "measuring" in up.out, "it runs")
            echo = await home.run("topic", "info", "robot/lamp/driven", "--connect", router)
            assert "lamp" in echo.out
    finally:
        home.close()
