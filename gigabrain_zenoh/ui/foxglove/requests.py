"""Services and parameters for viewers: e-stop, release, enable, and the robot's settings.

The server calls from threads of its own; each request is carried out in the event loop.
"""

import asyncio
import concurrent.futures
import contextlib
import logging
from collections.abc import Callable, Coroutine, Iterable
from typing import Any, TypeVar

import msgspec
from foxglove import MessageSchema, Schema
from foxglove.websocket import Parameter, Service, ServiceRequest, ServiceSchema

from gigabrain_schemas.body import RobotState
from gigabrain_schemas.requests import Param
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.client.requests import (
    GIVE_UP_S,
    ParamTable,
    enable,
    press_estop,
    release,
    set_param,
)
from gigabrain_zenoh.errors import BodyLost, GigabrainError, Refused, unknown
from gigabrain_zenoh.gate.state import BRAIN

log = logging.getLogger(__name__)

T = TypeVar("T")
LOOP_TIMEOUT_S = GIVE_UP_S + 1.0  # a server's thread waits so long for the event loop
REFRESH_NS = 2_000_000_000
MAX_PARAMETERS = 32  # that one request may set
REPLY_SCHEMA = {
    "type": "object",
    "properties": {"ok": {"type": "boolean"}, "text": {"type": "string"}},
}
NOT_PERMITTED = "it does not publish on the topic of the layout file"


class FoxgloveRequests:
    """Carries out the requests of viewers that may steer."""

    def __init__(
        self,
        bus: Bus,
        state: Callable[[], RobotState | None],
        processes: Callable[[], Iterable[str]],
        may: Callable[[int], bool],
    ) -> None:
        self._bus, self._state, self._may = bus, state, may
        self._params = ParamTable(bus, processes)
        self._loop = asyncio.get_running_loop()
        self._known: dict[str, tuple[str, Param]] = {}  # process and parameter, by viewers' names

    def services(self) -> list[Service]:
        """Return the services that viewers may call."""
        acts = {"/estop": self._estop, "/release": self._release, "/enable": self._enable}
        return [self._service(name, act) for name, act in acts.items()]

    async def refresh(self) -> list[Parameter]:
        """Ask all processes for their parameters; return those that have changed."""
        table = await self._params.read()
        new = {f"{name}.{one.name}": (name, one) for name, some in table.items() for one in some}
        changed = [name for name, entry in new.items() if self._known.get(name) != entry]
        self._known = new
        return self.shown(changed)

    def get(self, names: list[str]) -> list[Parameter]:
        """Return present parameters; all without names. Called in a server's thread."""
        with contextlib.suppress(Refused):  # the robot is busy: return the last values
            self._in_loop(self.refresh())
        return self.shown(names)

    def shown(self, names: Iterable[str]) -> list[Parameter]:
        """Return known parameters in the viewers' format; all without names."""
        known = self._known
        chosen = [name for name in names if name in known] or ([] if names else list(known))
        return [Parameter(name, value=_number_or_text(known[name][1].value)) for name in chosen]

    def set(self, viewer: int, wanted: list[Parameter]) -> list[Parameter]:
        """Set parameters, and return their new values. Called in a server's thread."""
        if self._may(viewer):
            self._in_loop(self._set_all(wanted[:MAX_PARAMETERS]))
        else:
            log.warning("viewer %d may not set parameters: %s", viewer, NOT_PERMITTED)
        return self.shown([one.name for one in wanted])

    async def _set_all(self, wanted: list[Parameter]) -> None:
        for parameter in wanted:
            process, name = parameter.name.partition(".")[::2]
            try:
                if parameter.name not in self._known:
                    raise unknown("parameter", parameter.name[:100], self._known)
                log.info(
                    "%s", await set_param(self._bus, process, name, _text(parameter.get_value()))
                )
            except GigabrainError as error:
                log.warning("parameter %s: %s", parameter.name[:100], error)
        await self.refresh()

    def _service(self, name: str, act: Callable[[], Coroutine[Any, Any, str]]) -> Service:
        empty = Schema(
            name=f"{name[1:]}_request", encoding="jsonschema", data=b'{"type": "object"}'
        )
        reply = Schema(
            name=f"{name[1:]}_reply", encoding="jsonschema", data=msgspec.json.encode(REPLY_SCHEMA)
        )

        def handle(request: ServiceRequest) -> bytes:
            if not self._may(request.client_id):
                log.warning("viewer %d may not call %s: %s", request.client_id, name, NOT_PERMITTED)
                return _reply(ok=False, text=f"not allowed: {NOT_PERMITTED}")
            try:
                return _reply(ok=True, text=self._in_loop(act()))
            except GigabrainError as error:
                return _reply(ok=False, text=str(error))

        schema = ServiceSchema(
            name=name,
            request=MessageSchema(encoding="json", schema=empty),
            response=MessageSchema(encoding="json", schema=reply),
        )
        return Service(name=name, schema=schema, handler=handle)

    async def _estop(self) -> str:
        return (await press_estop(self._bus, "a viewer of Foxglove")).text

    async def _release(self) -> str:
        state = self._state()
        if state is None:
            raise BodyLost("the robot sends no state; check its driver")
        return (await release(self._bus, state.gate.estop_generation)).text

    async def _enable(self) -> str:
        return (await enable(self._bus, BRAIN)).text

    def _in_loop(self, act: Coroutine[Any, Any, T]) -> T:
        """Return the result of `act` in the event loop. Raises Refused if it takes too long."""
        future = asyncio.run_coroutine_threadsafe(act, self._loop)
        try:
            return future.result(LOOP_TIMEOUT_S)
        except (concurrent.futures.TimeoutError, concurrent.futures.CancelledError):
            future.cancel()
            raise Refused("no answer in time; try again") from None


def _reply(*, ok: bool, text: str) -> bytes:
    return msgspec.json.encode({"ok": ok, "text": text})


def _number_or_text(text: str) -> float | str:
    """Return the value of a parameter as a number, if it is one."""
    try:
        return float(text)
    except ValueError:
        return text


def _text(value: object) -> str:
    """Return a viewer's value as a person would type it."""
    if value is None:
        return "null"
    return f"{value:g}" if isinstance(value, float) else str(value)[:200]
