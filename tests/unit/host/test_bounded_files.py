"""Files that have no end, no size or no sense are refused in one line, and take no memory."""

import io
import os
import struct
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.records import Message

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_drivers.driver.gatekeeper import UNREADABLE, LatchFile
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.links.link import LinkProblem
from gigabrain_drivers.links.tcp_link import read_address
from gigabrain_drivers.sim.body import MujocoOptions, sim_body
from gigabrain_zenoh.config import loading as config
from gigabrain_zenoh.config.loading import located
from gigabrain_zenoh.decision.tasks import mission_files
from gigabrain_zenoh.decision.tasks.task_queue import Saved, TaskFile
from gigabrain_zenoh.diagnostics import log_reader
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.launch.deployment import Deployment, load_deployment
from gigabrain_zenoh.mapping import map_file
from gigabrain_zenoh.qa.bench import slam_logs
from gigabrain_zenoh.qa.faults.rig import Options
from gigabrain_zenoh.qa.faults.suite import RunsFile
from gigabrain_zenoh.recording.bag_reader import MAGIC, Bag, BagDamage, read_records
from gigabrain_zenoh.runtime import audit
from gigabrain_zenoh.security import authority, identity_files
from gigabrain_zenoh.security.identity_files import LIST, generations_in

YAML = "image: x\nresolution: 0.05\norigin: [0, 0, 0]\n"


def read_deployment(path: Path) -> object:
    return load_deployment(path)


def read_mission(path: Path) -> object:
    return mission_files.load(path)


def read_name(path: Path) -> object:
    raise located(path, ConfigError("no robot 'x'; known: y", value="x"))


def read_map(path: Path) -> object:
    return map_file.load(path)


def read_image(path: Path) -> object:
    about = path.with_name("map.yaml")
    about.write_text(YAML.replace("image: x", f"image: {path}"))
    return map_file.load(about)


def read_graph(path: Path) -> object:
    path.rename(path.with_name("map.graph.npz"))
    return map_file.load_graph(path.with_name("map.yaml"))


def read_list(path: Path) -> object:
    path.rename(path.with_name(LIST))
    return generations_in(path.parent)


def read_key(path: Path) -> object:
    return authority.read_certificate(path)


def read_model(path: Path) -> object:
    options = MujocoOptions(driver="mujoco", model=path.name)
    return sim_body(load_robot("turtlebot3_waffle"), options, Run(folder=path.parent))


def read_bag(path: Path) -> object:
    return list(Bag(path))


def read_laser_log(path: Path) -> object:
    return slam_logs.load(path)


def read_run(path: Path) -> object:
    path.rename(path.with_name("driver.jsonl"))
    return log_reader.read(path.parent, log_reader.LogFilter(), 10)


def read_audit(path: Path) -> object:
    (path.parent / "audit").mkdir()
    path.rename(path.parent / "audit" / "gate-000001.jsonl")
    return audit.read_audit(path.parent, 10)


def read_tries(path: Path) -> object:
    return RunsFile(path, Options()).read()


def read_secret(path: Path) -> object:
    return identity_files.made_once(path, b"secret")


READERS: tuple[Callable[[Path], object], ...] = (
    read_deployment, read_mission, read_name, read_map, read_image, read_graph, read_list,
    read_key, read_model, read_bag, read_secret, read_laser_log, read_run, read_audit, read_tries,
)  # fmt: skip


def device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def fifo(path: Path) -> None:
    os.mkfifo(path)


def folder(path: Path) -> None:
    path.mkdir()


def socket(path: Path) -> None:
    os.mknod(path, 0o140644)


