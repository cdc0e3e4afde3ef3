"""Configuration that a process gets when it is started. A separate module, to keep imports few."""

from typing import Any

from msgspec import Struct, field

from gigabrain_zenoh.config.settings import Endpoint


class ProcessConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Complete configuration of one process."""

    name: str
    endpoint: Endpoint
    settings: dict[str, Any] = field(default_factory=dict)
    run_dir: str | None = None  # folder of its log file; without it there is no log file
    json_console: bool = False  # JSON log lines on the console, for a supervisor to read
    level: str = "info"
