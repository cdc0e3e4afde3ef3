"""JSON Schema of every message, with the tables of topics and services, for other languages."""

from pathlib import Path
from typing import Any

import msgspec

from gigabrain_schemas.topics import SERVICES, TOPICS, Service, Topic, messages


def export(folder: Path) -> list[Path]:
    """Write `<Message>.json` each, `topics.json` and `services.json`; the paths. Raises OSError."""
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
