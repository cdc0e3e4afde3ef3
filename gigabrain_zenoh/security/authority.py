"""A fleet's certificate authority: issues, reads, checks and revokes identities.

Certificates are X.509 v3 with EC P-256 keys (RFC 5280); the common name names a role and a robot.
Routers read revocations from the folder of their identity, as Zenoh has no revocation lists.
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
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
from msgspec import Struct

from gigabrain_schemas.topics import Role
from gigabrain_zenoh.errors import ConfigError, NotYetValid
from gigabrain_zenoh.host.files import (
    cannot_write,
    file_problem,
    read_bounded,
    replace_file,
    sync_folder,
    write_synced,
)
from gigabrain_zenoh.host.network import host_and_port, is_host, is_ip
from gigabrain_zenoh.security.acl import MAX_NAME_LENGTH, SERVERS, common_name, parse
from gigabrain_zenoh.security.identity_files import (
    CA,
    CA_KEY,
    CERTIFICATE,
    KEY,
    LIST,
    REMEDY,
    check_files,
    check_private,
    generations_in,
    unreadable,
)

CA_DAYS, IDENTITY_DAYS = 3650, 365  # validity
BACKDATED = datetime.timedelta(days=1)  # start of validity, as clocks of hosts differ
LOCAL = ("localhost", "127.0.0.1", "::1")


def new_fleet(fleet: str, folder: Path) -> None:
    """Create a fleet's authority in the new folder `folder`. Raises ConfigError."""
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
    with _new_folder(folder) as draft:
        _write(draft, {CA_KEY: _pem(key), CA: _text(certificate)})


def issue(
    fleet_folder: Path,
    role: Role,
    *,
    robot: str = "",
    process: str = "",
    name: str = "",
    hosts: Sequence[str] = (),
    days: int = IDENTITY_DAYS,
) -> Path:
    """Create an identity; return its folder, which must be copied to its host.

    `hosts` are the addresses and names of a router. `process` names the process of an identity with
    the role `process`. Raises ConfigError.
    """
    if hosts and role not in SERVERS:
        raise ConfigError(f"--host: only for the roles {' and '.join(SERVERS)}; leave it out")
    if name and (name == ".." or name != Path(name).name):  # `revoke` finds only such folders
        raise ConfigError(f"--name {name!r}: expected the name of a folder, without '/'")
    generations = generations_in(fleet_folder)
    first = common_name(role, robot, process=process)
    subject = common_name(role, robot, generations.get(first, 1), process)
    authority = read_certificate(fleet_folder / CA)
    _check_days(days, authority)
    key = ec.generate_private_key(ec.SECP256R1())
    names = list(authority.subject.get_attributes_for_oid(NameOID.ORGANIZATION_NAME))
    names.append(x509.NameAttribute(NameOID.COMMON_NAME, subject))
    usages = [ExtendedKeyUsageOID.CLIENT_AUTH]
    builder = _builder(x509.Name(names), authority.subject, key.public_key(), days)
    if role in SERVERS:  # with this usage, a client could pretend to be a router
        usages.append(ExtendedKeyUsageOID.SERVER_AUTH)
        alt_names = [_general_name(host) for host in dict.fromkeys((*LOCAL, *hosts))]
        builder = builder.add_extension(x509.SubjectAlternativeName(alt_names), critical=False)
    certificate = (
        builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(authority=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(usages), critical=False)
        .sign(read_key(fleet_folder / CA_KEY), hashes.SHA256())
    )
    folder = fleet_folder / (name or subject.replace("/", "-").replace("~", "-"))
    with _new_folder(folder) as draft:
        contents = {KEY: _pem(key), CERTIFICATE: _text(certificate), CA: _text(authority)}
        _write(draft, contents)
        if role in SERVERS and generations:
            write_list(draft, generations)
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
        .not_valid_before(now - BACKDATED)
        .not_valid_after(now + datetime.timedelta(days=days))
    )


def _check_days(days: int, authority: x509.Certificate) -> None:
    if not 1 <= days <= CA_DAYS:
        raise ConfigError(f"--days {days}: expected 1 to {CA_DAYS}")
    end = authority.not_valid_after_utc
    left = (end - datetime.datetime.now(datetime.UTC)).days
    if days > left:
        at_most = f"use --days {left} at most, or " if left > 0 else ""
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


