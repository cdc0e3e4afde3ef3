"""A few commands get signals at random moments; `tests.qa.signal_sweep` tries them all."""

import random
from collections.abc import Iterator

import pytest

from gigabrain_zenoh.cli.app import COMMANDS
from tests.qa.signal_commands import CALLS
from tests.qa.signal_sweep import PATIENCE_S, Stage, attempt

FIRST_S = 1.5  # of each command: imports, start-up, work


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stage]:
    made = Stage(tmp_path_factory.mktemp("stage"), robot=False)
    yield made
    made.close()


def test_the_sweep_knows_every_command() -> None:
    assert sorted(CALLS) == sorted(COMMANDS)


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
@pytest.mark.parametrize("command", ["proxy", "control", "topic echo", "record", "worlds"])
def test_a_signal_at_any_moment_ends_a_command(stage: Stage, command: str, name: str) -> None:
    for number in range(2):
        at_s = random.Random(f"{command} {number} {name}").random() * FIRST_S
        trial = attempt(stage, command, number, name, at_s, {0})
        assert trial.took_s < PATIENCE_S
        late = trial.problem.startswith("did not end in time")  # `make qa` judges the time
        assert late or not trial.problem, trial
