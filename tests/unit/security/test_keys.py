"""Keys on disk: how they are made, what is refused, and what the refusal says."""

import datetime
import os
import shutil
import stat
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID

from gigabrain_zenoh.bus.zenoh.config import session_config
from gigabrain_zenoh.cli.keys import identities, new
from gigabrain_zenoh.cli.keys import issue as issue_command
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.security.authority import issue, list_identities, load, new_fleet
from gigabrain_zenoh.security.identity_files import check_files, find_fleet, identity_folder
from tests.closed import close_folder


@pytest.fixture
def copied(fleet: Path, tmp_path: Path) -> Path:
    """A fleet's folder that a test may spoil."""
    return Path(shutil.copytree(fleet, tmp_path / "fleet"))


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_private_keys_are_their_owners_alone(tmp_path: Path) -> None:
    old = os.umask(0)
    try:
        new_fleet("home", tmp_path / "home")
        folder = issue(tmp_path / "home", "brain")
    finally:
        os.umask(old)
    assert mode(tmp_path / "home") == mode(folder) == 0o700
    assert mode(tmp_path / "home" / "ca.key") == mode(folder / "identity.key") == 0o600
    assert sorted(path.name for path in folder.iterdir()) == [
        "ca.crt",
        "identity.crt",
        "identity.key",
    ]


def test_nothing_is_overwritten(copied: Path) -> None:
    before = (copied / "ca.key").read_bytes()
    with pytest.raises(ConfigError, match=r"fleet exists already; keys are never overwritten"):
        new_fleet("home", copied)
    with pytest.raises(ConfigError, match=r"operator exists already; keys are never overwritten"):
        issue(copied, "operator")
    assert (copied / "ca.key").read_bytes() == before
    assert not list(copied.glob(".*"))


def test_only_who_may_be_a_router_can_pass_for_one(fleet: Path) -> None:
    may_serve = set()
    for folder in fleet.iterdir():
        if folder.is_dir():
            certificate = x509.load_pem_x509_certificate((folder / "identity.crt").read_bytes())
            usage = certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
            if ExtendedKeyUsageOID.SERVER_AUTH in usage:
                may_serve.add(folder.name)
    assert may_serve == {"robot@red", "robot@blue", "robot@green", "router"}


def test_an_identity_says_who_it_is_and_for_how_long(fleet: Path) -> None:
    identity = load(fleet / "robot@red")
    assert (identity.name, identity.role, identity.robot) == ("robot@red", "robot", "red")
    assert (identity.fleet, identity.hosts) == ("home", ("localhost", "127.0.0.1", "::1"))
    days = identity.days_left(datetime.datetime.now(datetime.UTC))
    assert 364 < days < 365


def test_what_is_wrong_with_keys_is_said_with_what_to_do(copied: Path) -> None:
    def refused(folder: Path, now: datetime.datetime | None = None) -> str:
        with pytest.raises(ConfigError) as error:
            load(folder, now)
        return str(error.value).replace(str(copied), "F")

    soon = datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=366)
    day = f"{load(copied / 'operator').expires:%Y-%m-%d}"
    assert refused(copied / "operator", soon) == (
        f"F/operator/identity.crt expired on {day}; make a new identity with "
        "`gigabrain keys issue operator` and copy its folder here"
    )
    early = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
    assert refused(copied / "operator", early).endswith("; is this machine's clock right?")
    assert refused(copied / "nobody") == (
        "F/nobody: no folder with keys; make an identity with `gigabrain keys issue ROLE` "
        "and copy its folder here"
    )
    (copied / "viewer@red" / "identity.key").chmod(0o640)
    key = "F/viewer@red/identity.key"
    assert refused(copied / "viewer@red") == f"{key} is open to others (mode 0640); chmod 600 {key}"
    (copied / "brain@red" / "identity.key").unlink()
    remedy = "copy the whole folder that `gigabrain keys issue` made"
    assert refused(copied / "brain@red") == f"F/brain@red: identity.key is missing; {remedy}"
    other = copied / "other"
    new_fleet("other", other)
    foreign = copied / "robot@red"
    shutil.copy(other / "ca.crt", foreign / "ca.crt")
    assert refused(foreign) == (
        f"F/robot@red/identity.crt was not issued by the fleet of ca.crt; {remedy}"
    )
    shutil.copy(copied / "operator" / "identity.key", copied / "router" / "identity.key")
    assert refused(copied / "router") == (
        f"F/router/identity.key does not belong to identity.crt; {remedy}"
    )
    (copied / "operator" / "identity.crt").write_text("-----BEGIN")
    assert refused(copied / "operator") == f"F/operator/identity.crt is no certificate; {remedy}"


