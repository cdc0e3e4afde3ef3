"""Marks tests by their folders; fixtures and settings that all folders share."""

import gc
import signal
from pathlib import Path

import pytest
from hypothesis import settings

import gigabrain_zenoh.recording.arithmetic  # noqa: F401  before anything imports numpy

pytest_plugins = ["gigabrain_zenoh.testing.fixtures", "tests.resuming"]

TESTS = Path(__file__).parent
MARKS = {"unit": "unit", "fuzz": "unit", "node": "node", "system": "system"}

# how long an example takes says something of the machine, and nothing of the code
settings.register_profile("quick", deadline=None, max_examples=20)
settings.register_profile("qa", deadline=None, max_examples=1000)
settings.load_profile("quick")  # `make qa` loads the other


# of a shell that runs this in the background, commands would have SIGINT ignored from birth
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


class FailuresAtOnce:
    """Prints why a test failed when it did; a run that is stopped prints no summary."""

    def __init__(self, terminal: pytest.TerminalReporter) -> None:
        self._terminal = terminal

    @pytest.hookimpl(trylast=True)
    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Print a failure."""
        if report.failed:
            self._terminal.ensure_newline()
            self._terminal.write_line(f"{report.nodeid}, at once:\n{report.longreprtext}")


@pytest.hookimpl(trylast=True)
def pytest_configure(config: pytest.Config) -> None:
    """Print failures where there is a terminal, which workers of pytest-xdist have not."""
    if terminal := config.pluginmanager.get_plugin("terminalreporter"):
        config.pluginmanager.register(FailuresAtOnce(terminal), "failures_at_once")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark each test by the folder that it lies in."""
    for item in items:
        item.add_marker(MARKS[item.path.relative_to(TESTS).parts[0]])


def pytest_collection_finish() -> None:
    """Keep what was collected out of every garbage collection, which takes 60 ms otherwise."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The keys of a fleet with the robots red and blue; no test may change them."""
    pytest.importorskip("cryptography")
    from tests.system.keys import make_fleet

    return make_fleet(tmp_path_factory.mktemp("keys") / "home", "home")
