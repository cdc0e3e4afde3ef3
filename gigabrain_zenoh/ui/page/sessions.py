"""Browsers that are connected: their login, the frames sent to them, and their requests."""

import asyncio
import contextlib
import itertools
import logging
from collections.abc import Callable, Iterable, Sequence
from typing import Literal

from msgspec.structs import replace
from starlette.websockets import WebSocket, WebSocketDisconnect

from gigabrain_schemas.requests import GateReply
from gigabrain_schemas.sim import SimRequest
from gigabrain_schemas.tasks import GoalReply, TaskReply, TaskRequest
from gigabrain_schemas.topics import GOAL, TASK_CHANGE
from gigabrain_schemas.zones import SavedMapInfo
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.client.requests import (
    ANSWER_S,
    ParamTable,
    change_world,
    enable,
    let_go,
    press_estop,
    release,
    set_param,
)
from gigabrain_zenoh.client.zones import change_zones, load_map, save_map, saved_maps
from gigabrain_zenoh.errors import BodyLost, GigabrainError, NotConfirmed, Refused
from gigabrain_zenoh.gate.state import BRAIN
from gigabrain_zenoh.plugins import package_version
from gigabrain_zenoh.ui.page import frames
from gigabrain_zenoh.ui.page.access import Access, Role
from gigabrain_zenoh.ui.page.cameras import (
    CameraFrames,
    PicturePace,
    Shown,
    SurroundingsFrames,
    Watch,
)
from gigabrain_zenoh.ui.page.frames import Jog, PageReply, PageRequest, PageView, Setting
from gigabrain_zenoh.ui.steering import RateLimiter, TeleopArbiter

log = logging.getLogger(__name__)

LOGIN_TIMEOUT_S = 5.0
WRONG_TOKEN_DELAY_S = 0.5  # before the answer, against guessing
MAX_VIEWERS = 16  # connected browsers; an operator replaces a viewer
MAX_OPERATORS = 64  # more than MAX_VIEWERS, as each operator can stop the robot
MAX_LOGINS = 64  # browsers that have not logged in; a new one replaces the oldest
MAX_PENDING = 8  # requests of one viewer under way; e-stops do not count
MAX_REPLY_CHARS = 500
MAX_REASON_BYTES = 120  # of the reason for closing a WebSocket
MAX_WAITING_FRAMES = 64  # for a slow browser
BAD_FRAME, WRONG_TOKEN, FULL = 1008, 4401, 4429  # codes for closing a WebSocket (RFC 6455 7.4)
Admission = Role | Literal["late"] | None  # None for a wrong token
OTHER_STEERS = PageReply(
    id=0, what="drive", ok=False, text="another page steers the robot; wait until it stops"
)


class Viewer:
    """Queue of frames for one browser: the newest of each slot. Log lines are dropped first."""

    def __init__(self, number: int, role: Role) -> None:
        self.number, self.role = number, role
        self.pace = PicturePace()
        self.replaced = asyncio.Event()
        self._slots: dict[str, bytes] = {}
        self._filled = asyncio.Event()

    def queue(self, slot: str, frame: bytes) -> None:
        """Replace the frame that waits in `slot`, or add one, without waiting."""
        self._slots[slot] = frame
        while len(self._slots) > MAX_WAITING_FRAMES:
            del self._slots[min(self._slots, key=lambda slot: not slot.startswith("log/"))]
        self._filled.set()

    async def next_frame(self) -> bytes:
        """Wait for the next frame to send."""
        await self._filled.wait()
        frame = self._slots.pop(next(iter(self._slots)))
        if not self._slots:
            self._filled.clear()
        return frame


