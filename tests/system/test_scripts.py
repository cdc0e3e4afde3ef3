"""Programs of the host that missions run: started there, ended, and refused."""

import asyncio
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from gigabrain_zenoh.decision.tasks.mission import Script
from gigabrain_zenoh.decision.tasks.scripts import LEASHED, Run, Scripts
from gigabrain_zenoh.decision.tasks.task_queue import Saved, TaskFile
from gigabrain_zenoh.errors import ConfigError, Refused
from gigabrain_zenoh.host import this_process
from gigabrain_zenoh.runtime.child import supervised_environment
from gigabrain_zenoh.testing.waiting import until


def test_nothing_is_written_where_there_is_no_folder() -> None:
    file = TaskFile("")
    assert file.read() == (Saved(), "")
    assert file.write((Saved(count=3),)) == ""


def program(folder: Path, text: str) -> str:
    path = folder / "beep"
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return str(folder)


async def ended(run: Run) -> tuple[bool, str]:
    await until(lambda: run.result)
    assert run.result
    return run.result


async def test_a_program_of_the_folder_is_run_there_with_its_arguments(tmp_path: Path) -> None:
    folder = program(tmp_path, 'echo "$1 in $(pwd)"')
    run = Scripts(folder).start(Script(run="beep", arguments=("twice",)))
    assert await ended(run) == (True, f"ended well: twice in {tmp_path}")


async def test_the_folder_may_be_given_by_a_relative_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program(tmp_path, "pwd")
    monkeypatch.chdir(tmp_path.parent)
    run = Scripts(tmp_path.name).start(Script(run="beep"))
    assert await ended(run) == (True, f"ended well: {tmp_path}")


@pytest.mark.parametrize(("before", "then"), [(None, "any"), ("egl", "egl")])
async def test_a_program_may_open_windows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, before: str | None, then: str
) -> None:
    monkeypatch.setenv("MUJOCO_GL", before or "")
    if before is None:
        monkeypatch.delenv("MUJOCO_GL")
    monkeypatch.setenv("GIGABRAIN_MUJOCO_GL", "")  # so that it is put back afterwards
    monkeypatch.delenv("GIGABRAIN_MUJOCO_GL")
    for _ in range(2):  # in a process, and in the one that it was forked from
        this_process.open_no_window()
    folder = program(tmp_path, 'echo "${MUJOCO_GL:-any}"')
    assert await ended(Scripts(folder).start(Script(run="beep"))) == (True, f"ended well: {then}")


