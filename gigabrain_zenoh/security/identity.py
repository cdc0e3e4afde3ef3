"""Whose keys a folder holds, and whether they can be used."""

import datetime
from collections.abc import Iterator
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from msgspec import Struct

from gigabrain_schemas.topics import Role
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import read_bounded
from gigabrain_zenoh.security.acl import Role, common_name, parse
from gigabrain_zenoh.security.identity_files import (
    CA,
    CERTIFICATE,
    KEY,
    REMEDY,
    check_files,
    check_private,
    generations_in,
    unreadable,
)

EXPIRES_SOON_DAYS = 30
MOST_BYTES = 100_000  # of a key or a certificate


class Identity(Struct, frozen=True, kw_only=True):
    """Somebody whom a fleet's routers know."""

    folder: Path
    fleet: str
    name: str  # the common name, such as robot@red
    role: Role
    robot: str  # its namespace; empty for the only one, or for all
    generation: int  # of all who have had this role
    hosts: tuple[str, ...]  # where it can be connected to
    expires: datetime.datetime

    def days_left(self, now: datetime.datetime) -> float:
        """Days until it expires; negative afterwards."""
        return (self.expires - now) / datetime.timedelta(days=1)


def load(folder: Path, now: datetime.datetime | None = None) -> Identity:
    """The identity in `folder`. Raises ConfigError where it cannot be used, and what to do."""
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
        raise ConfigError(f"{path} is valid from {begins:%Y-%m-%d}; is this machine's clock right?")
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
    """What the certificate in `folder` says, valid or not. Raises ConfigError."""
    check_files(folder)
    certificate = read_certificate(folder / CERTIFICATE)
    name = _attribute(certificate, NameOID.COMMON_NAME)
    role, robot, generation = parse(name)
    identity = Identity(
        folder=folder,
        fleet=_attribute(certificate, NameOID.ORGANIZATION_NAME),
        name=name,
        role=role,
        robot=robot,
        generation=generation,
        hosts=_hosts(certificate),
        expires=certificate.not_valid_after_utc,
    )
    return identity, certificate


def read_certificate(path: Path) -> x509.Certificate:
    """A certificate in PEM. Raises ConfigError."""
    try:
        return x509.load_pem_x509_certificate(_bytes(path))
    except ValueError:
        raise ConfigError(f"{path} is no certificate; {REMEDY}") from None


def read_key(path: Path) -> ec.EllipticCurvePrivateKey:
    """A private key in PEM. Raises ConfigError, also where others may read it."""
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
        return read_bounded(path, MOST_BYTES)
    except PermissionError:
        raise unreadable(path) from None
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; {REMEDY}") from None


def _attribute(certificate: x509.Certificate, oid: x509.ObjectIdentifier) -> str:
    values = certificate.subject.get_attributes_for_oid(oid)
    return str(values[0].value) if values else ""


def _hosts(certificate: x509.Certificate) -> tuple[str, ...]:
    try:
        places = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return ()
    return tuple(str(place.value) for place in places)


def list_identities(folder: Path) -> Iterator[tuple[str, bool]]:
    """Yield a line for each identity in a fleet's folder, or in its own, and if it is valid."""
    places = [folder] if (folder / CERTIFICATE).exists() else sorted(folder.iterdir())
    now, generations = datetime.datetime.now(datetime.UTC), generations_in(folder)
    for place in places:
        if not (place / CERTIFICATE).exists():
            continue
        try:
            one = load(place, now)
        except ConfigError as error:
            yield f"{place.name:<20} {error}", False
            continue
        if one.generation < generations.get(common_name(one.role, one.robot), 1):
            yield f"{place.name:<20} {one.name} was revoked; delete it", False
            continue
        days_left = one.days_left(now)
        soon = "  SOON" if days_left < EXPIRES_SOON_DAYS else ""
        hosts = f"  ({', '.join(one.hosts)})" if one.hosts else ""
        expires = f"expires {one.expires:%Y-%m-%d}, in {days_left:.0f} days{soon}"
        yield f"{place.name:<20} {f'{one.name} of {one.fleet}':<28} {expires}{hosts}", True
