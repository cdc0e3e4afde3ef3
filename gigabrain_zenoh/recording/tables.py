"""A recording as tables: on the terminal, and as CSV."""

import csv
import time
from pathlib import Path

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.recording.fields import message_of, row
from gigabrain_zenoh.recording.info import Info
from gigabrain_zenoh.recording.reading import Bag, samples

HEAD = (
    f"{'key':<28} {'message':<14} {'messages':>8} {'hz':>7} {'kB':>9} {'missing':>8} "
    f"{'restarts':>9} {'longest gap':>11}"
)


def print_info(found: Info) -> None:
    """Print what is in a recording."""
    when = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(found.start_ns / 1e9))
    held = (
        f"{when}, {found.seconds:.1f} s, {found.messages} messages" if found.messages else "empty"
    )
    state = "finished" if found.finished else "unfinished or damaged"
    about = "  ".join(
        f"{k} {v}" for k, v in found.notes.get("gigabrain", {}).items() if v[:1] != "{"
    )
    print(f"{found.path}: {found.bytes / 1e6:.2f} MB, {state}  {about}".rstrip())
    print(held)
    print(HEAD)
    for key in found.keys:
        gap = f"{key.longest_gap_s:.2f} s"
        print(
            f"{key.key:<28} {key.message:<14} {key.messages:>8} {key.hz:>7.1f} "
            f"{key.bytes / 1e3:>9.1f} {key.missing:>8} {key.restarts:>9} {gap:>11}"
        )
    for damage in found.damages:
        print(damage)


def write_csv(path: Path, folder: Path) -> list[Path]:
    """One file per key, a row per message; the files. Raises ConfigError."""
    columns: dict[str, dict[str, None]] = {}  # in the order in which they first appear
    for sample in samples(path):
        if message := message_of(sample):
            columns.setdefault(sample.key, {}).update(dict.fromkeys(row(message)))
    if not columns:
        raise ConfigError(f"{path} holds no message to convert")
    places = {key: folder / f"{key.replace('/', '_')}.csv" for key in sorted(columns)}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        files = {key: place.open("w", newline="") for key, place in places.items()}
    except OSError as error:
        raise ConfigError(f"cannot write {folder}: {error.strerror}") from None
    writers = {key: csv.DictWriter(file, ("time_s", *columns[key])) for key, file in files.items()}
    for writer in writers.values():
        writer.writeheader()
    first_ns = 0
    for sample in Bag(path):
        first_ns = first_ns or sample.log_ns
        if message := message_of(sample):
            time_s = round((sample.log_ns - first_ns) / 1e9, 6)
            writers[sample.key].writerow({"time_s": time_s, **row(message)})
    for file in files.values():
        file.close()
    return list(places.values())
