"""The saved maps of a folder are listed; invalid file names are counted."""

import os
from pathlib import Path

import pytest

from gigabrain_schemas.zones import MapListReply, SavedMapInfo
from gigabrain_zenoh.client.zones import load_map, save_map
from gigabrain_zenoh.codec import encode
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.mapping.map_list import as_line, saved_maps
from gigabrain_zenoh.testing.in_memory import Net

LATIN_1 = os.fsdecode(b"K\xfcche")  # "Küche", as an archive of another system may hold it


def test_an_invalid_name_is_counted_and_not_listed(tmp_path: Path) -> None:
    for name in (LATIN_1, "Küche", "two\nlines"):
        (tmp_path / f"{name}.yaml").touch()
    maps, left_out = saved_maps(tmp_path)
    assert ([info.name for info in maps], left_out) == (["Küche"], 2)
    assert encode(MapListReply(maps=tuple(maps)))


async def test_an_invalid_name_is_refused_in_one_line() -> None:
    message = r"^invalid map name 'K\\udcfcche'; expected letters, digits, .* extension$"
    bus = Net().one
    with pytest.raises(ConfigError, match=message):
        await load_map(bus, LATIN_1)
    with pytest.raises(ConfigError, match=message):
        await save_map(bus, LATIN_1, replace=False)


@pytest.mark.parametrize(
    ("zones", "places", "end"),
    [(0, 1, "0 zones and 1 place"), (1, 2, "1 zone and 2 places")],
)
def test_a_map_is_listed_with_the_numbers_of_its_zones_and_places(
    zones: int, places: int, end: str
) -> None:
    info = SavedMapInfo(name="a", width=20, height=10, resolution=0.05, zones=zones, places=places)
    assert as_line(info).split(maxsplit=1)[1] == f"1.0 x 0.5 m, for localization, {end}"
