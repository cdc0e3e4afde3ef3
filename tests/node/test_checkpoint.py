"""A simulation continues from its checkpoint when its driver dies, within the same run."""

import logging
import math
import threading
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from gigabrain_drivers.driver import catalog
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.sim.body import MujocoOptions, sim_body
from gigabrain_drivers.sim.checkpoint import Checkpoint, CheckpointFiles
from gigabrain_drivers.sim.driver import MujocoDriver
from gigabrain_drivers.sim.physics import Simulation
from gigabrain_drivers.sim.worlds import load_world
from gigabrain_schemas.sim import Thing
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.settings import LinkName
from gigabrain_zenoh.errors import BodyLost, ConfigError
from gigabrain_zenoh.launch.deployment import Deployment
from gigabrain_zenoh.launch.specs import process_specs

WAFFLE = "turtlebot3_waffle"
BOX_IN_ROOM = """
<mujoco><worldbody>
  <geom name="ground" type="plane" size="0 0 0.1"/>
  <body name="crate" pos="0.7 0 0.1"><freejoint/>
    <geom type="box" size="0.1 0.1 0.1" mass="0.2"/></body>
</worldbody></mujoco>
"""


def simulation(
    body: str = WAFFLE, world: str = "arena", checkpoint: Checkpoint | None = None
) -> Simulation:
    robot, _, options, folder = catalog.load_link(body, Run(folder=Path()))
    assert isinstance(options, MujocoOptions)
    model = sim_body(robot, options, Run(folder=folder))
    return Simulation(model, load_world(world, 0), 0, checkpoint)


def run(one: Simulation, seconds: float) -> None:
    for _ in range(round(seconds * 100)):
        one.advance()


def resumed(one: Simulation, body: str = WAFFLE, world: str = "arena") -> Simulation:
    """Return a simulation that continues from the checkpoint of `one`, as a new process does."""
    text = msgspec.msgpack.encode(one.checkpoint())
    return simulation(body, world, msgspec.msgpack.decode(text, type=Checkpoint))


def true_pose(one: Simulation) -> tuple[float, float, float]:
    pose = one.truth.pose()
    return pose.x, pose.y, pose.yaw


@pytest.mark.parametrize("body", [WAFFLE, "lekiwi", "ackermann_car"])
def test_a_resumed_body_keeps_its_pose_and_its_odometry_starts_at_zero(body: str) -> None:
    before = simulation(body)
    before.drive(0.15, 0.0, 0.4)
    run(before, 2)
    after = resumed(before, body)
    assert true_pose(after) == pytest.approx(true_pose(before))
    assert after.time_ns == 2_000_000_000
    assert after.battery().percentage == before.battery().percentage
    assert after.truth.distance_m == before.truth.distance_m > 0.1
    run(after, 1)
    assert true_pose(after) == pytest.approx(true_pose(before), abs=0.005)
    assert after.odometry() == pytest.approx((0, 0, 0, 0, 0), abs=0.01)
    _, _, z, w = after.imu().orientation
    assert 2 * math.atan(z / w) == pytest.approx(0, abs=0.02)


def test_a_resumed_arm_keeps_its_targets_and_a_limp_one_stays_limp() -> None:
    before = simulation("so101", "table")
    assert before.arm
    name = before.arm.names[0]
    before.arm.aim({name: 0.5})
    run(before, 2)
    after = resumed(before, "so101", "table")
    assert after.arm
    assert after.arm.targets == before.arm.targets
    run(after, 1)
    assert after.arm.truth()[0] == pytest.approx(before.arm.truth()[0], abs=0.01)
    after.arm.let_go()
    run(after, 0.1)
    last = resumed(after, "so101", "table")
    assert last.arm
    assert last.arm.limp
    last.advance()
    assert last.model.actuator_gainprm[:, 0].max() == 0.0


def test_a_quadruped_resumed_in_mid_trot_does_not_fall() -> None:
    for steps in (5, 23, 41):
        before = simulation("alpha")
        before.drive(0.2, 0.0, 0.0)
        run(before, 1.0 + steps / 100)
        after = resumed(before, "alpha")
        run(after, 2)
        assert not after.fallen
        assert math.dist(true_pose(after)[:2], true_pose(before)[:2]) < 0.1


def test_added_things_people_and_counted_contacts_are_resumed() -> None:
    before = simulation(world="playroom")
    x, y, yaw = true_pose(before)
    ahead = x + 0.4 * math.cos(yaw), y + 0.4 * math.sin(yaw)
    before.things.add(Thing(name="crate", x=ahead[0], y=ahead[1], size=(0.2, 0.2, 0.3)))
    walk = Thing(kind="person", x=x, y=y + 2, path=((x + 1, y + 2),))
    before.things.add(walk)
    before.command(0.2, 0.0)
    run(before, 4)  # until it hits the box
    assert before.truth.contacts == 1
    after = resumed(before, world="playroom")
    assert after.things.all() == before.things.all()
    assert [one.pose for one in after.people()] == [one.pose for one in before.people()]
    assert after.truth.contacts == 1
    assert after.truth.min_clearance_m == 0.0
    run(after, 0.2)
    assert after.truth.contacts == 1  # it still touches the box
    same = np.isclose(after.scan(), before.scan(), atol=0.1)
    assert same.mean() > 0.9  # except at people and edges


def test_a_pushed_crate_stays_at_its_new_place(tmp_path: Path) -> None:
    path = tmp_path / "room.xml"
    path.write_text(BOX_IN_ROOM)
    before = simulation(world=str(path))
    crate = before.model.body("world/crate").id
    began = before.data.xpos[crate].copy()
    before.data.qpos[0:2] += (0.3, 0.2)
    run(before, 0.5)
    after = resumed(before, world=str(path))
    assert np.hypot(*(after.data.xpos[crate] - began)[:2]) > 0.3


