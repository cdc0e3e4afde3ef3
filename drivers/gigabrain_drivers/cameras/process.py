"""The camera process: publishes the pictures of all cameras of a robot."""

import asyncio
import contextlib
import functools
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING

from msgspec.structs import replace

from gigabrain_drivers.cameras.base import (
    CameraLost,
    CameraSite,
    CameraSource,
    Frame,
    source_class,
)
from gigabrain_drivers.cameras.catalog import RENDERED, LinkedCamera, cameras_of
from gigabrain_drivers.cameras.faults import FAULTS, FaultyCamera
from gigabrain_drivers.cameras.output import CHECK_PERIOD_NS, CameraOutput
from gigabrain_drivers.sim import exposes
from gigabrain_schemas.base import TICK_S
from gigabrain_schemas.body import Camera
from gigabrain_schemas.sim import SimPoses, SimScene
from gigabrain_schemas.topics import SIM_POSES, SIM_SCENE, STATE
from gigabrain_zenoh.bus.bridge import Bridge
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.settings import CameraConfig
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.runtime.heartbeat import Progress

if TYPE_CHECKING:
    from gigabrain_drivers.cameras.rendered import Renderer

REOPEN_PAUSE_S = 0.5  # before a lost source is opened again
MIN_PERIOD_SHARE = 0.75  # without ticks, a camera is due after this share of its period
THREAD_END_TIMEOUT_S = 0.5  # a thread that hangs in a device is left running


class CameraProcess:
    """All cameras of one robot. Its threads run inside its `async with` block."""

    def __init__(self, config: CameraConfig, bus: Bus) -> None:
        """Read the robot's file. Raises ConfigError."""
        self._config, self._bus = config, bus
        self._cameras = cameras_of(config.body, config.link, config.robot)
        self._halt = threading.Event()
        self._threads: list[threading.Thread] = []
        self.failed: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._faults = {one.camera.name: FaultyCamera() for one in self._cameras}
        self.outputs = {one.camera.name: self._output(one) for one in self._cameras}
        self._rendered: RenderThread | None = None
        if config.link != "real":
            self._serve_faults()

    async def __aenter__(self) -> "CameraProcess":
        self._bridge = Bridge()
        bus, drawn = self._bus, []
        bus.latest(STATE)  # advances this process's clock, which detects silent cameras
        for one in self._cameras:
            if one.options.source == RENDERED:
                drawn.append(one)
            else:
                self._start(functools.partial(self._read, one))
        if drawn:
            self._rendered = RenderThread(self._config, drawn, self)
            self._start(self._rendered.run)
            bus.latest(SIM_SCENE, self._rendered.show)
            bus.latest(SIM_POSES, self._rendered.expose)
            bus.progress = Progress(self._rendered.came, self._rendered.done)
            bus.report = self._rendered.report
        return self

    async def __aexit__(self, *_: object) -> None:
        self._halt.set()
        if self._rendered:
            self._rendered.wake()
        for thread in self._threads:
            await asyncio.to_thread(thread.join, THREAD_END_TIMEOUT_S)
        self._bridge.close()

    async def watch(self) -> None:
        """Check the cameras' health until cancelled. Raises the error that ended a thread."""
        async for _ in self._bus.clock.every(CHECK_PERIOD_NS):
            if self.failed.done():
                await self.failed
            for output in self.outputs.values():
                output.look()
            causes = [output.cause for output in self.outputs.values()]
            self._bus.problems = tuple(cause for cause in causes if cause)

    def put(self, name: str, frame: Frame) -> None:
        """Pack an exposure and hand it to the loop. May be called in any thread."""
        spoilt = self._faults[name].spoil(frame)
        if spoilt:
            self._bridge.post(self.outputs[name].put, self.outputs[name].pack(spoilt))

    def lose(self, names: Iterable[str], problem: str) -> None:
        """Note why some cameras give no pictures. May be called in any thread."""
        for name in names:
            self._bridge.post(self.outputs[name].lose, problem)

    @property
    def halted(self) -> bool:
        """Return whether the threads should end."""
        return self._halt.is_set()

    def now_ns(self) -> int:
        """Return this process's time [ns]."""
        return self._bus.clock.now_ns()

    @property
    def tick(self) -> int:
        """Return the robot's newest tick."""
        return self._bus.time.tick

    def count(self, name: str) -> None:
        """Increment a counter of the process's health. May be called in any thread."""
        self._bridge.post(lambda _: self._bus.counters.update((name,)), None)

    def restart(self) -> None:
        """Restart all health checks, because the robot's time starts again."""
        for output in self.outputs.values():
            output.restart()

    def _output(self, one: LinkedCamera) -> CameraOutput:
        """Return the output of a camera; rendered ones use the robot's time."""
        bus, drawn = self._bus, one.options.source == RENDERED
        repeats = one.options.repeats or one.options.repeat

        def now_s() -> float:
            return bus.time.tick * TICK_S if drawn else bus.clock.now_ns() / 1e9

        return CameraOutput(one.camera, one.options, bus, now_s, repeats=repeats)

    def _serve_faults(self) -> None:
        for name, faulty in self._faults.items():
            expected = f"one of: {', '.join(FAULTS)}"
            self._bus.params.add(
                f"{name}_fault", expected, functools.partial(getattr, faulty, "fault"), faulty.put
            )

    def _start(self, work: Callable[[], None]) -> None:
        def run() -> None:
            try:
                work()
            except Exception as error:  # noqa: BLE001 - handed on whole, to end this process
                self._bridge.post(self._fail, error)

        thread = threading.Thread(target=run, name="camera", daemon=True)
        self._threads.append(thread)
        thread.start()

    def _fail(self, error: Exception) -> None:
        if not self.failed.done():
            self.failed.set_exception(error)

    def _read(self, one: LinkedCamera) -> None:
        """Read a camera until halted; open it again after each loss."""
        name = one.camera.name
        site = CameraSite(str(one.folder), self._config.seed)
        source = source_class(one.options.source)(one.options, one.camera, site)
        while not self.halted:
            try:
                self._take_all(name, source)
            except CameraLost as error:
                self.lose((name,), f"no picture: {error}")
            finally:
                source.close()
            self._halt.wait(REOPEN_PAUSE_S)

    def _take_all(self, name: str, source: CameraSource) -> None:
        source.open()
        while not self.halted:
            self.put(name, source.read())


