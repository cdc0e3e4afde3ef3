"""Commands print what to do where no robot runs."""

import pytest
from msgspec.structs import replace

from gigabrain_schemas.examples import example
from gigabrain_schemas.requests import Description
from gigabrain_zenoh.cli import diagnose, node
from gigabrain_zenoh.diagnostics.discovery import Processes
from gigabrain_zenoh.errors import BodyLost


@pytest.mark.parametrize("options", [{}, {"dot": True}, {"mermaid": True}])
def test_a_graph_without_messages_says_what_to_do(
    options: dict[str, bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    router = replace(example(Description), process="router", publishes=(), subscribes=())
    monkeypatch.setattr(node, "_find", lambda _: Processes({"router": router}, {}))
    with pytest.raises(BodyLost, match="sends to another here; start the robot with `gigabrain up"):
        node.graph(**options)


def test_a_graph_of_a_driver_alone_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    alone = replace(example(Description), process="driver", subscribes=())
    monkeypatch.setattr(node, "_find", lambda _: Processes({"driver": alone}, {}))
    node.graph()
    assert capsys.readouterr() == ("", "no process sends to another yet\n")


@pytest.mark.parametrize(
    ("text", "sentence"), [("no router answers", "no router answers."), ("is it on?", "is it on?")]
)
def test_why_ends_each_sentence_once(text: str, sentence: str) -> None:
    assert diagnose._ended(text) == sentence
