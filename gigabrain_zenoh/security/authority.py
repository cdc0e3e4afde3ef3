"""A fleet's own certificate authority: it makes itself, issues identities, and revokes them.

Certificates are X.509 v3 with EC P-256 keys (RFC 5280); the common name names a role and a robot.
Routers read revocations from their identity's folder, as Zenoh has none for certificates.
"""

import datetime
import ipaddress
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import msgspec
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from gigabrain_schemas.topics import Role
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import replace_file, sync_folder, write_synced
from gigabrain_zenoh.host.network import host_and_port, is_host, is_ip
from gigabrain_zenoh.security.acl import MAX_NAME_LENGTH, SERVERS, common_name
from gigabrain_zenoh.security.identity import read, read_certificate, read_key
from gigabrain_zenoh.security.identity_files import (
    CA,
    CA_KEY,
    CERTIFICATE,
    KEY,
    LIST,
    generations_in,
)

CA_DAYS, DAYS = 3650, 365
EARLY = datetime.timedelta(days=1)  # clocks of hosts differ
LOCAL = ("localhost", "127.0.0.1", "::1")


def new_fleet(fleet: str, folder: Path) -> None:
    """Make a fleet's authority in `folder`. Raises ConfigError where there is something already."""
    if not fleet.strip() or len(fleet) > MAX_NAME_LENGTH:
        raise ConfigError(f"fleet {fleet!r}: expected a name of 1 to {MAX_NAME_LENGTH} characters")
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name(
        [
            x509.NameAttribute(NameOID.ORGANIZATION_NAME, fleet),
            x509.NameAttribute(NameOID.COMMON_NAME, fleet),
        ]
    )
    public = key.public_key()
    certificate = (
        _builder(name, name, public, CA_DAYS)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(authority=True), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(public), critical=False)
        .sign(key, hashes.SHA256())
    )
    with _new_folder(folder) as made:
        _write(made, {CA_KEY: _pem(key), CA: _text(certificate)})


def issue(
    fleet_folder: Path,
    role: Role,
    *,
    robot: str = "",
    name: str = "",
    hosts: Sequence[str] = (),
    days: int = DAYS,
) -> Path:
    """Make an identity; returns its folder, which is to be copied to its host.

    `hosts` are the addresses and names under which a router is reached. Raises ConfigError.
    """
    if hosts and role not in SERVERS:
        raise ConfigError(f"--host: only a {' or a '.join(SERVERS)} is connected to")
    generations = generations_in(fleet_folder)
    subject = common_name(role, robot, generations.get(common_name(role, robot), 1))
    authority = read_certificate(fleet_folder / CA)
    _check_days(days, authority)
    key = ec.generate_private_key(ec.SECP256R1())
    names = list(authority.subject.get_attributes_for_oid(NameOID.ORGANIZATION_NAME))
    names.append(x509.NameAttribute(NameOID.COMMON_NAME, subject))
    usages = [ExtendedKeyUsageOID.CLIENT_AUTH]
    builder = _builder(x509.Name(names), authority.subject, key.public_key(), days)
    if role in SERVERS:  # whoever else had this could pass for a router
        usages.append(ExtendedKeyUsageOID.SERVER_AUTH)
        places = [_place(host) for host in dict.fromkeys((*LOCAL, *hosts))]
        builder = builder.add_extension(x509.SubjectAlternativeName(places), critical=False)
    certificate = (
        builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(authority=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(usages), critical=False)
        .sign(read_key(fleet_folder / CA_KEY), hashes.SHA256())
    )
    folder = fleet_folder / (name or subject.replace("/", "-").replace("~", "-"))
    with _new_folder(folder) as made:
        contents = {KEY: _pem(key), CERTIFICATE: _text(certificate), CA: _text(authority)}
        _write(made, contents)
        if role in SERVERS and generations:
            write_list(made, generations)
    return folder


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, days: int
) -> x509.CertificateBuilder:
    now = datetime.datetime.now(datetime.UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - EARLY)
        .not_valid_after(now + datetime.timedelta(days=days))
    )


def _check_days(days: int, authority: x509.Certificate) -> None:
    if not 1 <= days <= CA_DAYS:
        raise ConfigError(f"--days {days}: expected 1 to {CA_DAYS}")
    end = authority.not_valid_after_utc
    left = (end - datetime.datetime.now(datetime.UTC)).days
    if days > left:
        at_most = f"say --days {left} at most, or " if left > 0 else ""
        raise ConfigError(
            f"--days {days}: the fleet's own certificate ends on {end:%Y-%m-%d}; {at_most}"
            "make a new fleet with `gigabrain keys new`"
        )


def _usage(*, authority: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not authority,
        key_cert_sign=authority,
        crl_sign=authority,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _place(host: str) -> x509.GeneralName:
    bare = host.strip("[]")
    if is_ip(bare):
        return x509.IPAddress(ipaddress.ip_address(bare))
    if is_host(host):
        return x509.DNSName(host)
    for endpoint in (host, f"tcp/{host}"):  # what others connect to, or that without its protocol
        try:
            alone, _ = host_and_port(endpoint)
        except ValueError:
            continue
        if alone:
            raise ConfigError(f"--host {host}: give the address alone: {alone}")
    raise ConfigError(f"--host {host!r}: expected an IP address or a host name")


def _text(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )


@contextmanager
def _new_folder(folder: Path) -> Iterator[Path]:
    """A folder that is there whole or not at all. Raises ConfigError where it exists."""
    taken = ConfigError(f"{folder} exists already; keys are never overwritten: move it away first")
    if folder.exists():
        raise taken
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        made = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))  # mode 0700
        try:
            yield made
            sync_folder(made)
            made.rename(folder)
            sync_folder(folder.parent)
        except BaseException:
            shutil.rmtree(made, ignore_errors=True)
            raise
    except FileExistsError:
        raise taken from None
    except OSError as error:
        raise ConfigError(f"cannot write {folder}: {error.strerror}") from None


def _write(folder: Path, contents: Mapping[str, bytes]) -> None:
    for name, data in contents.items():
        mode = 0o600 if name in (KEY, CA_KEY) else 0o644
        write_synced(folder / name, data, mode)


def revoke(fleet_folder: Path, role: Role, robot: str = "") -> tuple[Path, ...]:
    """Call back all identities issued so far under a common name; the lists that routers want.

    Raises ConfigError for roles that may be a router: they are believed without a router.
    """
    if role in SERVERS:
        raise ConfigError(
            f"keys of a {role} can also pass for a router, which no list prevents; "
            "make a new fleet with `gigabrain keys new`"
        )
    name, known = common_name(role, robot), generations_in(fleet_folder)
    generations = {**known, name: known.get(name, 1) + 1}
    places = [place.parent for place in sorted(fleet_folder.glob(f"*/{CERTIFICATE}"))]
    routers = [place for place in places if read(place)[0].role in SERVERS]
    for folder in (fleet_folder, *routers):
        write_list(folder, generations)
    return tuple(folder / LIST for folder in routers)


def write_list(folder: Path, generations: Mapping[str, int]) -> None:
    """Replace the list in a folder. Raises ConfigError."""
    content = msgspec.json.format(msgspec.json.encode(generations)) + b"\n"
    try:
        replace_file(folder / LIST, content)
    except OSError as error:
        raise ConfigError(f"cannot write {folder / LIST}: {error.strerror}") from None
