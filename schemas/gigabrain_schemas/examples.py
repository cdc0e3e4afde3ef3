"""One realistic example of every message, and files for other languages.

The folder `golden` has each example as JSON and as MessagePack, as on the wire. The JSON is
written by hand; `python -m gigabrain_schemas.examples` formats it and writes the MessagePack.
"""

import sys
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from gigabrain_schemas.base import Message
from gigabrain_schemas.topics import SERVICES, TOPICS, Service, Topic, messages

M = TypeVar("M", bound=Message)

FOLDER = Path(__file__).parent / "golden"


def example(kind: type[M], folder: Path = FOLDER) -> M:
    """Return the example of one message type. Raises FileNotFoundError without one."""
    return msgspec.json.decode((folder / f"{kind.__name__}.json").read_bytes(), type=kind)


EXAMPLES: dict[str, Message] = {kind.__name__: example(kind) for kind in messages()}


def export(folder: Path) -> list[Path]:
    """Write `<Message>.json` per message, `topics.json` and `services.json`; return the paths.

    Raises OSError.
    """
    contents: dict[str, Any] = {m.__name__: msgspec.json.schema(m) for m in messages()}
    contents["topics"] = [_topic(topic) for topic in TOPICS]
    contents["services"] = [_service(service) for service in SERVICES]
    folder.mkdir(parents=True, exist_ok=True)
    return [_write(folder / f"{name}.json", content) for name, content in contents.items()]


def _topic(topic: Topic[Any]) -> dict[str, Any]:
    return {
        "key": topic.at("*"),
        "message": topic.type.__name__,
        "rate_hz": topic.hz,
        "stale_after_ms": topic.stale_after_ns / 1e6,
        "priority": topic.priority,
        "congestion": topic.congestion,
        "express": topic.express,
        "keep": topic.keep,
        "depth": topic.depth,
        "max_bytes": topic.max_bytes,
    }


def _service(service: Service[Any, Any]) -> dict[str, Any]:
    return {
        "key": service.at("*"),
        "request": service.request.__name__,
        "reply": service.reply.__name__,
        "priority": service.priority,
        "max_bytes": service.max_bytes,
    }


def _write(path: Path, content: Any) -> Path:
    path.write_bytes(msgspec.json.format(msgspec.json.encode(content)) + b"\n")
    return path


def files() -> dict[str, bytes]:
    """Return the content of the golden folder by file name."""
    content: dict[str, bytes] = {}
    for name, message in EXAMPLES.items():
        content[f"{name}.msgpack"] = msgspec.msgpack.encode(message)
        content[f"{name}.json"] = msgspec.json.format(msgspec.json.encode(message)) + b"\n"
    return content


def write(folder: Path) -> None:
    """Write all golden files, and remove those of removed messages."""
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