class RequestHandler:
    """Carries out the requests of operators."""

    def __init__(
        self,
        bus: Bus,
        processes: Callable[[], Iterable[str]] = tuple,
        hold_joints: Callable[[], bool] = bool,
    ) -> None:
        self._bus, self._hold_joints = bus, hold_joints
        self._params = ParamTable(bus, processes)

    async def handle(self, request: PageRequest) -> PageReply:
        """Carry out a request. Errors are part of the reply."""
        ok, robot, unconfirmed = True, "", False
        settings: tuple[Setting, ...] = ()
        maps: tuple[SavedMapInfo, ...] = ()
        try:
            if request.what == "settings":
                text, settings = "", await self._settings()
            elif request.what == "maps":
                text, maps = "", (await saved_maps(self._bus)).maps
            else:
                text, robot = await self._carry_out(request)
        except GigabrainError as error:
            ok, text, unconfirmed = False, str(error), isinstance(error, NotConfirmed)
        return PageReply(
            id=request.id,
            what=request.what,
            ok=ok,
            text=text[:MAX_REPLY_CHARS],
            robot=robot,
            settings=settings,
            maps=maps,
            not_confirmed=unconfirmed,
        )

    async def _carry_out(self, request: PageRequest) -> tuple[str, str]:
        if request.what == "goal":
            return await self._goal(request), ""
        if request.what == "cancel":
            return await self._cancel(), ""
        if request.what == "set":
            names = request.process, request.name, request.value
            return await set_param(self._bus, *names), ""
        if request.what == "zones":
            return await self._change_zones(request), ""
        if request.what == "map_save":
            return await save_map(self._bus, request.name, replace=request.value == "replace"), ""
        if request.what == "map_load":
            return await load_map(self._bus, request.name), ""
        if request.what == "world":
            wanted = replace(request.world or SimRequest(), source=self._bus.process)
            return (await change_world(self._bus, wanted)).text, ""
        if request.what == "hold" and self._hold_joints():
            return "the arm holds until the brain is enabled again", ""
        if request.what == "estop":
            reply = await press_estop(self._bus, "operator page")
        elif request.what == "release":
            reply = await release(self._bus, request.estop_generation)
        elif request.what in ("hold", "limp"):
            reply = await self._let_go(request)
        else:
            reply = await enable(self._bus, BRAIN, take=request.what == "take")
        return reply.text, reply.robot_type

    async def _let_go(self, request: PageRequest) -> GateReply:
        """Let an arm go limp, or hold a limp one."""
        limp = request.what == "limp"
        if limp and request.value != "yes":
            raise Refused("a limp arm may fall: a person must confirm this first")
        return await let_go(self._bus, limp)

    async def _change_zones(self, request: PageRequest) -> str:
        if request.zones is None:
            raise Refused("a change of zones needs a zone, a place or a name")
        wanted = replace(request.zones, source=self._bus.process)
        return await change_zones(self._bus, wanted)

    async def _settings(self) -> tuple[Setting, ...]:
        """Return the settings of all processes that a file can keep."""
        found = await self._params.read()
        return tuple(
            Setting(process=name, param=one)
            for name, some in found.items()
            for one in some
            if one.key
        )

    async def _cancel(self) -> str:
        change = TaskRequest(do="cancel", source=self._bus.process)
        replies = await self._bus.ask(TASK_CHANGE, change, timeout_s=ANSWER_S)
        return _text_of(replies)

    async def _goal(self, request: PageRequest) -> str:
        if request.goal is None:
            raise Refused("a goal needs a place")
        goal = replace(request.goal, source=self._bus.process)
        replies = await self._bus.ask(GOAL, goal, timeout_s=ANSWER_S)
        return _text_of(replies)


def _text_of(replies: Sequence[GoalReply | TaskReply]) -> str:
    """Return the text of the first reply. Raises BodyLost without a reply, and Refused."""
    if not replies:
        raise BodyLost("no process serves goals: this robot runs no navigation")
    if not replies[0].ok:
        raise Refused(replies[0].text)
    return replies[0].text


