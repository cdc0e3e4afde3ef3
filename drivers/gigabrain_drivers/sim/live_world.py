"""A running simulated world: its messages for viewers, and requests that change it."""

import asyncio
import contextlib
from collections import deque
from collections.abc import Sequence
from typing import Any

from gigabrain_drivers.sim import STEP_NS, exposes
from gigabrain_drivers.sim.physics import Simulation
from gigabrain_drivers.sim.scene_message import SceneWriter
from gigabrain_schemas.base import TICK_NS, Message, Pose
from gigabrain_schemas.body import Camera
from gigabrain_schemas.sim import SimReply, SimRequest
from gigabrain_schemas.topics import SIM_POSES, SIM_SCENE, Topic
from gigabrain_zenoh.errors import Refused

POSES_STEPS = 100_000_000 // STEP_NS
ANSWER_S = 2.0
MAX_REQUESTS = 32  # waiting for a step
News = list[tuple[Topic[Any], Message]]


class LiveWorld:
    """Changes a world between two steps of its physics, and describes it.

    Call `step` in the physics thread and `change` on the loop; `scene` before both start.
    """

    def __init__(self, simulation: Simulation, world: str, cameras: Sequence[Camera] = ()) -> None:
        """Prepare the messages for viewers and for rendered `cameras`."""
        self._simulation, self._cameras = simulation, cameras
        self._writer = SceneWriter(simulation.model, simulation.data, world)
        self._waiting: deque[tuple[SimRequest, asyncio.Future[SimReply]]] = deque()
        self._steps, self._published = 0, -1  # newest version of the scene that was published

    def scene(self) -> News:
        """Return the messages of the whole scene and its poses."""
        things = self._simulation.things
        self._published = things.version
        scene = self._writer.scene(things.version, things.all(), things.bodies())
        return [(SIM_SCENE, scene), (SIM_POSES, self._writer.poses(things.version))]

    def step(self) -> News:
        """Carry out waiting requests; return the messages of this step."""
        while self._waiting:
            request, future = self._waiting.popleft()
            reply = self._carry_out(request)
            future.get_loop().call_soon_threadsafe(_answer, future, reply)
        self._steps += 1
        if self._simulation.things.version != self._published:
            return self.scene()
        if self._steps % POSES_STEPS == 0 or self._exposes():
            return [(SIM_POSES, self._writer.poses(self._published))]
        return []

    def _exposes(self) -> bool:
        """Return whether a camera takes a picture after this step, the last of a tick."""
        tick, rest = divmod(self._steps * STEP_NS, TICK_NS)
        return rest == 0 and any(exposes(camera.rate_hz, tick) for camera in self._cameras)

    async def change(self, request: SimRequest) -> SimReply:
        """Have `step` carry out a request. Raises Refused if time stands still."""
        if len(self._waiting) >= MAX_REQUESTS:
            raise Refused("too many requests to the world are waiting; try again")
        future = asyncio.get_running_loop().create_future()
        self._waiting.append((request, future))
        try:
            return await asyncio.wait_for(future, ANSWER_S)
        except TimeoutError:
            with contextlib.suppress(ValueError):  # `step` is carrying it out
                self._waiting.remove((request, future))
            raise Refused("the simulation stands still, so its world cannot be changed") from None

    def _carry_out(self, request: SimRequest) -> SimReply:
        things, ok = self._simulation.things, True
        try:
            text = self._changed(request)
        except Refused as error:
            ok, text = False, str(error)
        pose = self._simulation.truth.pose()
        robot = Pose(x=pose.x, y=pose.y, yaw=pose.yaw)
        return SimReply(ok=ok, text=text[:500], things=things.all(), robot=robot)

    def _changed(self, request: SimRequest) -> str:
        things = self._simulation.things
        if request.do == "add":
            if request.thing is None:
                raise Refused("nothing to add; expected a `thing`")
            added = things.add(request.thing)
            return f"{added.name} is at ({added.x:.2f}, {added.y:.2f})"
        if request.do == "remove":
            return f"{things.remove(request.name).name} is gone"
        return f"{len(things.all())} objects were added"


def _answer(future: "asyncio.Future[SimReply]", reply: SimReply) -> None:
    if not future.done():
        future.set_result(reply)
