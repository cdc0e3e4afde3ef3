"""What commands print where no robot runs."""

import re

import pytest
from msgspec.structs import replace

from gigabrain_schemas.examples import example
from gigabrain_schemas.requests import Description
from gigabrain_zenoh.cli import diagnose, node
from gigabrain_zenoh.cli.options import RobotAddress
from gigabrain_zenoh.diagnostics.discovery import Processes
from gigabrain_zenoh.errors import BodyLost

NOWHERE = RobotAddress(connect="tcp/127.0.0.1:1")


@pytest.mark.parametrize("options", [{}, {"dot": True}, {"mermaid": True}])
def test_a_graph_without_messages_says_what_to_do(
    options: dict[str, bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    router = replace(example(Description), process="router", publishes=(), subscribes=())
    monkeypatch.setattr(node, "_find", lambda _: Processes({"router": router}, {}))
    with pytest.raises(BodyLost, match="sends to another here; start the robot with `gigabrain up"):
        node.graph(**options)


def test_why_ends_each_sentence_once(capsys: pytest.CaptureFixture[str]) -> None:
    assert diagnose.why(at=NOWHERE) == 10
    out = capsys.readouterr().out
    assert "is the robot running, and without keys?\nWhat to do: start the robot" in out
    assert not re.search(r"[.?]\.", out)
