"""The relay of other frameworks: finding them, their measurements, and forwarding."""

import json
from pathlib import Path

import pytest

from gigabrain_zenoh.errors import GigabrainError
from gigabrain_zenoh.qa.bench import peer_frameworks, peer_node


def command(folder: Path, name: str, first_line: str) -> str:
    path = folder / name
    path.write_text(f"{first_line}\n")
    path.chmod(0o755)
    return str(path)


def test_a_framework_on_the_path_has_the_interpreter_of_its_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert peer_frameworks.installed() == ()
    path = command(tmp_path, "rosmaster", "#!/usr/bin/python3")
    assert peer_frameworks.installed() == (("rospy", path, "/usr/bin/python3"),)
    path = command(tmp_path, "dora", "#!/usr/bin/env python3.12")
    assert peer_frameworks.installed()[0] == ("dora", path, "python3.12")


def test_a_command_that_is_no_script_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    path = command(tmp_path, "dora", "\x7fELF")
    with pytest.raises(GigabrainError, match=f"{path} is not a Python script"):
        peer_frameworks.installed()


@pytest.mark.parametrize("size", [3, 8, 12])
def test_a_forwarded_message_has_the_size_of_the_next_hop(size: int) -> None:
    assert peer_node.passed_on(b"12345678", size) == b"12345678\0\0\0\0"[:size]


def test_times_count_after_the_settling_time_from_the_first_returned_message(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = 1_000_000_000
    monkeypatch.setattr(peer_node.time, "monotonic_ns", lambda: clock)
    monkeypatch.setattr(peer_node.time, "monotonic", lambda: clock / 1e9)
    result = tmp_path / "times.json"
    role = {"sizes": [20], "settle_s": 1.0, "seconds": 2.0, "result": str(result)}
    source = peer_node.Source(role)
    clock += 60_000_000_000  # until the others have started
    assert not source.over
    for later_ms, way_ms in ((0, 7), (500, 8), (600, 3), (1000, 4)):
        clock += later_ms * 1_000_000
        message = source.message()
        assert len(message) == 20
        clock += way_ms * 1_000_000
        source.take(message)
    assert not source.over
    clock += 1_300_000_000
    assert source.over
    source.save()
    assert json.loads(result.read_text()) == [3.0, 4.0]
