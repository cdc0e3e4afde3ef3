"""Coverage-guided fuzzing of what is checked in messages.py, lines.py, yaml_files.py, notes.py.

Each of those has `check(data)`, which raises for an input that breaks a promise, and `seeds()`. An
input is a line that names a decoder, and the bytes for it.
"""

import importlib
import logging
import sys
from pathlib import Path

FOLDER = Path(__file__).parent
ROOT = FOLDER.parents[1]
CORPUS = FOLDER / "corpus"  # inputs that broke something once, and a few by hand
FOUND = ROOT / ".fuzz"  # what a run finds interesting; not kept
PACKAGES = ["gigabrain_drivers", "gigabrain_schemas", "gigabrain_zenoh"]
OPTIONS = ("-timeout=10", "-rss_limit_mb=1024", "-max_len=2048")


def fuzz(name: str) -> None:
    """Fuzz `name` with libFuzzer's options from the command line, until it fails or they say so."""
    try:
        import atheris
    except ImportError:
        sys.exit("atheris is not installed here; it has wheels for Linux on x86-64, Python < 3.14")
    sys.path[:0] = [str(ROOT), str(ROOT / "drivers"), str(ROOT / "schemas")]
    with atheris.instrument_imports(include=PACKAGES):
        module = importlib.import_module(f"tests.fuzz.{name}")
    found = FOUND / name
    found.mkdir(parents=True, exist_ok=True)
    for number, seed in enumerate(module.seeds()):
        (found / f"seed-{number}").write_bytes(seed)
    given = [*OPTIONS, f"-artifact_prefix={FOUND}-{name}-", *sys.argv[1:]]
    logging.disable()  # what the drivers say of nonsense
    atheris.Setup([sys.argv[0], *given, str(found), str(CORPUS / name)], module.check)
    atheris.Fuzz()


def split(data: bytes, known: list[str]) -> tuple[str, bytes]:
    """The decoder that the first line names, or one that its bytes stand for, and the rest."""
    head, _, rest = data.partition(b"\n")
    name = head.decode("ascii", "replace")
    return (name if name in known else known[sum(head) % len(known)]), rest
