"""`gigabrain estop` says that nothing is confirmed, also if Ctrl-C ends it."""

import asyncio
from types import SimpleNamespace
from typing import Any

import pytest

from gigabrain_schemas.body import GateStatus
from gigabrain_schemas.requests import GateReply
from gigabrain_zenoh.cli import gate

REPLY = GateReply(ok=True, text="stopped", robot_type="mock", gate=GateStatus())


@pytest.mark.parametrize("answered", [False, True])
def test_an_estop_that_ends_before_a_robot_answers_is_not_confirmed(
    answered: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    async def estop(_reason: str) -> GateReply:
        return REPLY

    def ask(_at: object, request: Any, _prefix: str, *, wait: bool) -> None:
        if answered:
            asyncio.run(request(SimpleNamespace(estop=estop)))
        raise KeyboardInterrupt

    monkeypatch.setattr(gate, "_ask", ask)
    with pytest.raises(KeyboardInterrupt):
        gate.estop()
    printed = capsys.readouterr().err
    assert printed.startswith("NOT CONFIRMED: ended before a robot answered; ") is not answered
