"""Requests about maps, zones and places, for the page and the command line."""

from typing import Any, TypeVar

import msgspec

from gigabrain_schemas.base import Message
from gigabrain_schemas.requests import MapReply, MapRequest
from gigabrain_schemas.topics import MAP_LIST, MAP_LOAD, MAP_SAVE, ZONES_CHANGE, Service
from gigabrain_schemas.zones import (
    MapListReply,
    MapListRequest,
    MapLoadRequest,
    ZonesReply,
    ZonesRequest,
)
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.errors import BodyLost, ConfigError, Refused

ANSWER_S = 5.0  # timeout of a reply
LARGE_MAP_S = 20.0  # timeout where a large map is written or read
NO_MAPPING = (
    "no process makes or uses a map; set perception: {mapping: slam} or {mapping: localize}, "
    "and check that your keys permit it"
)
Q = TypeVar("Q", bound=Message)
R = TypeVar("R", bound=Message)


async def change_zones(bus: Bus, request: ZonesRequest) -> str:
    """Change zones or places; return the reply as text. Raises BodyLost and Refused."""
    reply = await _ask(bus, ZONES_CHANGE, request, ANSWER_S)
    return _text(reply)


async def saved_maps(bus: Bus) -> MapListReply:
    """Return the saved maps of perception's host. Raises BodyLost."""
    return await _ask(bus, MAP_LIST, MapListRequest(), LARGE_MAP_S)


async def save_map(bus: Bus, name: str, *, replace: bool, source: str = "") -> str:
    """Save the map; return the reply as text. Raises ConfigError, BodyLost and Refused."""
    fields = {"name": name, "replace": replace, "source": source or bus.process}
    reply = await _ask(bus, MAP_SAVE, _request(MapRequest, fields), LARGE_MAP_S)
    return _text(reply)


async def load_map(bus: Bus, name: str, *, mapping: str = "localize", source: str = "") -> str:
    """Load a saved map; return the reply as text. Raises the errors of `save_map`."""
    fields = {"name": name, "mapping": mapping, "source": source or bus.process}
    reply = await _ask(bus, MAP_LOAD, _request(MapLoadRequest, fields), LARGE_MAP_S)
    return _text(reply)


def _request(kind: type[Q], fields: dict[str, Any]) -> Q:
    try:
        return msgspec.convert(fields, kind)
    except msgspec.ValidationError:
        raise ConfigError(
            f"invalid map name {fields['name']!r}; expected letters, digits, - _ . "
            "and no file extension"
        ) from None


async def _ask(bus: Bus, service: Service[Q, R], request: Q, timeout_s: float) -> R:
    replies = await bus.ask(service, request, timeout_s=timeout_s)
    if not replies:
        raise BodyLost(NO_MAPPING)
    return replies[0]


def _text(reply: MapReply | ZonesReply) -> str:
    if not reply.ok:
        raise Refused(reply.text)
    return reply.text