def endless(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(1 << 40)  # a hole: no disk holds it


@pytest.mark.parametrize("read", READERS)
@pytest.mark.parametrize("make", [device, fifo, folder, socket, endless])
def test_what_is_no_plain_file_of_sense_is_refused_in_one_line_without_being_read(
    make: Callable[[Path], None], read: Callable[[Path], object], tmp_path: Path
) -> None:
    path = tmp_path / "file.yaml"
    make(path)
    tracemalloc.start()
    try:
        with pytest.raises(ConfigError) as error:
            read(path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert "\n" not in str(error.value)
    assert str(tmp_path) in str(error.value)
    assert peak < 10e6


def test_yaml_of_60_mb_is_not_parsed(tmp_path: Path) -> None:
    path = tmp_path / "file.yaml"
    path.write_bytes(b"# nothing\n" * 6_000_000)
    with pytest.raises(ConfigError, match=r"file\.yaml: 60\.0 MB; expected at most 0\.26"):
        load_deployment(path)


def test_thousands_of_hosts_are_refused_by_their_number(tmp_path: Path) -> None:
    path = tmp_path / "file.yaml"
    path.write_text("hosts:\n" + "".join(f"  h{n}: []\n" for n in range(1000)))
    with pytest.raises(ConfigError, match="1: hosts: 1000 of them; expected at most 64"):
        load_deployment(path)
    assert config.loads("hosts: {a: [router], b: [driver]}", Deployment, "f").hosts


def npz(folder: Path, **members: bytes) -> Path:
    """A map's YAML file, beside a graph of these members as they are."""
    path = folder / "map.yaml"
    with zipfile.ZipFile(folder / "map.graph.npz", "w", zipfile.ZIP_DEFLATED) as file:
        for name, data in members.items():
            file.writestr(f"{name}.npy", data)
    return path


def array(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> bytes:
    content = io.BytesIO()
    np.save(content, values)
    return content.getvalue()


def header(text: bytes) -> bytes:
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


@pytest.mark.parametrize(
    "member",
    [
        header(b"((((\n"),
        header(b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }\n"),
        header(b"{'descr': '<f8', 'fortran_order': False, 'shape': (-8,), }\n"),
        header(b"{'descr': '|O', 'fortran_order': False, 'shape': (1,), }\n") + b"12345678",
        header(b"(" * 9000 + b")" * 9000),
        header(b"'" * 70 + b"\n"),
        b"\x93NUMPY\x09\x00",
        b"",
        array(np.array([np.nan])),
        array(np.array([1e300])),
    ],
    ids=str,
)
def test_arrays_that_are_none_are_refused_in_one_line(member: bytes, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cut or damaged: ") as error:
        map_file.load_graph(npz(tmp_path, poses=member))
    assert "\n" not in str(error.value)


@pytest.mark.long
def test_a_zip_of_3_mb_that_holds_3_gb_is_not_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "map.graph.npz"
    piece = bytes(1_000_000)
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file,
        file.open("poses.npy", "w", force_zip64=True) as member,
    ):
        for _ in range(300):
            member.write(piece)
    assert path.stat().st_size < 3_000_000
    tracemalloc.start()
    try:
        with pytest.raises(ConfigError, match=r"1 arrays of 300 MB; expected at most 64 of 80 MB"):
            map_file.load_graph(tmp_path / "map.yaml")
        assert tracemalloc.get_traced_memory()[1] < 10e6
    finally:
        tracemalloc.stop()


@pytest.mark.long
@pytest.mark.parametrize("count", [30_000, 70_000])  # the plain end record counts to 65535
def test_the_directory_of_a_zip_is_not_read_where_it_is_large(tmp_path: Path, count: int) -> None:
    with zipfile.ZipFile(tmp_path / "map.graph.npz", "w") as file:
        for n in range(count):
            file.writestr(f"{n}.npy", b"")
    tracemalloc.start()
    try:
        with pytest.raises(ConfigError, match=r"at most 64 arrays|large format"):
            map_file.load_graph(tmp_path / "map.yaml")
        assert tracemalloc.get_traced_memory()[1] < 2e6
    finally:
        tracemalloc.stop()


def test_a_map_too_large_to_be_read_again_is_not_written() -> None:
    with pytest.raises(ValueError, match="it holds 88 MB; at most 80 MB can be read"):
        map_file.write_arrays(io.BytesIO(), {"hits": np.zeros(11_000_000)}, compress=False)


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def message(data: bytes) -> bytes:
    return record(5, struct.pack("<HIQQ", 1, 1, 7, 7) + data)


def test_a_chunk_that_grows_without_end_is_damaged_and_what_follows_is_read(
    tmp_path: Path,
) -> None:
    bomb = zstandard.ZstdCompressor().compress(bytes(400_000_000))
    chunk = struct.pack("<QQQII4sQ", 0, 0, 400_000_000, 0, 4, b"zstd", len(bomb))
    path = tmp_path / "bomb.mcap"
    path.write_bytes(MAGIC + record(6, chunk + bomb) + message(b"after"))
    tracemalloc.start()
    try:
        found = list(read_records(path))
        assert tracemalloc.get_traced_memory()[1] < 150e6
    finally:
        tracemalloc.stop()
    assert isinstance(found[0], BagDamage)
    assert [one.data for one in found if isinstance(one, Message)] == [b"after"]


def test_a_record_of_a_gigabyte_is_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "long.mcap"
    with path.open("wb") as file:
        file.write(MAGIC + struct.pack("<BQ", 5, 1 << 30))
        file.seek(1 << 30, os.SEEK_CUR)
        file.write(message(b"after"))
    tracemalloc.start()
    try:
        found = list(read_records(path))
        assert tracemalloc.get_traced_memory()[1] < 10e6
    finally:
        tracemalloc.stop()
    assert found[0] == BagDamage(8, "a record of 1074 MB is skipped")
    assert [one.data for one in found if isinstance(one, Message)] == [b"after"]


@pytest.mark.parametrize("make", [device, fifo, endless])
def test_a_latch_that_is_no_plain_file_counts_as_latched(
    make: Callable[[Path], None], tmp_path: Path
) -> None:
    make(tmp_path / "latch.json")
    assert LatchFile(tmp_path).read().causes == (UNREADABLE,)
    assert (tmp_path / "latch.json").stat().st_size < 1000


@pytest.mark.parametrize("make", [device, fifo, endless])
def test_tasks_that_are_no_plain_file_are_set_aside(
    make: Callable[[Path], None], tmp_path: Path
) -> None:
    make(tmp_path / "tasks.json")
    saved, problem = TaskFile(str(tmp_path)).read()
    assert saved == Saved()
    assert "no tasks restored" in problem


@pytest.mark.parametrize("make", [device, fifo, endless])
def test_an_address_in_no_plain_file_is_a_problem_of_the_link(
    make: Callable[[Path], None], tmp_path: Path
) -> None:
    make(tmp_path / "port")
    with pytest.raises(LinkProblem, match="does not hold HOST:PORT"):
        read_address(tmp_path / "port")


def test_a_folder_without_logs_is_said_to_hold_none(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="expected files such as decision"):
        log_reader.run_folder(str(tmp_path))
