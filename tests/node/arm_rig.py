"""An arm in MuJoCo with a task queue, stepped in memory, for tests of missions."""

from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec

from gigabrain_drivers.driver.catalog import load_link, robot_path
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.sim.body import MujocoOptions, sim_body
from gigabrain_schemas.base import TICK_S
from gigabrain_schemas.body import ArmModel
from gigabrain_schemas.brain import ArmPlan, Intent
from gigabrain_schemas.objects import SeenSolid
from gigabrain_schemas.tasks import Task
from gigabrain_zenoh.decision.behaviours import ArmCommand, StepOutcome
from gigabrain_zenoh.decision.manipulator import Manipulator
from gigabrain_zenoh.decision.tasks.mission_files import loads
from gigabrain_zenoh.decision.tasks.task_queue import Saved, TaskQueue
from gigabrain_zenoh.manipulation.arm_planner import ArmPlanner
from gigabrain_zenoh.qa.bench.hands import ArmInMemory
from gigabrain_zenoh.testing.waiting import PATIENCE_S

CUBE_WORLD = """<mujoco><worldbody>
  <geom name="floor" type="plane" size="2 2 .1"/>
  <body name="thing" pos="{x} {y} 0.015"><freejoint/>
    <geom type="box" size=".015 .015 .015" mass=".05" condim="6" friction="1 .02 .0005"/>
  </body></worldbody></mujoco>"""
CUBE_PLACE, NEW_PLACE = (0.2388, 0.0), (0.1388, 0.15)
THINGS = "things: {cube: {box: [0.03, 0.03, 0.03], at: [0.2388, 0.0, 0.015]}}\n"
IDLE = Intent(behaviour="test", reason="still")
MAX_TICKS = 4000


def wait_for_job(job: Future[Any], _patience_s: float) -> bool:
    job.exception(PATIENCE_S)
    return True


class Rig:
    """An arm with a task queue."""

    def __init__(
        self,
        folder: Path,
        cube: tuple[float, float] = CUBE_PLACE,
        mjcf: str | None = None,
        body: str = "so101",
        world: Path | None = None,
    ) -> None:
        (folder / "thing.xml").write_text(CUBE_WORLD.format(x=cube[0], y=cube[1]))
        (folder / "world.yaml").write_text("model: thing.xml\nstart: [0.0, 0.0, 0.0]\n")
        robot, _, options, model_folder = load_link(body, Run(folder=Path()))
        assert isinstance(options, MujocoOptions)
        self.arm = ArmInMemory(robot, sim_body(robot, options, Run(folder=model_folder)),
                               world or folder / "world.yaml")  # fmt: skip
        text = mjcf or robot_path(body).with_name("model.xml").read_text()
        self._bus: Any = SimpleNamespace(
            input_log=SimpleNamespace(in_time=wait_for_job),
            latest=lambda _topic: SimpleNamespace(current=ArmModel(mjcf=text)),
            transport=SimpleNamespace(watch_readers=self._watch),
            publish=lambda _topic, message: self.plans.append(message),
        )
        self.start(Saved())
        self.held = ""
        self.seen: tuple[SeenSolid, ...] = ()
        self.phases: list[str] = []  # in the order of their starts
        self.plans: list[ArmPlan] = []  # those published

    def start(self, saved: Saved) -> None:
        """Start decision with the tasks in `saved`."""
        self.manipulator = Manipulator(self._bus, "navigate", saved.held)
        self.queue = TaskQueue(lambda _topic: None, lambda _script: None, saved)  # type: ignore[arg-type, return-value]
        self.outcome: StepOutcome | None = None

    def _watch(self, _key: str, on_readers: Callable[[bool], None]) -> Callable[[], None]:
        self.watch_plans = on_readers
        return lambda: None

    def restart(self) -> None:
        """Stop decision, and start it again from its saved tasks."""
        self.manipulator.close()
        saved = msgspec.json.decode(msgspec.json.encode(self.queue.saved), type=Saved)
        for _ in range(20):
            self.arm.step(IDLE)
        self.start(saved)

    @property
    def planner(self) -> ArmPlanner:
        assert self.manipulator._planner
        return self.manipulator._planner

    def add_mission(self, text: str) -> None:
        self.queue.add_mission(loads(text, "mission"), "mission", "replace", "test")

    def tick(self) -> None:
        command, idle = self.queue.step(TICK_S, self.outcome)
        assert command is None or isinstance(command, ArmCommand)
        intent, outcome = self.manipulator.step(
            self.arm.state(), self.arm.description, command, idle, self.held, self.seen
        )
        self.outcome = outcome if command else None
        if not self.phases or self.phases[-1] != outcome.reason:
            self.phases.append(outcome.reason)
        self.arm.step(intent)

    def move_cube(self, to: tuple[float, float] = (0.5, 0.5)) -> None:
        """Move the cube to another place on the floor."""
        simulation = self.arm.simulation
        joint = simulation.model.body("world/thing").jntadr[0]
        at = simulation.model.jnt_qposadr[joint]
        simulation.data.qpos[at : at + 7] = *to, 0.015, 1.0, 0.0, 0.0, 0.0

    def run_mission(self, text: str) -> Task:
        """Run a mission, and return its final state and reason."""
        self.add_mission(text)
        return self.run_until_done()

    def run_until_done(self) -> Task:
        """Wait for the end of the current task, and return its final state and reason."""
        for _ in range(MAX_TICKS):
            self.tick()
            if not self.queue.status.current:
                return self.queue.status.done[0]
        raise AssertionError(f"not done: {self.queue.status.current}")
