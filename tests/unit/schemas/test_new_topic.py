"""A new topic declares its drawing in its own entry; the example of its message is a file."""

from pathlib import Path

import msgspec

from gigabrain_schemas.base import Message
from gigabrain_schemas.brain import Intent
from gigabrain_schemas.examples import example
from gigabrain_schemas.topics import Topic
from gigabrain_zenoh.recording.drawing import Drawer


class Bell(Message, frozen=True, kw_only=True):
    """A bell on the robot."""

    volume: float = 0.0  # [dB]


def test_a_new_topic_is_plotted_if_its_entry_says_so(tmp_path: Path) -> None:
    (tmp_path / "Bell.json").write_text('{"volume": 60.5}')
    bell = example(Bell, tmp_path)
    assert bell == Bell(volume=60.5)
    (plotted,) = Drawer().draw(Topic("robot/bell", Bell, 1, plotted=True), bell)
    assert plotted.topic == "/viz/bell_numbers"
    assert msgspec.json.decode(plotted.data)["volume"] == 60.5
    assert not Drawer().draws(Topic("robot/bell", Bell, 1))


def test_a_new_topic_with_a_known_drawing_is_drawn_without_more_code() -> None:
    planned = Topic("robot/planned", Intent, 1, drawing="path")
    (path,) = Drawer().draw(planned, example(Intent))
    assert (path.topic, path.encoding) == ("/viz/path", "protobuf")
