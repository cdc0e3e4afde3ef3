"""Lost keys are called back: at a real router, and on disk."""

import shutil
from pathlib import Path

import pytest

from gigabrain_zenoh.bus.zenoh.config import router_config, session_config
from gigabrain_zenoh.cli.keys import revoke as revoke_command
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.security.authority import issue, new_fleet, read, revoke
from tests.closed import close_folder


@pytest.fixture
def own(fleet: Path, tmp_path: Path) -> Path:
    """A fleet's folder that a test may change."""
    return Path(shutil.copytree(fleet, tmp_path / "fleet"))


def test_without_the_list_the_router_knows_the_first_generation_with_it_the_newest(
    own: Path,
) -> None:
    def knows() -> tuple[str, ...]:
        at = Endpoint(listen=("tls/127.0.0.1:7447",), keys=str(own / "router"), fleet=("red",))
        subjects = session_config(at)["access_control"]["subjects"]
        named = tuple(s["cert_common_names"][0] for s in subjects if "cert_common_names" in s)
        assert named == router_config(at, own).knows
        return named

    assert "brain@red" in knows()
    lists = revoke(own, "brain", "red")
    assert own / "router" / "generations.json" in lists
    assert "brain@red" not in knows()
    assert "brain@red~2" in knows()
    revoke(own, "brain", "red")
    assert {"brain@red~3", "operator@red", "robot@red"} <= set(knows())
    identity, _ = read(issue(own, "brain", robot="red", name="spare"))
    assert (identity.name, identity.role, identity.robot) == ("brain@red~3", "brain", "red")


def test_a_router_that_is_made_later_has_the_list(own: Path) -> None:
    revoke(own, "viewer")
    later = issue(own, "router", name="later")
    assert (later / "generations.json").read_bytes() == b'{\n  "viewer": 2\n}\n'


def test_keys_that_are_elsewhere_or_open_keep_no_other_keys_from_being_revoked(own: Path) -> None:
    (own / "operator" / "identity.key").unlink()
    (own / "viewer@red" / "identity.key").chmod(0o644)
    (own / "router" / "identity.key").unlink()
    assert own / "router" / "generations.json" in revoke(own, "operator")


def test_the_list_of_a_router_that_cannot_be_read_is_not_passed_over(
    own: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    close_folder(own / "router", monkeypatch)
    with pytest.raises(ConfigError, match=r"router cannot be read by this user; run as its owner"):
        revoke(own, "operator")
    assert not (own / "generations.json").exists()


def test_without_a_router_the_command_says_where_the_list_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    home = tmp_path / "home"
    new_fleet("home", home)
    revoke_command("operator", dir=home)
    list_there = home / "generations.json"
    assert list_there.exists()
    expected = f"{list_there}: copy it to the keys of each router on its host, and restart it\n"
    assert capsys.readouterr().out.startswith(expected)


@pytest.mark.parametrize("name", ["red/robot", "/media/usb/robot", "../robot", "robot/", "..", "."])
def test_an_identity_is_made_only_where_a_revocation_finds_it(own: Path, name: str) -> None:
    before = sorted(own.parent.rglob("*"))
    with pytest.raises(ConfigError) as error:
        issue(own, "router", name=name)
    assert str(error.value) == f"--name {name!r}: expected the name of a folder, without '/'"
    assert sorted(own.parent.rglob("*")) == before


@pytest.mark.parametrize("role", ["robot", "router"])
def test_who_may_pass_for_a_router_cannot_be_called_back(own: Path, role: str) -> None:
    with pytest.raises(ConfigError, match="make a new fleet"):
        revoke(own, role)  # type: ignore[arg-type]
    assert not (own / "generations.json").exists()


@pytest.mark.parametrize("text", ["", "[]", '{"operator": 0}', '{"operator": "2"}', "\xff"])
def test_a_list_that_cannot_be_read_opens_no_door(own: Path, text: str) -> None:
    (own / "router" / "generations.json").write_text(text, encoding="latin-1")
    at = Endpoint(listen=("tls/127.0.0.1:7447",), keys=str(own / "router"), fleet=("red",))
    with pytest.raises(ConfigError, match="copy it from the fleet's folder again"):
        session_config(at)