def test_folders_that_this_user_may_not_enter_are_passed_over_or_named(
    copied: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (copied.parent / "closed").mkdir()
    close_folder(copied.parent / "closed", monkeypatch)
    monkeypatch.chdir(copied.parent)
    assert find_fleet(None) == Path("fleet")
    for read in (find_fleet, check_files, lambda folder: identities(dir=folder)):
        with pytest.raises(ConfigError, match=r"^closed\S* cannot be read by this user; run as"):
            read(Path("closed"))
    assert identity_folder("closed", "robot") == Path("closed")
    close_folder(copied / "viewer@red", monkeypatch)
    lines = [line for line, valid in list_identities(Path("fleet")) if not valid]
    assert lines == [
        "viewer@red           fleet/viewer@red cannot be read by this user; run as its owner, "
        "or chown it"
    ]


def test_a_session_does_not_begin_with_a_key_that_others_may_read(copied: Path) -> None:
    (copied / "operator" / "identity.key").chmod(0o644)
    endpoint = Endpoint(connect=("tcp/127.0.0.1:7447",), keys=str(copied / "operator"))
    with pytest.raises(ConfigError, match="is open to others"):
        session_config(endpoint)


def test_an_identity_is_good_for_a_day_at_least_and_not_beyond_its_fleet(copied: Path) -> None:
    for days in (-5, 0, 3651, 100_000_000):
        with pytest.raises(ConfigError, match=rf"^--days {days}: expected 1 to 3650$"):
            issue(copied, "viewer", days=days)
    end = r"^--days 3650: the fleet's own certificate ends on 20\d\d-\d\d-\d\d; "
    with pytest.raises(ConfigError, match=end + "use --days 3649 at most, or make a new fleet"):
        issue(copied, "viewer", days=3650)
    issue(copied, "viewer", days=3649)


@pytest.mark.parametrize(
    ("host", "complaint"),
    [
        ("tls/1.2.3.4:7447", "--host tls/1.2.3.4:7447: give the address alone: 1.2.3.4"),
        ("1.2.3.4:7447", "--host 1.2.3.4:7447: give the address alone: 1.2.3.4"),
        ("[::1]:7447", "--host [::1]:7447: give the address alone: ::1"),
        ("bad host!", "--host 'bad host!': expected an IP address or a host name"),
        ("", "--host '': expected an IP address or a host name"),
        ("1.2.3", "--host '1.2.3': expected an IP address or a host name"),
    ],
)
def test_a_certificate_names_addresses_and_hosts_and_nothing_else(
    copied: Path, host: str, complaint: str
) -> None:
    with pytest.raises(ConfigError) as error:
        issue(copied, "router", name="other", hosts=(host,))
    assert str(error.value) == complaint
    assert not (copied / "other").exists()
    good = issue(copied, "router", name="other", hosts=("10.0.0.5", "[fe80::1]", "robot_1.lan"))
    assert load(good).hosts[3:] == ("10.0.0.5", "fe80::1", "robot_1.lan")


def test_what_to_do_next_can_be_typed_as_it_is_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)

    def said() -> str:
        return capsys.readouterr().out.splitlines()[-1]

    new("x y*")
    assert said() == "next: gigabrain keys issue robot --host ADDRESS --dir 'x y*'"
    new("home", dir=Path("home"))
    home = Path("home")
    at = "tls/ADDRESS:7447"
    issue_command("viewer", dir=home)
    assert said() == f"next: gigabrain topic list --connect {at} --keys home/viewer"
    issue_command("operator", robot="red", dir=home)
    assert (
        said() == f"next: gigabrain estop --connect {at} --namespace red --keys home/operator@red"
    )
    issue_command("router", dir=home)
    assert said() == (
        "next: gigabrain router --listen tls/0.0.0.0:7447 --fleet NAMESPACE --keys home/router"
    )
    issue_command("brain", dir=Path("x y*"))
    assert said() == (
        "next: gigabrain up FILE --host HOST --keys 'x y*/brain', where FILE has a line `keys:`"
    )
