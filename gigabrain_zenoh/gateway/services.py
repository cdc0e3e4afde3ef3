"""Services for ROS: e-stop, release, enable, saving the map, and the node's parameters.

`map_save` is a Trigger: every ROS installation has this type, and its reply has a text; Nav2's
SaveMap replies only true or false.
"""

import datetime
import logging
from collections.abc import Awaitable, Callable
from typing import Any

from gigabrain_schemas.requests import MapRequest
from gigabrain_schemas.topics import MAP_SAVE
from gigabrain_zenoh.client.requests import enable, press_estop, release
from gigabrain_zenoh.config.settings import Ros2Config
from gigabrain_zenoh.errors import BodyLost, GigabrainError, Refused
from gigabrain_zenoh.gate.state import BRAIN
from gigabrain_zenoh.gateway.scene import Scene, left_out
from gigabrain_zenoh.ros2.transport import RosTransport
from gigabrain_zenoh.ros2.types import Types

log = logging.getLogger(__name__)
TRIGGER, SET_BOOL = "std_srvs/srv/Trigger", "std_srvs/srv/SetBool"
LOG_NS = 1_000_000_000
SAVE_S = 10.0  # timeout: a large map takes a second on a slow disk
NOT_HERE = "this service cannot undo an e-stop; check the robot, then call the service release"


class Services:
    """Answers ROS's requests with the gateway's own rights."""

    def __init__(
        self,
        scene: Scene,
        ros: RosTransport,
        types: Types,
        config: Ros2Config,
        forget: Callable[[str], None],
    ) -> None:
        """Serve them; `forget(reason)` stops all commanding by ROS."""
        self._scene, self._types, self._forget = scene, types, forget
        self._logged = ("", "", 0)  # name, text and time of the last logged call
        acts: dict[str, tuple[str, Callable[[Any], Awaitable[str]]]] = {
            "estop": (SET_BOOL, self._estop),
            "release": (TRIGGER, self._release),
            "enable": (TRIGGER, self._enable),
            "map_save": (TRIGGER, self._map_save),
        }
        for name, (kind, act) in acts.items():
            if not left_out(config, name):
                ros.serve(name, kind, self._answerer(name, kind, act))

    def _answerer(
        self, name: str, kind: str, act: Callable[[Any], Awaitable[str]]
    ) -> Callable[[bytes], Awaitable[bytes]]:
        async def answer(payload: bytes) -> bytes:
            ok = True
            try:
                text = await act(self._types.decode_command(f"{kind}_Request", payload))
            except GigabrainError as error:
                ok, text = False, str(error)
            self._log(name, text, ok=ok)
            made = self._types.make(f"{kind}_Response", success=ok, message=text)
            return self._types.encode(f"{kind}_Response", made)

        return answer

    def _log(self, name: str, text: str, *, ok: bool) -> None:
        """Log a call, unless it repeats the last one within a second."""
        now_ns = self._scene.bus.clock.now_ns()
        if self._logged[:2] == (name, text) and now_ns - self._logged[2] < LOG_NS:
            return
        self._logged = name, text, now_ns
        log.info("service %s: %s", name, text, extra={"data": {"event": name, "ok": ok}})

    async def _estop(self, request: Any) -> str:
        if not request.data:
            raise Refused(NOT_HERE)
        self._forget("an e-stop was pressed")
        return (await press_estop(self._scene.bus, "a service call of ROS")).text

    async def _release(self, _: Any) -> str:
        state = self._scene.fresh_state
        if state is None:
            raise BodyLost("no state from the robot; check that its driver runs")
        return (await release(self._scene.bus, state.gate.estop_generation)).text

    async def _enable(self, _: Any) -> str:
        """Let the robot's brain drive; the body is taken from this gateway's own commander only."""
        state, bus = self._scene.fresh_state, self._scene.bus
        ours = state is not None and state.gate.commander == bus.process
        self._forget("the robot's brain was enabled")
        return (await enable(bus, BRAIN, take=ours)).text

    async def _map_save(self, _: Any) -> str:
        bus = self._scene.bus
        seconds, ns = divmod(bus.clock.unix_ns(), 10**9)
        when = datetime.datetime.fromtimestamp(seconds, datetime.UTC)
        name = f"ros2-{when:%Y%m%d-%H%M%S}-{ns // 10**6:03d}"  # robots may save at once
        request = MapRequest(name=name, source=bus.process)
        replies = await bus.ask(MAP_SAVE, request, timeout_s=SAVE_S)
        if not replies:
            raise Refused("no process makes a map; run perception with mapping: slam")
        if not replies[0].ok:
            raise Refused(replies[0].text)
        return replies[0].text
