"""Errors about names say in words what a name may hold."""

import importlib
import json
import pkgutil
from typing import Annotated, get_origin

import msgspec
import pytest

import gigabrain_schemas
from gigabrain_schemas.sim import ThingName
from gigabrain_schemas.zones import ZonesRequest
from gigabrain_zenoh.config import settings
from gigabrain_zenoh.config.loading import expected
from gigabrain_zenoh.config.name_words import NAME_WORDS, plain, words_of


def patterns() -> set[str]:
    """All patterns of strings in messages and settings."""
    files = pkgutil.iter_modules(gigabrain_schemas.__path__, "gigabrain_schemas.")
    modules = [settings, *(importlib.import_module(one.name) for one in files)]
    found = [one for module in modules for one in vars(module).values()]
    structs = {one for one in found if isinstance(one, type) and issubclass(one, msgspec.Struct)}
    names_alone = {one for one in found if get_origin(one) is Annotated and one.__origin__ is str}
    schemas = msgspec.json.schema_components(structs | names_alone)
    seen: set[str] = set()

    def look(part: object) -> None:
        if isinstance(part, dict):
            if isinstance(part.get("pattern"), str):
                seen.add(part["pattern"])
            part = list(part.values())
        for each in part if isinstance(part, list | tuple) else ():
            look(each)

    look(json.loads(json.dumps(schemas)))
    return seen


def test_each_pattern_of_messages_and_settings_has_words_and_no_other() -> None:
    assert patterns() == set(NAME_WORDS)


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        (
            {"zone": {"name": "a/b", "kind": "keepout", "points": [(0, 0), (1, 0), (1, 1)]}},
            "zone.name: expected a string of letters, digits, spaces, - _ and ., "
            "a letter or digit first",
        ),
        ({"remove": 3}, "remove: expected a string, got a whole number"),
        ({}, "expected one of zone, place and remove"),
    ],
)
def test_an_error_of_a_request_names_the_field_and_what_it_takes(
    fields: dict[str, object], text: str
) -> None:
    with pytest.raises(msgspec.ValidationError) as caught:
        msgspec.convert(fields, ZonesRequest)
    assert plain(caught.value) == text


def test_limits_of_a_setting_are_in_words_where_there_are_some() -> None:
    words = "a string of length <= 32 and of letters, digits, - and _, a letter or digit first"
    assert expected(ThingName) == words
    assert words_of("^x$") == "matching ^x$"