def test_a_process_of_ours_imports_nothing_for_windows() -> None:
    code = """
import sys
from gigabrain_zenoh.config.settings import Endpoint, ProcessConfig
from gigabrain_zenoh.launch.processes import load_process
load_process(ProcessConfig(name="safety", endpoint=Endpoint()))
import mujoco
print("glfw" in sys.modules)
"""
    env = {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"}
    assert subprocess.check_output([sys.executable, "-c", code], text=True, env=env) == "False\n"


@pytest.mark.parametrize("chosen", ["osmesa", "nonsense"])
def test_a_process_of_ours_does_not_import_missing_graphics_that_were_chosen(chosen: str) -> None:
    code = """
import ctypes.util
ctypes.util.find_library = lambda name: None
from gigabrain_zenoh.config.settings import Endpoint, ProcessConfig
from gigabrain_zenoh.launch.processes import load_process
load_process(ProcessConfig(name="safety", endpoint=Endpoint()))
import mujoco, sys
from gigabrain_zenoh.host.this_process import chosen_graphics
print(chosen_graphics(), "mujoco.osmesa" in sys.modules)
"""
    env = {**os.environ, "MUJOCO_GL": chosen}
    made = subprocess.check_output([sys.executable, "-c", code], text=True, env=env)
    assert made == f"{chosen} False\n"


@pytest.mark.parametrize("chosen", ["osmesa", "nonsense"])
def test_a_command_that_draws_without_its_graphics_ends_in_one_line(
    tmp_path: Path, chosen: str
) -> None:
    command = [sys.executable, "-c", "from gigabrain_zenoh.cli.app import main; main()"]
    ended = subprocess.run(
        [*command, "render", str(tmp_path / "x.png"), "--world", "arena"],
        env={**os.environ, "MUJOCO_GL": chosen},
        capture_output=True,
        text=True,
        check=False,
    )
    if ended.returncode:  # no other graphics, or none at all
        assert (ended.returncode, ended.stderr.count("\n")) == (2, 1)
        assert "apt-get install" in ended.stderr
    else:
        assert (tmp_path / "x.png").exists()


def test_a_process_of_ones_own_has_the_graphics_that_were_chosen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.setenv("GIGABRAIN_MUJOCO_GL", "")  # so that it is put back afterwards
    this_process.open_no_window()
    assert supervised_environment()["MUJOCO_GL"] == "osmesa"


@pytest.mark.parametrize("chosen", ["egl", "glfw"])
@pytest.mark.parametrize("found", [True, False])
def test_graphics_that_are_installed_are_left_to_those_who_draw(
    monkeypatch: pytest.MonkeyPatch, chosen: str, found: bool
) -> None:
    for finder in ("ctypes.util.find_library", "importlib.util.find_spec"):
        monkeypatch.setattr(finder, lambda name: name if found else None)
    monkeypatch.setenv("MUJOCO_GL", chosen)
    monkeypatch.setenv("GIGABRAIN_MUJOCO_GL", "")
    monkeypatch.delenv("GIGABRAIN_MUJOCO_GL")
    this_process.open_no_window()
    assert os.environ["MUJOCO_GL"] == (chosen if found else "disable")
    assert this_process.chosen_graphics() == chosen


async def test_a_program_that_fails_says_why(tmp_path: Path) -> None:
    run = Scripts(program(tmp_path, "echo no sound >&2; exit 3")).start(Script(run="beep"))
    assert await ended(run) == (False, "ended with exit code 3: no sound")


def test_a_program_ends_on_uvloop_too(tmp_path: Path) -> None:
    uvloop = pytest.importorskip("uvloop")
    scripts = Scripts(program(tmp_path, "echo no sound; exit 3"))

    async def run() -> tuple[bool, str]:
        return await ended(scripts.start(Script(run="beep")))

    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        assert runner.run(run()) == (False, "ended with exit code 3: no sound")


async def test_a_program_that_takes_too_long_is_ended_with_all_it_has_started(
    tmp_path: Path,
) -> None:
    text = f"sleep 600 & echo $! > {tmp_path}/child; wait"
    scripts = Scripts(program(tmp_path, text))
    run = scripts.start(Script(run="beep", seconds=0.5))
    assert await ended(run) == (False, "did not end within 0.5 s; killed")
    child = int((tmp_path / "child").read_text())
    await until(lambda: _gone(child))


async def test_what_a_program_leaves_behind_ends_with_it(tmp_path: Path) -> None:
    run = Scripts(program(tmp_path, "sleep 600 & echo $!")).start(Script(run="beep"))
    well, said = await ended(run)
    assert well
    await until(lambda: _gone(int(said.rpartition(" ")[2])))


async def test_who_leaves_a_programs_group_does_not_hold_its_result_up(tmp_path: Path) -> None:
    text = "import os, signal; os.setsid(); print(os.getpid()); signal.pause()"
    wait = "while [ ! -s left ]; do sleep 0.01; done; cat left"
    lines = f'{sys.executable} -uc "{text}" 2>&1 >left & {wait}'
    run = Scripts(program(tmp_path, lines)).start(Script(run="beep"))
    well, said = await ended(run)
    os.kill(int(said.rpartition(" ")[2]), signal.SIGKILL)
    assert well


async def test_a_program_that_is_paused_goes_on_when_resumed_and_has_its_time_left(
    tmp_path: Path,
) -> None:
    os.mkfifo(tmp_path / "go")
    text = f"echo $$ > {tmp_path}/pid; read -r _ < {tmp_path}/go"
    run = Scripts(program(tmp_path, text)).start(Script(run="beep", seconds=20.0))
    pid = int(await written(tmp_path / "pid"))
    run.pause()
    run.pause()
    await until(lambda: _state(pid) == "T")
    assert run._limit
    assert run._limit.when() is None
    run.resume()
    run.resume()
    (tmp_path / "go").write_text("on\n")
    assert await ended(run) == (True, "ended well")


async def test_a_program_that_is_paused_while_it_starts_has_not_begun(tmp_path: Path) -> None:
    run = Scripts(program(tmp_path, f"touch {tmp_path}/begun")).start(Script(run="beep"))
    run.pause()
    await until(lambda: run._program)
    assert not (tmp_path / "begun").exists()
    run.resume()
    assert await ended(run) == (True, "ended well")


async def test_a_program_that_is_paused_can_be_ended(tmp_path: Path) -> None:
    text = f"echo $$ > {tmp_path}/pid; exec sleep 600"
    run = Scripts(program(tmp_path, text)).start(Script(run="beep"))
    pid = int(await written(tmp_path / "pid"))
    run.pause()
    await until(lambda: _state(pid) == "T")
    run.stop()
    await until(run._task.done)
    assert _gone(pid)


async def test_a_program_of_another_user_that_cannot_be_paused_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(_group: int, _number: int) -> None:
        raise PermissionError(1, "Operation not permitted")

    run = Scripts(program(tmp_path, f"echo $$ > {tmp_path}/pid; sleep 1")).start(Script(run="beep"))
    await written(tmp_path / "pid")
    with monkeypatch.context() as patched:
        patched.setattr(os, "killpg", refuse)
        run.pause()
        run.resume()
    assert "cannot be sent SIGSTOP: [Errno 1] Operation not permitted" in caplog.text
    assert await ended(run) == (True, "ended well")


def test_a_program_whose_decision_died_before_it_began_does_not_begin() -> None:
    command = ("/bin/sh", "-c", LEASHED, "sh", "echo", "begun")
    ran = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=False)
    assert (ran.returncode, ran.stdout) == (1, b"")


