"""`--passed FILE`: goes on with a run of tests that was stopped, or in which some failed.

Each test that passes is added to the file, and those in it are left out. A run in which nothing
fails removes the file.
"""

from pathlib import Path

import pytest


class Passed:
    """The file of the tests that passed, as a plugin of pytest."""

    def __init__(self, path: Path) -> None:
        self._path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        self._known = set(path.read_text("utf-8").splitlines()) if path.exists() else set()
        self._failed: set[str] = set()
        self._file = path.open("a", encoding="utf-8", buffering=1)  # each line at once

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(
        self, config: pytest.Config, items: list[pytest.Item]
    ) -> None:
        """Leave out the tests that have passed."""
        config.hook.pytest_deselected(items=[i for i in items if i.nodeid in self._known])
        items[:] = [item for item in items if item.nodeid not in self._known]

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Add a test once it is torn down, unless one of its phases has failed."""
        if report.failed:
            self._failed.add(report.nodeid)
        if report.when == "teardown" and report.nodeid not in self._failed:
            self._file.write(f"{report.nodeid}\n")

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session, exitstatus: int) -> None:
        """Remove the file when all is done."""
        self._file.close()
        nothing_left = exitstatus == pytest.ExitCode.NO_TESTS_COLLECTED and self._known
        if exitstatus == pytest.ExitCode.OK or nothing_left:
            self._path.unlink()
            session.exitstatus = pytest.ExitCode.OK


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option."""
    parser.addoption("--passed", type=Path, help="go on with the run that wrote this file")


def pytest_configure(config: pytest.Config) -> None:
    """Resume where that is asked for."""
    if path := config.getoption("--passed"):
        config.pluginmanager.register(Passed(path), "passed")