class Sessions:
    """Serves all viewers: frames of the robot, steering and requests."""

    def __init__(self, bus: Bus, access: Access) -> None:
        self._access = access
        self._numbers = itertools.count(1)
        self._pending: dict[asyncio.Task[None], Viewer] = {}
        self._logins: list[asyncio.Task[Admission]] = []
        self._loop = asyncio.get_running_loop()
        self._rates = RateLimiter()
        self.viewers: list[Viewer] = []
        self._clock = bus.clock
        self._cameras = CameraFrames(bus, self.send)
        self._surroundings = SurroundingsFrames(bus)
        self._view = PageView(bus, self.send, self._introduce_all)
        self._handler = RequestHandler(bus, self._view.health.keys, self._view.hold_joints)
        self._arbiter = TeleopArbiter(self._view)

    def send(self, slot: str, frame: bytes) -> None:
        """Send a frame to all viewers without waiting."""
        for viewer in self.viewers:
            viewer.queue(slot, frame)

    def send_new_frames(self) -> None:
        """Send the newest frames to the viewers; without viewers, receive nothing from the bus."""
        self._surroundings.watch(bool(self.viewers))
        self._view.watch_plans(bool(self.viewers))
        by_pace = {viewer.pace: viewer for viewer in self.viewers}
        now_ns = self._clock.now_ns()
        for pace, slot, frame in self._cameras.new_frames(tuple(by_pace), now_ns):
            by_pace[pace].queue(slot, frame)
        if not self.viewers:
            return
        driving = self._arbiter.driving(self._loop.time())
        self.send("state", self._view.state_frame(driving, len(self.viewers)))
        for slot, frame in self._view.new_frames():
            self.send(slot, frame)
        for slot, frame in self._surroundings.new_frames(self._view.world.fresh()):
            self.send(slot, frame)

    def close(self) -> None:
        """End steering and requests."""
        self._arbiter.clear()
        for task in self._pending:
            task.cancel()

    async def talk(self, socket: WebSocket) -> None:
        """Serve one browser from its login until it disconnects."""
        if not self._access.own_page(socket.headers):
            log.warning("refused a page of another origin")
            await socket.close(BAD_FRAME, "the page is of another origin")
            return
        await socket.accept()
        with contextlib.suppress(WebSocketDisconnect):
            role = await self._admit(socket)
            if role is None or role == "late" or not self._has_room(role):
                await socket.close(FULL if role else WRONG_TOKEN)
                return
            viewer = Viewer(next(self._numbers), role)
            await self._serve_viewer(socket, viewer)
            if viewer.replaced.is_set():
                await socket.close(FULL, "replaced by an operator")

    def _has_room(self, role: Role) -> bool:
        """Return whether one more browser is admitted; an operator may replace a viewer."""
        if role != "operator":
            return len(self.viewers) < MAX_VIEWERS
        others = [viewer for viewer in self.viewers if viewer.role != "operator"]
        if len(self.viewers) >= MAX_VIEWERS and others:
            others[0].replaced.set()
            self.viewers.remove(others[0])
        return len(self.viewers) < MAX_OPERATORS

    async def _admit(self, socket: WebSocket) -> Admission:
        login = self._loop.create_task(self._login(socket))
        self._logins.append(login)
        if len(self._logins) > MAX_LOGINS:
            self._logins.pop(0).cancel()
        try:
            await asyncio.wait((login,))
        finally:
            login.cancel()
            if login in self._logins:
                self._logins.remove(login)
        return "late" if login.cancelled() else login.result()

    async def _login(self, socket: WebSocket) -> Admission:
        try:
            message = await asyncio.wait_for(socket.receive(), LOGIN_TIMEOUT_S)
            frame = message.get("bytes") or b""
            if frame[:1] != bytes((frames.LOGIN,)):
                return None
            role = self._access.role(frames.decoded(frame[1:], frames.Login).token)
        except TimeoutError:
            return "late"
        except ValueError:
            return None
        if role is None:
            log.warning("refused a browser with a wrong token")
            await asyncio.sleep(WRONG_TOKEN_DELAY_S)
        return role

    async def _serve_viewer(self, socket: WebSocket, viewer: Viewer) -> None:
        self._introduce(viewer)
        self.viewers.append(viewer)
        tasks = (
            asyncio.ensure_future(_send_frames(socket, viewer)),
            asyncio.ensure_future(self._receive(socket, viewer)),
            asyncio.ensure_future(viewer.replaced.wait()),
        )
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            if viewer in self.viewers:
                self.viewers.remove(viewer)
            self._arbiter.leave(viewer.number)
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    def _introduce(self, viewer: Viewer) -> None:
        body = self._view.body
        about = frames.About(
            role=viewer.role,
            viewer=viewer.number,
            version=package_version(),
            body=body.description if body else None,
            link=body.link if body else "",
        )
        viewer.queue("about", frames.as_json(frames.ABOUT, about))
        for slot, frame in (*self._view.kept_frames(), *self._cameras.kept_frames()):
            viewer.queue(slot, frame)

    def _introduce_all(self) -> None:
        for viewer in self.viewers:
            self._introduce(viewer)

    async def _receive(self, socket: WebSocket, viewer: Viewer) -> None:
        """Process frames until the browser leaves or sends one that is not allowed."""
        while True:
            message = await socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            try:
                self._process(viewer, message.get("bytes") or b"")
            except ValueError as error:
                log.warning("disconnected viewer %d: %s", viewer.number, str(error)[:200])
                reason = str(error).encode()[:MAX_REASON_BYTES].decode(errors="ignore")
                await socket.close(BAD_FRAME, reason)
                return

    def _process(self, viewer: Viewer, frame: bytes) -> None:
        """Process one frame. Raises ValueError for a frame that our page never sends."""
        now_s = self._loop.time()
        if self._rates.is_exceeded(viewer.number, now_s):
            raise ValueError("too many frames")
        kind, content = frame[:1], frame[1:]
        if kind == bytes((frames.WATCH,)):
            viewer.pace.set_watch(frames.decoded(content, Watch))
        elif kind == bytes((frames.SHOWN,)):
            viewer.pace.shown(frames.decoded(content, Shown).camera)
        elif viewer.role != "operator":
            raise ValueError("viewers may not drive")
        elif kind == bytes((frames.DRIVE,)):
            if not self._arbiter.drive(viewer.number, frames.drive_of(content), now_s):
                self._reply(viewer, OTHER_STEERS)
        elif kind == bytes((frames.JOG,)):
            speeds = self._view.joint_speeds(frames.decoded(content, Jog))
            if not self._arbiter.jog(viewer.number, speeds, now_s):
                self._reply(viewer, OTHER_STEERS)
        elif kind == bytes((frames.ASK,)):
            request = frames.request_of(content)
            if isinstance(request, PageReply):
                self._reply(viewer, request)
            else:
                self._start_request(viewer, request)
        else:
            raise ValueError("unknown frame")

    def _start_request(self, viewer: Viewer, request: PageRequest) -> None:
        if request.what == "estop":
            self._arbiter.clear()
        elif list(self._pending.values()).count(viewer) >= MAX_PENDING:
            text = "too many requests are still under way"
            self._reply(viewer, PageReply(id=request.id, what=request.what, ok=False, text=text))
            return
        task = self._loop.create_task(self._handle(viewer, request))
        self._pending[task] = viewer
        task.add_done_callback(self._pending.pop)

    async def _handle(self, viewer: Viewer, request: PageRequest) -> None:
        self._reply(viewer, await self._handler.handle(request))

    def _reply(self, viewer: Viewer, reply: PageReply) -> None:
        viewer.queue(f"reply/{reply.id}", frames.as_json(frames.REPLY, reply))


async def _send_frames(socket: WebSocket, viewer: Viewer) -> None:
    while True:
        await socket.send_bytes(await viewer.next_frame())