def _general_name(host: str) -> x509.GeneralName:
    bare = host.strip("[]")
    if is_ip(bare):
        return x509.IPAddress(ipaddress.ip_address(bare))
    if is_host(host):
        return x509.DNSName(host)
    for endpoint in (host, f"tcp/{host}"):  # an endpoint, with or without its protocol
        try:
            address, _ = host_and_port(endpoint)
        except ValueError:
            continue
        if address:
            raise ConfigError(f"--host {host}: give the address alone: {address}")
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
    """Yield a folder that appears complete or not at all. Raises ConfigError if it exists."""
    exists = ConfigError(f"{folder} exists already; keys are never overwritten: move it away first")
    if folder.exists():
        raise exists
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        draft = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))  # mode 0700
        try:
            yield draft
            sync_folder(draft)
            draft.rename(folder)
            sync_folder(folder.parent)
        except BaseException:
            shutil.rmtree(draft, ignore_errors=True)
            raise
    except FileExistsError:
        raise exists from None
    except OSError as error:
        raise cannot_write(folder, error) from None


def _write(folder: Path, contents: Mapping[str, bytes]) -> None:
    for name, data in contents.items():
        mode = 0o600 if name in (KEY, CA_KEY) else 0o644
        write_synced(folder / name, data, mode)


def revoke(fleet_folder: Path, role: Role, robot: str = "", process: str = "") -> tuple[Path, ...]:
    """Revoke all identities of a common name; return the paths of the lists for the routers.

    Raises ConfigError for roles that may run a router, as clients check no list, and for folders
    that cannot be read.
    """
    if role in SERVERS:
        raise ConfigError(
            f"a {role} identity also works as a router, so it cannot be revoked; "
            "make a new fleet with `gigabrain keys new`"
        )
    name, known = common_name(role, robot, process=process), generations_in(fleet_folder)
    generations = {**known, name: known.get(name, 1) + 1}
    routers = list(_routers(fleet_folder))
    for folder in (fleet_folder, *routers):
        write_list(folder, generations)
    return tuple(folder / LIST for folder in routers)


def _routers(fleet_folder: Path) -> Iterator[Path]:
    """Yield the folders of identities that may run a router, also those without a key."""
    for folder in sorted(fleet_folder.iterdir()):
        try:
            (folder / CERTIFICATE).stat()
        except PermissionError:
            raise unreadable(folder) from None
        except OSError:  # not an identity
            continue
        certificate = read_certificate(folder / CERTIFICATE)
        if parse(_attribute(certificate, NameOID.COMMON_NAME)).role in SERVERS:
            yield folder


def write_list(folder: Path, generations: Mapping[str, int]) -> None:
    """Write the list of revocations in a folder. Raises ConfigError."""
    content = msgspec.json.format(msgspec.json.encode(generations)) + b"\n"
    try:
        replace_file(folder / LIST, content)
    except OSError as error:
        raise cannot_write(folder / LIST, error) from None


EXPIRES_SOON_DAYS = 30
MAX_PEM_BYTES = 100_000  # of a key or a certificate


class Identity(Struct, frozen=True, kw_only=True):
    """An identity that a fleet's routers accept."""

    folder: Path
    fleet: str
    name: str  # the common name, such as robot@red
    role: Role
    robot: str  # namespace; empty for the only robot, or for all robots
    process: str  # for the role `process`; else empty
    generation: int  # increases with each revocation
    hosts: tuple[str, ...]  # addresses and names of a router
    expires: datetime.datetime

    def days_left(self, now: datetime.datetime) -> float:
        """Return the number of days until it expires; negative if it has expired."""
        return (self.expires - now) / datetime.timedelta(days=1)