class RenderThread:
    """Draws the cameras of a simulated robot, always at the newest poses.

    The loop's thread calls `show` and `expose`; `run` is the thread's own function.
    """

    def __init__(
        self, config: CameraConfig, cameras: list[LinkedCamera], process: CameraProcess
    ) -> None:
        self._config, self._process = config, process
        self._cameras = {one.camera.name: one.camera for one in cameras}
        self._changed = threading.Condition()
        self._scene: SimScene | None = None
        self._due: dict[str, SimPoses] = {}  # by camera name
        self._drawn: dict[str, int] = {}  # tick of each camera's newest picture in this boot
        self._taken_ns: dict[str, int] = {}  # when each was last due, in this process's time
        self._boot, self._count, self._rounds = -1, 0, 0
        self._cpu_s = 0.0  # CPU time of drawing

    def show(self, scene: SimScene) -> None:
        """Set the scene to draw."""
        with self._changed:
            self._scene = scene
            self._changed.notify()

    def expose(self, poses: SimPoses) -> None:
        """Request pictures from the cameras that are due in this tick."""
        if poses.boot != self._boot:
            self._boot = poses.boot
            self._drawn.clear()
            self._process.restart()
        has_tick = poses.tick > 0
        with self._changed:
            if not has_tick:  # an emulated world has no ticks: use the newest tick of the robot
                poses = replace(poses, tick=self._process.tick)
            for name, camera in self._cameras.items():
                if name in self._drawn and not self._is_due(camera, poses.tick if has_tick else 0):
                    continue
                self._taken_ns[name] = self._process.now_ns()
                self._count += 1
                if name in self._due:
                    self._process.count("skipped_exposures")
                self._due[name] = poses
            self._changed.notify()

    def _is_due(self, camera: Camera, tick: int) -> bool:
        """Return whether a camera takes a picture now. In an emulated world `tick` is 0."""
        if tick:  # lock-step repeats its first tick until it is answered
            return exposes(camera.rate_hz, tick) and tick != self._drawn.get(camera.name)
        since_ns = self._process.now_ns() - self._taken_ns.get(camera.name, 0)
        return since_ns >= MIN_PERIOD_SHARE * 1e9 / camera.rate_hz

    def wake(self) -> None:
        """Wake the thread, so that it sees `halted`."""
        with self._changed:
            self._changed.notify()

    def came(self) -> tuple[object, ...]:
        """Return a value that changes with each input, for the heartbeat."""
        return (self._count,) if self._drawn else ()

    def done(self) -> int:
        """Return the number of finished rounds, for the heartbeat."""
        return self._rounds

    def report(self) -> dict[str, float | int | str | None]:
        """Return the CPU time of drawing [s], for the process's description."""
        return {"render_cpu_s": round(self._cpu_s, 3)}

    def run(self) -> None:
        """Draw until the process halts. Raises ConfigError where nothing can be drawn."""
        from gigabrain_drivers.cameras.rendered import Renderer, View  # mujoco: 100 MB

        config, shown = self._config, None
        views = {
            name: View(camera, config.seed, errors=config.errors)
            for name, camera in self._cameras.items()
        }
        with contextlib.closing(Renderer(views)) as renderer:
            while not self._process.halted:
                scene, due = self._next()
                if scene is not None and scene is not shown:
                    shown = scene
                    self._show(renderer, scene)
                for poses, names in _group_by_poses(due):
                    began_s = time.thread_time()
                    frames = renderer.expose(poses, names)
                    self._cpu_s += time.thread_time() - began_s
                    self._drawn.update(dict.fromkeys(frames, poses.tick))
                    for name, frame in frames.items():
                        exposed = Frame(frame.picture, frame.depth, poses.tick, poses.stamp_ns)
                        self._process.put(name, exposed)
                self._rounds += 1

    def _show(self, renderer: "Renderer", scene: SimScene) -> None:
        """Set the renderer's scene; a scene that cannot be drawn gives no pictures."""
        try:
            renderer.show(scene)
        except ConfigError as error:
            self._process.lose(self._cameras, f"no picture: {error}")

    def _next(self) -> tuple[SimScene | None, Mapping[str, SimPoses]]:
        """Wait for due cameras; return the scene and their poses."""
        with self._changed:
            while not self._due and not self._process.halted:
                self._changed.wait()
            due, self._due = self._due, {}
            return self._scene, due


def _group_by_poses(due: Mapping[str, SimPoses]) -> list[tuple[SimPoses, list[str]]]:
    """Group cameras with the same poses, so that each pose is set once."""
    groups: dict[int, tuple[SimPoses, list[str]]] = {}
    for name, poses in due.items():
        groups.setdefault(id(poses), (poses, []))[1].append(name)
    return list(groups.values())


async def run(config: CameraConfig, bus: Bus, ready: Callable[[], None]) -> None:
    """Publish the cameras' pictures until the process ends. Raises ConfigError."""
    async with CameraProcess(config, bus) as process:
        ready()
        await process.watch()
