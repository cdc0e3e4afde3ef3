"""What one process is told when it is started. Kept apart, so that starting one imports little."""

from typing import Any

from msgspec import Struct, field

from gigabrain_zenoh.settings import Endpoint


class ProcessConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Everything that one process has to know."""

    name: str
    endpoint: Endpoint
    settings: dict[str, Any] = field(default_factory=dict)
    run_dir: str | None = None  # where its log file goes; none without
    json_console: bool = False  # for a supervisor to read
    level: str = "info"