def load(folder: Path, now: datetime.datetime | None = None) -> Identity:
    """Return the identity in `folder`. Raises ConfigError if it cannot be used."""
    identity, certificate = read(folder)
    now = now or datetime.datetime.now(datetime.UTC)
    path = folder / CERTIFICATE
    if now > identity.expires:
        raise ConfigError(
            f"{path} expired on {identity.expires:%Y-%m-%d}; make a new identity with "
            f"`gigabrain keys issue {identity.role}` and copy its folder here"
        )
    if now < certificate.not_valid_before_utc:
        begins = certificate.not_valid_before_utc
        raise NotYetValid(f"{path} is valid from {begins:%Y-%m-%d}; is this machine's clock right?")
    authority = read_certificate(folder / CA)
    try:
        certificate.verify_directly_issued_by(authority)
    except (InvalidSignature, ValueError, TypeError):
        raise ConfigError(f"{path} was not issued by the fleet of {CA}; {REMEDY}") from None
    if now > authority.not_valid_after_utc:
        raise ConfigError(
            f"{folder / CA} expired on {authority.not_valid_after_utc:%Y-%m-%d}; "
            "make a new fleet with `gigabrain keys new`"
        )
    if read_key(folder / KEY).public_key() != certificate.public_key():
        raise ConfigError(f"{folder / KEY} does not belong to {CERTIFICATE}; {REMEDY}")
    return identity


def read(folder: Path) -> tuple[Identity, x509.Certificate]:
    """Return the identity and certificate in `folder`, valid or not. Raises ConfigError."""
    check_files(folder)
    certificate = read_certificate(folder / CERTIFICATE)
    name = _attribute(certificate, NameOID.COMMON_NAME)
    parts = parse(name)
    identity = Identity(
        folder=folder,
        fleet=_attribute(certificate, NameOID.ORGANIZATION_NAME),
        name=name,
        role=parts.role,
        robot=parts.robot,
        process=parts.process,
        generation=parts.generation,
        hosts=_hosts(certificate),
        expires=certificate.not_valid_after_utc,
    )
    return identity, certificate


def read_certificate(path: Path) -> x509.Certificate:
    """Read a certificate in PEM. Raises ConfigError."""
    try:
        return x509.load_pem_x509_certificate(_bytes(path))
    except ValueError:
        raise ConfigError(f"{path} is no certificate; {REMEDY}") from None


def read_key(path: Path) -> ec.EllipticCurvePrivateKey:
    """Read a private key in PEM. Raises ConfigError, also if others may read it."""
    data = _bytes(path)
    check_private(path)
    try:
        key = serialization.load_pem_private_key(data, password=None)
    except (ValueError, TypeError):
        raise ConfigError(f"{path} is no private key; {REMEDY}") from None
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise ConfigError(f"{path} is no EC key; {REMEDY}")
    return key


def _bytes(path: Path) -> bytes:
    try:
        return read_bounded(path, MAX_PEM_BYTES)
    except PermissionError:
        raise unreadable(path) from None
    except OSError as error:
        raise ConfigError(f"{path}: {file_problem(error, REMEDY)}") from None


def _attribute(certificate: x509.Certificate, oid: x509.ObjectIdentifier) -> str:
    values = certificate.subject.get_attributes_for_oid(oid)
    return str(values[0].value) if values else ""


def _hosts(certificate: x509.Certificate) -> tuple[str, ...]:
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return ()
    return tuple(str(name.value) for name in names)


def _first_name(identity: Identity) -> str:
    """Return the common name of an identity in the first generation."""
    return common_name(identity.role, identity.robot, process=identity.process)


def list_identities(folder: Path) -> Iterator[tuple[str, bool]]:
    """Yield a line for each identity in `folder`, or for `folder` itself, and if it is valid."""
    folders = [folder] if (folder / CERTIFICATE).exists() else sorted(folder.iterdir())
    now, generations = datetime.datetime.now(datetime.UTC), generations_in(folder)
    for place in folders:
        try:
            (place / CERTIFICATE).stat()
        except PermissionError:
            yield f"{place.name:<20} {unreadable(place)}", False
            continue
        except OSError:  # not an identity
            continue
        try:
            identity = load(place, now)
        except ConfigError as error:
            yield f"{place.name:<20} {error}", False
            continue
        if identity.generation < generations.get(_first_name(identity), 1):
            yield f"{place.name:<20} {identity.name} was revoked; delete it", False
            continue
        days_left = identity.days_left(now)
        soon = "  SOON" if days_left < EXPIRES_SOON_DAYS else ""
        hosts = f"  ({', '.join(identity.hosts)})" if identity.hosts else ""
        expires = f"expires {identity.expires:%Y-%m-%d}, in {days_left:.0f} days{soon}"
        yield (
            f"{place.name:<20} {f'{identity.name} of {identity.fleet}':<28} {expires}{hosts}",
            True,
        )
