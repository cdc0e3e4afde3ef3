"""Process replay: the recorded drive of each world through the processes as they are now."""

from pathlib import Path

import pytest

from gigabrain_schemas.topics import INTENT
from gigabrain_zenoh.cli.app import make_app
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.recording.drives import DRIVES, file_of
from gigabrain_zenoh.recording.fields import message_of
from gigabrain_zenoh.recording.process_replay import SAYS, replay_process, settings_for
from gigabrain_zenoh.recording.reading import Bag
from tests import bag_rig

RECORDINGS = Path(__file__).parent / "recordings"
RENEW = "was the change meant? then: make recordings"


@pytest.mark.parametrize("process", SAYS)
@pytest.mark.parametrize("world", DRIVES)
async def test_every_process_does_what_it_did_on_the_recorded_drive(
    world: str, process: str
) -> None:
    path = file_of(RECORDINGS, world)
    outcome = await replay_process(path, process, settings_for(path, process, None))
    assert outcome.same, (outcome, RENEW)
    assert outcome.words > 30
    assert not outcome.begun_late


def test_the_recorded_drives_turn_away_from_something() -> None:
    for world in DRIVES:
        reasons = {
            getattr(message_of(sample), "reason", "").partition(" ")[0]
            for sample in Bag(file_of(RECORDINGS, world))
            if sample.key == INTENT.key
        }
        assert "turning" in reasons, world
        assert file_of(RECORDINGS, world).stat().st_size < 102_400


def call(*arguments: str) -> object:
    return make_app(arguments)(
        arguments, exit_on_error=False, print_error=False, result_action="return_value"
    )


def test_of_a_process_that_was_changed_the_first_difference_is_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = file_of(RECORDINGS, "arena")
    changed = tmp_path / "changed.yaml"
    changed.write_text("decision:\n  linear_speed: 0.1\n")
    command = ("replay", "--check", str(path), "--process", "decision")
    assert call(*command) == 0
    assert "decision does what it did" in capsys.readouterr().out
    assert call(*command, "--deployment", str(changed)) == 1
    told = capsys.readouterr().out.splitlines()
    assert told[0] == f"{path}: decision does something else; the first difference:"
    assert told[1].startswith("robot/intent at tick ")
    assert told[1].endswith(": twist.linear_x")
    assert told[2] == "  recorded 0.2, now 0.1"
    assert '"linear_x":0.2' in told[3]
    assert '"linear_x":0.1' in told[4]


def test_a_recording_without_the_process_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    bag_rig.write(path, bag_rig.drive(10))
    with pytest.raises(ConfigError, match="holds nothing that safety has said"):
        call("replay", "--check", str(path), "--process", "safety")