@pytest.mark.parametrize("paused", [False, True])
async def test_a_program_does_not_outlive_a_decision_that_is_killed(
    tmp_path: Path, paused: bool
) -> None:
    folder = program(tmp_path, f"sleep 600 & echo $! > {tmp_path}/child; wait")
    text = (
        "import asyncio, os\n"
        "from gigabrain_zenoh.decision.tasks.mission import Script\n"
        "from gigabrain_zenoh.decision.tasks.scripts import Scripts\n"
        "async def main():\n"
        f"    run = Scripts({folder!r}).start(Script(run='beep'))\n"
        f"    while not os.path.exists('{tmp_path}/pause'):\n"
        "        await asyncio.sleep(0.01)\n"
        "    run.pause()\n"
        "    await asyncio.sleep(600)\n"
        "asyncio.run(main())\n"
    )
    decision = await asyncio.create_subprocess_exec(sys.executable, "-c", text)
    child = int(await written(tmp_path / "child"))
    assert not _gone(child)
    if paused:
        (tmp_path / "pause").touch()
        await until(lambda: _state(child) == "T")
    decision.kill()
    await decision.wait()
    await until(lambda: _gone(child))


async def written(file: Path) -> str:
    """Return what is written to a file, once there is something."""

    def text() -> str:
        return file.read_text() if file.exists() else ""

    await until(lambda: text().strip())
    return text()


def _state(pid: int) -> str:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]


def _gone(pid: int) -> bool:
    status = Path(f"/proc/{pid}/status")
    return not status.exists() or "State:\tZ" in status.read_text()


@pytest.mark.parametrize("name", ["../beep", "/bin/sh", "boop"])
def test_no_program_of_elsewhere_is_run(tmp_path: Path, name: str) -> None:
    with pytest.raises(ConfigError, match="no script"):
        Scripts(program(tmp_path, "exit 0")).path(name)


def test_a_program_that_may_not_be_run_is_refused(tmp_path: Path) -> None:
    folder = program(tmp_path, "exit 0")
    (tmp_path / "beep").chmod(0o644)
    with pytest.raises(Refused, match="script 'beep' is not executable; chmod \\+x "):
        Scripts(folder).path("beep")
