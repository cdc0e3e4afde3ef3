"""Old run folders are removed unless they are in use."""

import subprocess
import sys
from pathlib import Path

from gigabrain_zenoh.host import run_folders


def make_runs(base: Path, count: int, size: int = 10) -> list[Path]:
    made = [base / f"2026010{i}T000000Z-demo-{i}" for i in range(count)]
    for path in made:
        (path / "state").mkdir(parents=True)
        (path / "state" / "driver.jsonl").write_bytes(bytes(size))
    return made


HOLD_FOLDER = (
    "import sys; from pathlib import Path; from gigabrain_zenoh.host import run_folders; "
    "run_folders.hold(Path(sys.argv[1])); print('held', flush=True); sys.stdin.read()"
)


def test_only_folders_of_ended_runs_are_removed(tmp_path: Path) -> None:
    made = make_runs(tmp_path, 3)
    words = (sys.executable, "-c", HOLD_FOLDER, str(made[0]))
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as living:
        assert living.stdout
        assert living.stdout.readline() == b"held\n"
        run_folders.prune(tmp_path, max_runs=2)
        assert sorted(tmp_path.iterdir()) == made[:1]
        living.kill()
    run_folders.prune(tmp_path, max_runs=1)
    assert sorted(tmp_path.iterdir()) == []
