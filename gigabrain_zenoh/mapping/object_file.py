"""Objects and tags of a saved map: NAME.objects.json, beside NAME.yaml."""

from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta, Struct

from gigabrain_schemas.objects import MapObject, MapTag
from gigabrain_zenoh.codec import DECODE_ERRORS
from gigabrain_zenoh.errors import ConfigError, Refused
from gigabrain_zenoh.host.files import make_folder, read_bounded, replace_file
from gigabrain_zenoh.mapping import map_file

VERSION = 1
MAX_BYTES = 200_000
MAX_OBJECTS = 256


class ObjectFile(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The objects and tags of a map, in its frame."""

    version: Annotated[int, Meta(ge=1, le=VERSION)] = VERSION
    objects: Annotated[tuple[MapObject, ...], Meta(max_length=MAX_OBJECTS)] = ()
    tags: Annotated[tuple[MapTag, ...], Meta(max_length=MAX_OBJECTS)] = ()

    def __post_init__(self) -> None:
        for name, ids in (
            ("objects", [item.id for item in self.objects]),
            ("tags", [item.id for item in self.tags]),
        ):
            if len(set(ids)) < len(ids):
                raise ValueError(f"{name}: each needs an id of its own")


def path_beside(map_path: Path) -> Path:
    """Return the file beside a map's YAML file."""
    return map_path.with_suffix(map_file.OBJECTS)


def load(map_path: Path) -> ObjectFile:
    """Load the objects beside a map's YAML file, if there are any. Raises ConfigError."""
    path = path_beside(map_path)
    try:
        return msgspec.json.decode(read_bounded(path, MAX_BYTES), type=ObjectFile)
    except FileNotFoundError:
        return ObjectFile()
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    except DECODE_ERRORS as error:
        raise ConfigError(f"{path}: {str(error)[:200]}") from None


def save(map_path: Path, found: ObjectFile) -> None:
    """Write the objects beside a map's YAML file. Raises Refused."""
    path = path_beside(map_path)
    try:
        make_folder(path.parent)
        replace_file(path, encoded(found))
    except OSError as error:
        raise Refused(f"{error.filename or path}: {error.strerror}") from None


def encoded(found: ObjectFile) -> bytes:
    """Return the content of a file."""
    return msgspec.json.format(msgspec.json.encode(found), indent=1) + b"\n"