def test_a_checkpoint_of_another_world_or_body_is_refused() -> None:
    with pytest.raises(ConfigError, match="another body or world"):
        resumed(simulation(), world="house")
    with pytest.raises(ConfigError, match="another body or world"):
        resumed(simulation(), "turtlebot3_burger")


def test_the_newest_intact_checkpoint_is_read(tmp_path: Path) -> None:
    path, one = tmp_path / "checkpoint", simulation()
    files = CheckpointFiles(path)
    assert files.read() is None
    for _ in range(3):
        one.advance()
        files.write(one.checkpoint())
    assert CheckpointFiles(path).read() == one.checkpoint()
    newest = Path(f"{path}.0")
    newest.write_bytes(newest.read_bytes()[:100])  # as if the process was killed while it wrote
    older = CheckpointFiles(path).read()
    assert older
    assert older.steps == 2
    Path(f"{path}.1").write_bytes(b"x" * 400)
    with pytest.raises(ConfigError, match="damaged"):
        CheckpointFiles(path).read()
    files.clear()
    assert CheckpointFiles(path).read() is None


def driver(
    checkpoint: Path, world: str = "arena", seconds: float | None = None, speed: float = 100.0
) -> MujocoDriver:
    where = Run(
        folder=Path(), world=world, speed=speed, seconds=seconds, checkpoint=str(checkpoint)
    )
    _, made = catalog.make_driver(WAFFLE, where)
    assert isinstance(made, MujocoDriver)
    return made


async def drive(one: MujocoDriver, ticks: int) -> dict[str, Any]:
    """Drive for some ticks; return the report. Files stay as after a kill of the process."""
    async with one:
        times = one.ticks(Clock())
        for _ in range(ticks):
            await anext(times)
            await one.set_base_velocity(0.2, 0.0, 0.0)
        await times.aclose()  # type: ignore[attr-defined]
    return dict(one.report())


async def test_the_next_driver_of_a_run_continues_where_the_last_one_died(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint"
    first = await drive(driver(path, seconds=4.0), 100)
    second = driver(path, seconds=4.0)
    assert second.report()["true_x"] == pytest.approx(first["true_x"], abs=0.03)
    assert second.report()["sim_seconds"] == pytest.approx(2.0, abs=0.1)
    async with second:
        assert (await second.read_state()).pose.x == 0.0
    left = [tick async for tick in driver(path, seconds=2.2).ticks(Clock())]  # continues counting
    assert 10 <= len(left) <= 20  # the checkpoint may be 10 ticks old
    third = driver(path, seconds=1.0)
    assert len([tick async for tick in third.ticks(Clock())]) == 5
    assert third.finished
    other = await drive(driver(tmp_path / "another run"), 1)
    assert other["sim_seconds"] == 0.02


def overwrite(checkpoint: Path, content: bytes) -> None:
    for number in range(2):
        Path(f"{checkpoint}.{number}").write_bytes(content)


@pytest.mark.parametrize(
    ("world", "content", "why"),
    [("house", None, "of another body or world"), ("arena", b"?" * 99, "damaged")],
)
async def test_a_driver_without_a_usable_checkpoint_starts_over_with_a_warning(
    tmp_path: Path, world: str, content: bytes | None, why: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "checkpoint"
    await drive(driver(path), 20)
    if content:
        overwrite(path, content)
    with caplog.at_level(logging.WARNING):
        again = await drive(driver(path, world), 10)
    assert again["sim_seconds"] == 0.2
    assert why in caplog.text
    third = driver(path, world)  # resumes from the checkpoint of the second one
    assert third.report()["sim_seconds"] == 0.2
    await third.close()


async def test_a_fallen_body_starts_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "checkpoint"
    await drive(driver(path), 10)
    monkeypatch.setattr(Simulation, "fallen", True)
    with pytest.raises(BodyLost, match="fell over"):
        await drive(driver(path), 1)
    assert CheckpointFiles(path).read() is None


async def test_a_full_disk_delays_no_tick_and_leaves_no_old_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "checkpoint"
    await drive(driver(path), 10)

    def full(files: CheckpointFiles, checkpoint: Checkpoint) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(CheckpointFiles, "write", full)
    report = await drive(driver(path), 20)
    assert report["sim_seconds"] == pytest.approx(0.6)
    assert caplog.text.count("No space left") == 1
    assert CheckpointFiles(path).read() is None


@pytest.mark.parametrize(("link", "kept"), [("sim", True), ("emulated", False), ("real", False)])
def test_each_simulated_run_has_its_own_checkpoint(
    link: LinkName, kept: bool, tmp_path: Path
) -> None:
    for run_dir in (tmp_path / "one", tmp_path / "two"):
        specs = process_specs(Deployment(link=link), "robot", run_dir, tmp_path / "state")
        (spec,) = (one for one in specs if one.name == "driver")
        settings = msgspec.json.decode(spec.config)["settings"]
        assert settings["checkpoint"] == (str(run_dir / "checkpoint") if kept else "")


async def test_a_hanging_disk_delays_no_tick(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, hangs = tmp_path / "checkpoint", threading.Event()
    monkeypatch.setattr(CheckpointFiles, "write", lambda *_: hangs.wait(60.0))
    one = driver(path, speed=1.0)
    try:
        report = await drive(one, 20)
    finally:
        hangs.set()
    assert report["sim_seconds"] >= 0.38
