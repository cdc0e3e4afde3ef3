"""The user's name in requests: whoever runs a command, an e-stop must get through."""

import os
from pathlib import Path

import pytest

from gigabrain_schemas.requests import EstopRequest
from gigabrain_schemas.topics import ESTOP
from gigabrain_zenoh.cli.gate import estop
from gigabrain_zenoh.codec import Codec, encode
from gigabrain_zenoh.errors import NotConfirmed
from gigabrain_zenoh.host.this_process import user_name

USER_VARIABLES = ("LOGNAME", "USER", "LNAME", "USERNAME")  # which `getpass` reads


@pytest.fixture(autouse=True)
def no_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in USER_VARIABLES:
        monkeypatch.delenv(name, raising=False)


def test_a_user_without_a_name_has_a_number(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "getuid", lambda: 2**31 - 7)  # as in a container
    assert user_name() == "user-2147483641"


@pytest.mark.parametrize("name", ["ann", "a" * 300, "人" * 300, "\udcff"])
def test_a_request_has_room_for_the_name(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setenv("LOGNAME", name)
    request = EstopRequest(source=f"{user_name()}-teleop")
    assert Codec(EstopRequest, ESTOP.max_bytes).decode(encode(request)) == request
    assert request.source.startswith(name[:1].replace("\udcff", "?"))


def test_a_user_without_a_name_can_press_the_e_stop(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(os, "getuid", lambda: 2**31 - 7)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with pytest.raises(NotConfirmed, match="NOT CONFIRMED"):
        estop()
