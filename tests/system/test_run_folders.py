"""Old run folders are removed, but never one that is in use."""

import subprocess
import sys
from pathlib import Path

from gigabrain_zenoh.host import run_folders


def runs(base: Path, count: int, size: int = 10) -> list[Path]:
    made = [base / f"2026010{i}T000000Z-demo-{i}" for i in range(count)]
    for path in made:
        (path / "state").mkdir(parents=True)
        (path / "state" / "driver.jsonl").write_bytes(bytes(size))
    return made


HOLDS = (
    "import sys; from pathlib import Path; from gigabrain_zenoh.host import run_folders; "
    "run_folders.hold(Path(sys.argv[1])); print('held', flush=True); sys.stdin.read()"
)


def test_the_folder_of_a_living_run_stays_and_that_of_a_killed_one_goes(tmp_path: Path) -> None:
    made = runs(tmp_path, 3)
    words = (sys.executable, "-c", HOLDS, str(made[0]))
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as living:
        assert living.stdout
        assert living.stdout.readline() == b"held\n"
        run_folders.prune(tmp_path, max_runs=2)
        assert sorted(tmp_path.iterdir()) == made[:1]
        living.kill()
    run_folders.prune(tmp_path, max_runs=1)
    assert sorted(tmp_path.iterdir()) == []
