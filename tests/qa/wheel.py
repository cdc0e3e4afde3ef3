"""Builds the wheel and tries it in an empty environment: `python -m tests.qa.wheel`, minutes."""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.places import ROOT

DEMO = ("demo", "--headless", "--seconds", "10", "--speed", "2")


def run(*words: str | Path, cwd: Path) -> None:
    """Run a command without the checkout on any path. Raises CalledProcessError where it fails."""
    kept = {name: os.environ[name] for name in ("PATH", "HOME", "TMPDIR") if name in os.environ}
    environment = kept | {"XDG_STATE_HOME": str(cwd / "state"), "XDG_RUNTIME_DIR": str(cwd)}
    subprocess.run(list(map(str, words)), cwd=cwd, env=environment, check=True)


def main() -> None:
    """Build, install, ask for help, and drive."""
    with tempfile.TemporaryDirectory(prefix="wheel-") as name:
        folder = Path(name)
        if uv := shutil.which("uv"):
            run(uv, "build", "--quiet", "--wheel", "--out-dir", folder, ROOT, cwd=folder)
            run(uv, "venv", "--quiet", "--python", sys.executable, folder / "env", cwd=folder)
            install: tuple[str | Path, ...] = (uv, "pip", "install", "--quiet", "--python")
            install = (*install, folder / "env/bin/python")
        else:
            run(sys.executable, "-m", "pip", "wheel", "--no-deps", "-w", folder, ROOT, cwd=folder)
            run(sys.executable, "-m", "venv", folder / "env", cwd=folder)
            install = (folder / "env/bin/python", "-m", "pip", "install", "--quiet")
        (wheel,) = folder.glob("*.whl")
        gigabrain = folder / "env" / "bin" / "gigabrain"
        run(*install, wheel, cwd=folder)
        run(gigabrain, "--help", cwd=folder)
        run(*install, f"{wheel}[sim,nav]", cwd=folder)
        run(gigabrain, *DEMO, cwd=folder)


if __name__ == "__main__":
    main()
