"""Golden files: the example of every message as it goes over the wire, in MessagePack and in JSON.

They hold the wire format still, and show it to those who write in other languages.
`python -m gigabrain_schemas.golden` writes them anew after a change that is meant.
"""

import sys
from pathlib import Path

import msgspec

from gigabrain_schemas.examples import EXAMPLES

FOLDER = Path(__file__).parent / "golden"


def files() -> dict[str, bytes]:
    """What belongs into the golden folder: content by file name."""
    content: dict[str, bytes] = {}
    for name, message in EXAMPLES.items():
        content[f"{name}.msgpack"] = msgspec.msgpack.encode(message)
        content[f"{name}.json"] = msgspec.json.format(msgspec.json.encode(message)) + b"\n"
    return content


def write(folder: Path) -> None:
    """Write all of them, and remove those whose message is gone."""
    folder.mkdir(parents=True, exist_ok=True)
    wanted = files()
    for path in folder.iterdir():
        if path.name not in wanted:
            path.unlink()
    for name, content in wanted.items():
        (folder / name).write_bytes(content)


if __name__ == "__main__":
    write(FOLDER)
    sys.stdout.write(f"{len(files())} files in {FOLDER}\n")
