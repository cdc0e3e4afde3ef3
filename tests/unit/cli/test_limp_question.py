"""`gigabrain arm limp` asks before it lets go of an arm."""

import io
import sys

import pytest

from gigabrain_zenoh.cli import arm


class Typed(io.StringIO):
    """A terminal at which something is typed."""

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("typed", ["", "\n", "no\n", "y\n"])
def test_without_a_yes_nothing_is_done(
    typed: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "stdin", Typed(typed))
    arm.limp()
    assert capsys.readouterr().out == f"{arm.LIMP_PROMPT}nothing was done\n"


@pytest.mark.parametrize("typed", ["yes\n", " YES \n", "yes"])
def test_a_yes_lets_go(typed: str, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[object] = []
    monkeypatch.setattr(arm, "_ask", lambda at, _request: asked.append(at))
    monkeypatch.setattr(sys, "stdin", Typed(typed))
    arm.limp()
    assert asked == [arm.LOCAL]
