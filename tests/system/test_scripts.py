"""Programs on the host that missions run: they are started, ended, or refused."""

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


def test_without_a_scripts_folder_nothing_is_created() -> None:
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


async def test_a_program_runs_in_its_folder_with_its_arguments(tmp_path: Path) -> None:
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
    monkeypatch.setenv("GIGABRAIN_MUJOCO_GL", "")  # restored after the test
    monkeypatch.delenv("GIGABRAIN_MUJOCO_GL")
    for _ in range(2):  # in a process, and in the one it was forked from
        this_process.open_no_window()
    folder = program(tmp_path, 'echo "${MUJOCO_GL:-any}"')
    assert await ended(Scripts(folder).start(Script(run="beep"))) == (True, f"ended well: {then}")


def test_our_processes_import_no_windowing_library() -> None:
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
def test_our_processes_do_not_import_missing_graphics(chosen: str) -> None:
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
def test_a_drawing_command_without_graphics_fails_in_one_line(tmp_path: Path, chosen: str) -> None:
    command = [sys.executable, "-c", "from gigabrain_zenoh.cli.app import main; main()"]
    ended = subprocess.run(
        [*command, "render", str(tmp_path / "x.png"), "--world", "arena"],
        env={**os.environ, "MUJOCO_GL": chosen},
        capture_output=True,
        text=True,
        check=False,
    )
    if ended.returncode:  # other graphics are missing too
        assert (ended.returncode, ended.stderr.count("\n")) == (2, 1)
        assert "apt-get install" in ended.stderr
    else:
        assert (tmp_path / "x.png").exists()


def test_a_users_process_has_the_chosen_graphics(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.setenv("GIGABRAIN_MUJOCO_GL", "")  # restored after the test
    this_process.open_no_window()
    assert supervised_environment()["MUJOCO_GL"] == "osmesa"


@pytest.mark.parametrize("chosen", ["egl", "glfw"])
@pytest.mark.parametrize("found", [True, False])
def test_the_choice_of_installed_graphics_is_kept(
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


async def test_a_failing_program_reports_its_error(tmp_path: Path) -> None:
    run = Scripts(program(tmp_path, "echo no sound >&2; exit 3")).start(Script(run="beep"))
    assert await ended(run) == (False, "ended with exit code 3: no sound")


def test_a_program_can_be_ended_on_uvloop_too(tmp_path: Path) -> None:
    uvloop = pytest.importorskip("uvloop")
    scripts = Scripts(program(tmp_path, "echo no sound; exit 3"))

    async def run() -> tuple[bool, str]:
        return await ended(scripts.start(Script(run="beep")))

    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        assert runner.run(run()) == (False, "ended with exit code 3: no sound")


async def test_a_program_that_takes_too_long_is_ended_with_its_children(
    tmp_path: Path,
) -> None:
    text = f"sleep 600 & echo $! > {tmp_path}/child; wait"
    scripts = Scripts(program(tmp_path, text))
    run = scripts.start(Script(run="beep", seconds=0.5))
    assert await ended(run) == (False, "did not end within 0.5 s; killed")
    child = int((tmp_path / "child").read_text())
    await until(lambda: _gone(child))


async def test_children_of_a_program_end_with_it(tmp_path: Path) -> None:
    run = Scripts(program(tmp_path, "sleep 600 & echo $!")).start(Script(run="beep"))
    ok, output = await ended(run)
    assert ok
    await until(lambda: _gone(int(output.rpartition(" ")[2])))


async def test_a_child_in_another_group_does_not_delay_the_result(tmp_path: Path) -> None:
    text = "import os, signal; os.setsid(); print(os.getpid()); signal.pause()"
    wait = "while [ ! -s left ]; do sleep 0.01; done; cat left"
    lines = f'{sys.executable} -uc "{text}" 2>&1 >left & {wait}'
    run = Scripts(program(tmp_path, lines)).start(Script(run="beep"))
    ok, output = await ended(run)
    os.kill(int(output.rpartition(" ")[2]), signal.SIGKILL)
    assert ok


async def test_a_paused_program_resumes_with_its_remaining_time(
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


async def test_a_program_paused_during_its_start_does_not_begin(tmp_path: Path) -> None:
    run = Scripts(program(tmp_path, f"touch {tmp_path}/begun")).start(Script(run="beep"))
    run.pause()
    await until(lambda: run._program)
    assert not (tmp_path / "begun").exists()
    run.resume()
    assert await ended(run) == (True, "ended well")


async def test_a_paused_program_can_be_ended(tmp_path: Path) -> None:
    text = f"echo $$ > {tmp_path}/pid; exec sleep 600"
    run = Scripts(program(tmp_path, text)).start(Script(run="beep"))
    pid = int(await written(tmp_path / "pid"))
    run.pause()
    await until(lambda: _state(pid) == "T")
    run.stop()
    await until(run._task.done)
    assert _gone(pid)


async def test_a_program_that_may_not_be_paused_goes_on(
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


def test_a_program_does_not_start_if_decision_died_before() -> None:
    command = ("/bin/sh", "-c", LEASHED, "sh", "echo", "begun")
    ran = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=False)
    assert (ran.returncode, ran.stdout) == (1, b"")


@pytest.mark.parametrize("paused", [False, True])
async def test_a_program_ends_with_a_killed_decision(tmp_path: Path, paused: bool) -> None:
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
    """Wait until a file has content, and return it."""

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
def test_programs_outside_the_folder_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(ConfigError, match="no script"):
        Scripts(program(tmp_path, "exit 0")).path(name)


def test_a_program_without_execute_permission_is_refused(tmp_path: Path) -> None:
    folder = program(tmp_path, "exit 0")
    (tmp_path / "beep").chmod(0o644)
    with pytest.raises(Refused, match="script 'beep' is not executable; chmod \\+x "):
        Scripts(folder).path("beep")
