"""Fixtures that several tests share."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from gigabrain_zenoh.journal import Journal, done
from tests import disturbance
from tests.stack import PATIENCE_S, Home

# how long an example takes says something of the machine, and nothing of the code
settings.register_profile("gigabrain", deadline=None)
settings.load_profile("gigabrain")


def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool:
    """One test; again where it failed and the machine stood still meanwhile."""
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    for report in disturbance.run_test(item, nextitem):
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say which tests were run again."""
    reports = terminalreporter.getreports("passed") + terminalreporter.getreports("failed")
    again = {r.nodeid for r in reports if disturbance.AGAIN in dict(r.user_properties)}
    for name in sorted(again):
        terminalreporter.write_line(f"run again, the machine had stood still: {name}")


@pytest.fixture(scope="session", autouse=True)
def patient_nodes() -> Iterator[None]:
    """In the tests' own process work beside a node is in time, however slow this machine is."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Journal, "in_time", lambda _journal, job, _patience_s: done(job, PATIENCE_S))
        yield


@pytest.fixture
def home(tmp_path: Path) -> Iterator[Home]:
    """Folders of its own for what a test starts; whatever it starts ends with the test."""
    place = Home(tmp_path)
    yield place
    place.close()


@pytest.fixture(scope="module")
def shared_home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Home]:
    """The same for all tests of a module."""
    place = Home(tmp_path_factory.mktemp("home"))
    yield place
    place.close()


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of packages; what was imported from it goes with it, as a test may run again."""
    folder = tmp_path / "site"
    folder.mkdir()
    monkeypatch.syspath_prepend(str(folder))
    yield folder
    for name, module in list(sys.modules.items()):
        if folder in Path(getattr(module, "__file__", None) or "").parents:
            del sys.modules[name]


@pytest.fixture(scope="session")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The keys of a fleet with the robots red and blue; nobody may change them."""
    pytest.importorskip("cryptography")
    from tests.keys_rig import make_fleet

    return make_fleet(tmp_path_factory.mktemp("keys") / "home", "home")
