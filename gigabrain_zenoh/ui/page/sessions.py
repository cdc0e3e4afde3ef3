"""The browsers that are connected: login, what they are sent, what they say."""

import asyncio
import contextlib
import itertools
import logging

from starlette.websockets import WebSocket, WebSocketDisconnect

from gigabrain_zenoh.plugins import package_version
from gigabrain_zenoh.ui.page import wire
from gigabrain_zenoh.ui.page.access import Access, Role
from gigabrain_zenoh.ui.page.operator import Operator
from gigabrain_zenoh.ui.page.scene import Scene
from gigabrain_zenoh.ui.page.viewer import Viewer
from gigabrain_zenoh.ui.seat import Seat

log = logging.getLogger(__name__)

LOGIN_S = 5.0  # until a browser has to have said who it is
WRONG_S = 0.5  # how long a wrong token waits for its answer
MOST = 16  # browsers at a time; who only looks gives way to an operator
MOST_OPERATORS = 64  # of whom each can stop the robot, so nobody else's number keeps one out
ARRIVING = 64  # browsers that have not said who they are; the oldest gives way to the newest
WAITING = 8  # requests of one viewer that are under way; e-stops do not count
LONGEST = 120  # bytes of a reason for closing
BAD, STRANGER, FULL = 1008, 4401, 4429  # why a WebSocket is closed (RFC 6455 7.4)


class Sessions:
    """All viewers."""

    def __init__(self, access: Access) -> None:
        self._access = access
        self._numbers = itertools.count(1)
        self._asking: dict[asyncio.Task[None], Viewer] = {}
        self._arriving: list[asyncio.Task[Role | None]] = []
        self._loop = asyncio.get_running_loop()
        self.viewers: list[Viewer] = []

    def serve(self, scene: Scene, seat: Seat, operator: Operator) -> None:
        """What they are to see, and whom to ask."""
        self._scene, self._seat, self._operator = scene, seat, operator
        scene.on_body = self._introduce

    def tell(self, slot: str, frame: bytes) -> None:
        """Send a frame to all; nobody is waited for."""
        for viewer in self.viewers:
            viewer.put(slot, frame)

    def moment(self) -> bytes:
        """How the robot is now."""
        return self._scene.moment(self._seat.driving(self._loop.time()), len(self.viewers))

    def close(self) -> None:
        """Nobody steers from here any more."""
        self._seat.clear()
        for task in self._asking:
            task.cancel()

    async def talk(self, socket: WebSocket) -> None:
        """One browser, from its login to its end."""
        if not self._access.own_page(socket.headers):
            log.warning("a page of another origin was refused")
            await socket.close(BAD, "this page is not of this server")
            return
        await socket.accept()
        with contextlib.suppress(WebSocketDisconnect):
            role = await self._arrive(socket)
            if role is None or not self._has_room(role):
                await socket.close(FULL if role else STRANGER)
                return
            viewer = Viewer(next(self._numbers), role)
            await self._look_on(socket, viewer)
            if viewer.gives_way.is_set():
                await socket.close(FULL, "an operator has taken this place")

    def _has_room(self, role: Role) -> bool:
        """Whether one more gets in; makes room for an operator."""
        looking = [each for each in self.viewers if each.role != "operator"]
        if role != "operator":
            return len(self.viewers) < MOST
        if len(self.viewers) >= MOST and looking:
            looking[0].gives_way.set()
            self.viewers.remove(looking[0])
        return len(self.viewers) < MOST_OPERATORS

    async def _arrive(self, socket: WebSocket) -> Role | None:
        login = self._loop.create_task(self._login(socket))
        self._arriving.append(login)
        if len(self._arriving) > ARRIVING:
            self._arriving.pop(0).cancel()
        try:
            await asyncio.wait((login,))
        finally:
            login.cancel()
            if login in self._arriving:
                self._arriving.remove(login)
        return None if login.cancelled() else login.result()

    async def _login(self, socket: WebSocket) -> Role | None:
        try:
            message = await asyncio.wait_for(socket.receive(), LOGIN_S)
            frame = message.get("bytes") or b""
            if frame[:1] != bytes((wire.LOGIN,)):
                return None
            role = self._access.role(wire.login_of(frame[1:]).token)
        except (TimeoutError, ValueError):
            return None
        if role is None:
            log.warning("somebody with a wrong token was turned away")
            await asyncio.sleep(WRONG_S)
        return role

    async def _look_on(self, socket: WebSocket, viewer: Viewer) -> None:
        self._greet(viewer)
        self.viewers.append(viewer)
        sending = asyncio.ensure_future(_send(socket, viewer))
        hearing = asyncio.ensure_future(self._hear(socket, viewer))
        leaving = asyncio.ensure_future(viewer.gives_way.wait())
        tasks = (sending, hearing, leaving)
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            if viewer in self.viewers:
                self.viewers.remove(viewer)
            self._seat.leave(viewer.number)
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    def _greet(self, viewer: Viewer) -> None:
        body = self._scene.body
        about = wire.About(
            role=viewer.role,
            viewer=viewer.number,
            version=package_version(),
            body=body.description if body else None,
            link=body.link if body else "",
        )
        viewer.put("about", wire.as_json(wire.ABOUT, about))
        for slot, frame in self._scene.before():
            viewer.put(slot, frame)

    def _introduce(self) -> None:
        for viewer in self.viewers:
            self._greet(viewer)

    async def _hear(self, socket: WebSocket, viewer: Viewer) -> None:
        """Until the browser leaves, or says what it may not."""
        while True:
            message = await socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            try:
                self._take(viewer, message.get("bytes") or b"")
            except ValueError as error:
                log.warning("viewer %d was cut off: %s", viewer.number, str(error)[:200])
                await socket.close(BAD, str(error).encode()[:LONGEST].decode(errors="ignore"))
                return

    def _take(self, viewer: Viewer, frame: bytes) -> None:
        """One frame. Raises ValueError for one that no page of ours sends."""
        now_s = self._loop.time()
        if viewer.floods(now_s):
            raise ValueError("too many frames")
        kind, content = frame[:1], frame[1:]
        if viewer.role != "operator":
            raise ValueError("a viewer may look and not drive")
        if kind == bytes((wire.DRIVE,)):
            if not self._seat.drive(viewer.number, wire.drive_of(content), now_s):
                self._reply(viewer, wire.Reply(id=0, what="drive", ok=False, text=SEATED))
        elif kind == bytes((wire.ASK,)):
            self._ask(viewer, wire.ask_of(content))
        else:
            raise ValueError("an unknown frame")

    def _ask(self, viewer: Viewer, asked: wire.Ask) -> None:
        under_way = list(self._asking.values()).count(viewer)
        if asked.what == "estop":
            self._seat.clear()
        elif under_way >= WAITING:
            text = "too many requests are still under way"
            self._reply(viewer, wire.Reply(id=asked.id, what=asked.what, ok=False, text=text))
            return
        task = self._loop.create_task(self._answer(viewer, asked))
        self._asking[task] = viewer
        task.add_done_callback(self._asking.pop)

    async def _answer(self, viewer: Viewer, asked: wire.Ask) -> None:
        self._reply(viewer, await self._operator.answer(asked))

    def _reply(self, viewer: Viewer, reply: wire.Reply) -> None:
        viewer.put(f"reply/{reply.id}", wire.as_json(wire.REPLY, reply))


SEATED = "somebody else steers from another page"


async def _send(socket: WebSocket, viewer: Viewer) -> None:
    while True:
        await socket.send_bytes(await viewer.next())
