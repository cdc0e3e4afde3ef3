"""Packages of `gigabrain driver new`: they pass the kit unchanged, and fail with a mistake."""

import runpy
import tomllib
from pathlib import Path
from unittest import mock

import pytest

from gigabrain_drivers import links
from gigabrain_drivers.driver import catalog
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.qa.conformance import authoring, driver_checks, kit
from gigabrain_zenoh.qa.conformance.driver_checks import CheckedRobot
from gigabrain_zenoh.qa.judging import DriverCheckResult


def install(folder: Path, site: Path) -> Path:
    """Move a package into `site` and write its metadata, as pip does; return its new folder."""
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    lines = [
        f"[{group}]\n" + "\n".join(f"{name} = {where}" for name, where in points.items())
        for group, points in project["entry-points"].items()
    ]
    info = site / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    info.mkdir(parents=True)
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    )
    package = next(path for path in folder.iterdir() if path.name.endswith("_driver"))
    return package.rename(site / package.name)


@pytest.mark.slow
async def test_a_new_driver_passes_the_conformance_kit(tmp_path: Path, site: Path) -> None:
    folder = authoring.write_package("kit_probe", tmp_path)
    assert folder == tmp_path / "gigabrain-kit-probe"
    package = install(folder, site)
    assert catalog.robot_files()["kit_probe"] == package / "robot.yaml"
    results = await kit.check("kit_probe", "sim", tmp_path / "kit", lambda result: None)
    assert [result for result in results if result.verdict == "FAILED"] == []
    assert sum(result.verdict == "passed" for result in results) == 11


async def test_the_test_of_a_new_driver_fails_where_a_check_fails(tmp_path: Path) -> None:
    folder = authoring.write_package("kit_tested", tmp_path)
    test = runpy.run_path(str(folder / "tests/test_driver.py"))["test_it_passes_the_kit"]
    good = DriverCheckResult("opens", "received within 5 s", "received after 1 ms", "passed")
    bad = DriverCheckResult("obeys", "within 10 %", "linear_x 0 instead of 1", "FAILED")
    with mock.patch.object(kit, "check", return_value=[good]):
        await test(tmp_path)
    with mock.patch.object(kit, "check", return_value=[good, bad]), pytest.raises(AssertionError):
        await test(tmp_path)


def test_a_driver_that_cannot_be_imported_is_refused_in_one_line(
    tmp_path: Path, site: Path
) -> None:
    with pytest.raises(ConfigError, match=r"driver 'kit_import' of .*No module named 'nowhere'"):
        driver_with_mistake(
            "kit_import", tmp_path, site, "from gigabrain_drivers.driver.base", "from nowhere.base"
        )


def test_all_names_in_the_docs_can_be_imported() -> None:
    assert {"Link", "SerialLink", "TcpLink"} <= set(vars(links))


def test_existing_files_are_not_overwritten(tmp_path: Path) -> None:
    folder = authoring.write_package("kit_twice", tmp_path)
    (folder / "README.md").write_text("mine")
    with pytest.raises(ConfigError, match="exists; nothing was written"):
        authoring.write_package("kit_twice", tmp_path)
    assert (folder / "README.md").read_text() == "mine"


@pytest.mark.parametrize("name", ["My Robot", "class", "1st", "a", "../x", "robot_", "a" * 65])
def test_an_invalid_module_name_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="expected lower-case letters"):
        authoring.write_package(name, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_the_name_of_this_package_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="gigabrain-zenoh is this one"):
        authoring.write_package("zenoh", tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["mock", "turtlebot3_waffle", "line"])
def test_the_name_of_a_known_driver_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="already"):
        authoring.write_package(name, tmp_path)


def driver_with_mistake(name: str, folder: Path, site: Path, old: str, by: str) -> CheckedRobot:
    """Return a new driver with one mistake."""
    path = install(authoring.write_package(name, folder), site) / "driver.py"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, by))
    return CheckedRobot(name, "sim", folder)


async def test_a_driver_that_exceeds_its_speed_limit_fails(tmp_path: Path, site: Path) -> None:
    plain = "Velocity(linear_x=linear_x, linear_y=linear_y, angular_z=angular_z)"
    bounded = "self.bounded(linear_x, linear_y, angular_z)"
    async with driver_with_mistake("kit_fast", tmp_path, site, bounded, plain) as subject:
        found = await driver_checks.limits(subject)
        assert (found.ok, found.measured) == (False, "at most 10.00 of max speed")
        assert not (await driver_checks.refuses_nan(subject)).ok


async def test_a_driver_that_exceeds_its_lateral_limit_fails(tmp_path: Path, site: Path) -> None:
    bounded = "self._velocity = self.bounded(linear_x, linear_y, angular_z)"
    plain = (
        "self._velocity = self.bounded(linear_x, 0.0, angular_z)\n"
        "        self._velocity = Velocity(linear_x=self._velocity.linear_x, linear_y=linear_y,\n"
        "                                  angular_z=self._velocity.angular_z)"
    )
    driver_with_mistake("kit_aside", tmp_path, site, bounded, plain)
    file = site / "kit_aside_driver/robot.yaml"
    omni = "drive_type: omni\nmax_lateral_speed: 0.2"
    file.write_text(file.read_text().replace("drive_type: differential", omni))
    async with CheckedRobot("kit_aside", "sim", tmp_path) as subject:
        found = await driver_checks.limits(subject)
        assert (found.ok, found.measured) == (False, "at most 10.00 of max speed")


@pytest.mark.parametrize("axis", ["linear_x", "linear_y", "angular_z"])
async def test_a_driver_that_drives_on_with_nan_in_one_axis_fails(
    axis: str, tmp_path: Path, site: Path
) -> None:
    call = "self.bounded(linear_x, linear_y, angular_z)"
    lenient = call.replace(axis, f"{axis} if math.isfinite({axis}) else 0.0")
    async with driver_with_mistake(f"kit_nan_{axis}", tmp_path, site, call, lenient) as subject:
        assert not (await driver_checks.refuses_nan(subject)).ok


async def test_a_driver_whose_stop_raises_fails(tmp_path: Path, site: Path) -> None:
    stop = '"""Bring the body to rest."""'
    async with driver_with_mistake(
        "kit_loud", tmp_path, site, stop, 'raise OSError("gone")'
    ) as subject:
        found = await driver_checks.never_raises(subject)
        assert (found.ok, found.measured) == (False, "stop, never opened: OSError('gone')")


async def test_a_driver_that_returns_another_velocity_than_it_sent_fails(
    tmp_path: Path, site: Path
) -> None:
    honest = "return self._velocity\n"
    lying = "return self.bounded(linear_x / 2, linear_y, angular_z)\n"
    async with driver_with_mistake("kit_lies", tmp_path, site, honest, lying) as subject:
        assert not (await driver_checks.returns(subject)).ok


async def test_after_an_unexpected_exception_the_kit_continues(tmp_path: Path, site: Path) -> None:
    reads = '"""Return the measurements of the body."""'
    subject = driver_with_mistake("kit_bad", tmp_path, site, reads, "raise KeyError('battery')")
    async with subject:
        results = await kit.run(subject, lambda result: None)
    verdicts = {result.check: result for result in results}
    assert len(results) == 16
    assert verdicts["opens"].verdict == "FAILED"
    assert "KeyError" in verdicts["opens"].measured
    assert verdicts["never raises"].verdict == "passed"


def test_the_kit_moves_no_real_body(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="choose link sim or emulated"):
        CheckedRobot("mycustombot", "real", tmp_path)
