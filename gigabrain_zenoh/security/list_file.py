"""The list of the generations that are good: `{"operator": 2}`. Only 1 is, of whom it omits."""

from pathlib import Path
from typing import Annotated

import msgspec

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.bounded_file import read_bounded

LIST = "generations.json"
MOST = 10_000
MOST_BYTES = 1_000_000


def generations_in(folder: Path) -> dict[str, int]:
    """By common name; empty where no list is. Raises ConfigError for one that cannot be read."""
    path = folder / LIST
    try:
        return msgspec.json.decode(
            read_bounded(path, MOST_BYTES),
            type=dict[str, Annotated[int, msgspec.Meta(ge=1, le=MOST)]],
        )
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: {error}; copy it from the fleet's folder again") from None
