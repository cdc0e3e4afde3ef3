"""Which identities are good no more. Each common name has generations, of which one is good.

A router goes by the list in its own identity's folder: Zenoh knows no revocation of certificates.
"""

from collections.abc import Mapping
from pathlib import Path

import msgspec

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.atomic_write import replace_file
from gigabrain_zenoh.security.files import CERTIFICATE
from gigabrain_zenoh.security.identity import read
from gigabrain_zenoh.security.list_file import LIST, generations_in
from gigabrain_zenoh.security.roles import SERVERS, Role, common_name


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
