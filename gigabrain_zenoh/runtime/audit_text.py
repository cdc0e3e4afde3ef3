"""Entries of the audit log as lines."""

import time

import msgspec

from gigabrain_schemas.audit import AuditRecord
from gigabrain_zenoh.host.log_text import printable

WIDTH = 8  # of the widest word for what has happened


def readable(record: AuditRecord) -> str:
    """`2026-01-01 00:00:00 tick 205  estop  ann: stopped and latched; e-stop number 2`."""
    when = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(record.stamp_ns / 1e9))
    verdict = "" if record.ok else " [refused]" if record.what != "refused" else ""
    code = f" {record.code}" if record.code else ""
    times = f" ({record.times} times)" if record.times > 1 else ""
    line = (
        f"{when} tick {record.tick:<7} {record.process:<7} {record.what:<{WIDTH}} "
        f"{record.source}{code}{verdict}: {record.text}{times}"
    )
    return printable(line)


def as_json(record: AuditRecord) -> str:
    """One object in one line."""
    return msgspec.json.encode(record).decode()
