"""The saved maps of this machine."""

from pathlib import Path

from gigabrain_schemas.zones import SavedMapInfo
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.mapping import map_file, zone_file

MAX_MAPS = 256
MAX_NAME = 64  # characters


def saved_maps(folder: Path | None = None) -> tuple[list[SavedMapInfo], int]:
    """Return the saved maps, sorted by name, and the number of maps left out.

    An unusable map has a `problem`. Maps beyond MAX_MAPS or with unsendable names are left out.
    """
    folder = folder or map_file.folder()
    files = sorted(
        path
        for path in folder.glob("*.yaml")
        if not path.name.startswith(".") and not path.name.endswith(zone_file.ENDING)
    )
    # a name that is not UTF-8 has surrogates, which are not printable
    fitting = [path for path in files if len(path.stem) <= MAX_NAME and path.stem.isprintable()]
    chosen = fitting[:MAX_MAPS]
    return [_info(path) for path in chosen], len(files) - len(chosen)


def _info(path: Path) -> SavedMapInfo:
    try:
        found, zones = map_file.load(path), zone_file.load(path)
    except ConfigError as error:
        return SavedMapInfo(name=path.stem, problem=str(error)[:500])
    height, width = found.cells.shape
    return SavedMapInfo(
        name=path.stem,
        width=width,
        height=height,
        resolution=found.resolution,
        graph=path.with_suffix(map_file.GRAPH).is_file(),
        zones=len(zones.zones),
        places=len(zones.places),
        problem=map_file.map_problem(found),
    )


def as_line(info: SavedMapInfo) -> str:
    """Return a map as a line of text."""
    if info.problem:
        return f"{info.name:<16} cannot be used: {info.problem}"
    size = f"{info.width * info.resolution:.1f} x {info.height * info.resolution:.1f} m"
    graph = "mapping can continue" if info.graph else "for localization"
    return f"{info.name:<16} {size}, {graph}, {zone_file.listed(info.zones, info.places)}"
