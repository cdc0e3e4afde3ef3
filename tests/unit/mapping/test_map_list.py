"""The saved maps of a folder are listed, whatever its files are called."""

import os
from pathlib import Path

import pytest

from gigabrain_schemas.zones import MapListReply
from gigabrain_zenoh.client.zones import load_map, save_map
from gigabrain_zenoh.codec import encode
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.mapping.map_list import saved_maps
from gigabrain_zenoh.testing.in_memory import Net

LATIN_1 = os.fsdecode(b"K\xfcche")  # "Küche", as an archive of another system may hold it


def test_a_name_that_is_no_text_is_counted_and_not_listed(tmp_path: Path) -> None:
    for name in (LATIN_1, "Küche", "two\nlines"):
        (tmp_path / f"{name}.yaml").touch()
    maps, more = saved_maps(tmp_path)
    assert ([one.name for one in maps], more) == (["Küche"], 2)
    assert encode(MapListReply(maps=tuple(maps)))


async def test_a_name_that_is_no_text_is_refused_in_one_line() -> None:
    told = r"^invalid map name 'K\\udcfcche'; expected letters, digits, .* extension$"
    bus = Net().one
    with pytest.raises(ConfigError, match=told):
        await load_map(bus, LATIN_1)
    with pytest.raises(ConfigError, match=told):
        await save_map(bus, LATIN_1, replace=False)
