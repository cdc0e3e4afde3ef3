"""The configuration of Eclipse Zenoh's own router, zenohd, with the rules that ours has."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

from gigabrain_zenoh.bus.zenoh.config import secured, security, session_settings
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.security.acl import FIRST

HEADER = """\
// A router for several robots on a host of its own. Written by:
//   gigabrain keys zenohd{options}
// Start: zenohd --config zenohd.json5
"""


def configuration(
    robots: Sequence[str], keys: str, listen: str, generations: Mapping[str, int] = FIRST
) -> str:
    """A file for `zenohd --config`; `keys` is the folder of its identity on its own host."""
    endpoint = secured(Endpoint(listen=(listen,), keys=keys, fleet=tuple(robots)))
    settings = session_settings(endpoint) | security(endpoint, generations)
    options = "".join(f" --robot {robot}" for robot in robots if robot)
    return HEADER.format(options=options) + json.dumps(_nested(settings), indent=2) + "\n"


def _nested(settings: Mapping[str, Any]) -> dict[str, Any]:
    """`{"a/b": 1}` as `{"a": {"b": 1}}`."""
    root: dict[str, Any] = {}
    for path, value in settings.items():
        *parents, name = path.split("/")
        place = root
        for parent in parents:
            place = place.setdefault(parent, {})
        place[name] = value
    return root
