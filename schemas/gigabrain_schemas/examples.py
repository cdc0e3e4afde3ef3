"""One realistic example of every message: the JSON files in the folder `golden`."""

from pathlib import Path
from typing import TypeVar

import msgspec

from gigabrain_schemas.base import Message
from gigabrain_schemas.topics import messages

M = TypeVar("M", bound=Message)

FOLDER = Path(__file__).parent / "golden"


def example(kind: type[M], folder: Path = FOLDER) -> M:
    """Return the example of one message type. Raises FileNotFoundError where it has none."""
    return msgspec.json.decode((folder / f"{kind.__name__}.json").read_bytes(), type=kind)


EXAMPLES: dict[str, Message] = {kind.__name__: example(kind) for kind in messages()}
