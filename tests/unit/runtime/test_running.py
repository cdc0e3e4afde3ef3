"""Notes of running robots: left by supervisors, and read by clients on the same machine."""

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from gigabrain_zenoh.cli.gate import estop
from gigabrain_zenoh.cli.options import RobotAddress
from gigabrain_zenoh.client import connection
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.errors import Ambiguous, BusError, ConfigError, NotConfirmed
from gigabrain_zenoh.runtime.running import Running, announced, find_endpoint, folder, running
from gigabrain_zenoh.security.authority import issue, new_fleet
from tests.closed import close_folder

HERE = Endpoint(connect=("tcp/127.0.0.1:7001",), namespace="alpha")


@pytest.fixture(autouse=True)
def notes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return folder()


def leave_note(folder: Path, pid: int, namespace: str, mode: int = 0o700) -> Path:
    endpoint = Endpoint(connect=(f"tcp/127.0.0.1:{pid}",), namespace=namespace)
    folder.mkdir(parents=True, exist_ok=True)
    folder.chmod(mode)
    note = folder / f"{pid}.json"
    note.write_bytes(msgspec.json.encode(Running(pid=pid, label=namespace, endpoint=endpoint)))
    return note


@contextlib.contextmanager
def living(note: Path) -> Iterator[None]:
    """As for as long as the supervisor lives that left the note."""
    with note.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def test_a_robot_is_found_for_as_long_as_its_supervisor_says(notes: Path) -> None:
    with announced("waffle in arena", HERE):
        assert running() == [Running(pid=os.getpid(), label="waffle in arena", endpoint=HERE)]
        assert find_endpoint(None) == HERE
        assert [path.name for path in notes.iterdir()] == [f"{os.getpid()}.json"]
    assert running() == []
    assert list(notes.iterdir()) == []


def test_a_client_that_names_its_identity_does_not_get_the_rights_of_the_local_socket(
    tmp_path: Path, notes: Path
) -> None:
    """`release --keys home/viewer` on the robot's own host must be refused as elsewhere."""
    viewer = str(tmp_path)
    ways = ("unixsock-stream//run/1.sock", "tls/127.0.0.1:7467")
    with announced("waffle", Endpoint(connect=ways, namespace="red")):
        as_viewer = find_endpoint(None, keys=viewer)
        assert find_endpoint(None).connect == ways
    expected = Endpoint(connect=ways[1:], namespace="red", keys=viewer)
    assert as_viewer == expected


def test_a_folder_of_keys_that_is_not_there_is_refused_where_the_robot_has_none(
    tmp_path: Path, notes: Path
) -> None:
    with announced("waffle in arena", HERE):
        with pytest.raises(ConfigError, match="operater: no folder with keys; make an identity"):
            find_endpoint(None, keys=str(tmp_path / "operater"))
        new_fleet("home", tmp_path / "home")
        identity = issue(tmp_path / "home", "operator")
        assert find_endpoint(None, keys=str(identity)) == HERE
        (identity / "ca.crt").unlink()  # a stop must not fail for what is not needed
        assert find_endpoint(None, keys=str(identity)) == HERE


def test_an_estop_is_tried_without_a_folder_of_keys_that_is_not_there(
    tmp_path: Path, notes: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    tried = list[str]()

    def connect(*_: object, keys: str, **__: object) -> None:
        tried.append(keys)
        raise BusError("no robot")

    monkeypatch.setattr(connection, "connect", connect)
    monkeypatch.setenv("HOME", str(tmp_path))
    for keys in (tmp_path / "operater", tmp_path, Path("~")):
        with pytest.raises(NotConfirmed, match="no robot"):
            estop(at=RobotAddress(keys=keys))
    assert tried == ["", str(tmp_path), "~"]
    assert capsys.readouterr().err == f"no folder {tmp_path / 'operater'}: tried without keys\n"


def test_a_note_whose_pid_is_used_again_is_that_of_a_dead_supervisor(notes: Path) -> None:
    leave_note(notes, os.getppid(), "ghost")  # a process that lives, and has left no note
    assert running() == []


@pytest.mark.parametrize("whose", ["folder", "parent", "owner", "closed"])
def test_notes_that_somebody_else_may_have_planted_are_not_believed(
    whose: str, notes: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    note = leave_note(notes, os.getpid(), "planted")
    if whose == "owner":
        monkeypatch.setattr(os, "getuid", lambda: note.stat().st_uid + 1)
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(notes.parent))
    elif whose == "closed":
        close_folder(notes.parent, monkeypatch)
    else:
        (notes if whose == "folder" else notes.parent).chmod(0o777)
    with living(note):
        with pytest.raises(ConfigError, match="belongs to another user, or others may write it"):
            find_endpoint(None)
        with (
            pytest.raises(ConfigError, match=r"belongs to another user|cannot write"),
            announced("mine", HERE),
        ):
            pass


def test_a_note_that_cannot_be_read_is_taken_away(notes: Path) -> None:
    notes.mkdir(parents=True)
    (notes / "1.json").write_text("{")
    assert running() == []
    assert list(notes.iterdir()) == []


def test_of_several_robots_the_namespace_chooses(notes: Path) -> None:
    alpha, beta = leave_note(notes, 7001, "alpha"), leave_note(notes, 7002, "beta")
    with living(alpha), living(beta):
        assert find_endpoint(None, "beta").namespace == "beta"
        with pytest.raises(Ambiguous, match=r"several robots run here; choose one with --connect"):
            find_endpoint(None)
        with pytest.raises(BusError) as unknown:
            find_endpoint(None, "gamma")
        assert str(unknown.value) == (
            "no robot runs here with namespace 'gamma'; known: alpha, beta; "
            "for one of another router, use --connect (in a script connect=)"
        )


def test_who_is_told_where_it_is_does_not_look() -> None:
    assert find_endpoint("tcp/10.0.0.1:7447", "beta") == Endpoint(
        connect=("tcp/10.0.0.1:7447",), namespace="beta"
    )


def test_a_folder_that_cannot_be_written_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "file"))
    with pytest.raises(ConfigError, match=r"cannot write .*; set XDG_RUNTIME_DIR$"):  # noqa: SIM117
        with announced("waffle", HERE):
            pass


def test_a_link_that_another_user_planted_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "runtime"
    (tmp_path / "mine").mkdir(mode=0o700)
    place.symlink_to(tmp_path / "mine")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(place))
    with announced("waffle", Endpoint(connect=("tcp/127.0.0.1:1",))):
        assert [robot.label for robot in running()] == ["waffle"]  # a link of one's own is good
        real = Path.lstat

        def lstat(path: Path) -> os.stat_result:
            about = real(path)
            return (
                os.stat_result((*about[:4], os.getuid() + 1, *about[5:]))
                if path == place
                else about
            )

        monkeypatch.setattr(Path, "lstat", lstat)
        with pytest.raises(ConfigError, match="belongs to another user"):
            running()
