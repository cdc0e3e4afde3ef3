"""All that safety listens to."""

from collections import deque
from collections.abc import Callable
from typing import Any

from gigabrain_schemas.base import Message
from gigabrain_schemas.body import Body, BodyDescription, RobotState
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.sensors import Imu
from gigabrain_schemas.topics import (
    BODY,
    CMD_VEL,
    HEALTH,
    IMAGE,
    IMU,
    INTENT,
    LOG,
    MAP,
    POSE,
    SCAN,
    STATE,
    WORLD,
    Topic,
    command_topic,
)
from gigabrain_zenoh.bus.bus import Bus, Latest
from gigabrain_zenoh.bus.freshness import LEAD_TICKS, PreviousTick
from gigabrain_zenoh.gate.state import BRAIN
from gigabrain_zenoh.geometry.stopping import scan_limit_ns
from gigabrain_zenoh.safety.attitude import horizontal
from gigabrain_zenoh.safety.host import Look
from gigabrain_zenoh.safety.progress import SYSTEMS, Bases
from gigabrain_zenoh.safety.step import Inputs

# what nobody else listens to yet, so that what is bad on these keys is counted all the same
OVERHEARD: tuple[Topic[Any], ...] = (IMAGE, POSE, MAP, HEALTH, LOG)
MOST = 256  # what is kept between two states, however much is sent
WORLD_MARGIN_NS = 50_000_000  # how much later than a scan its world may come


class Senses:
    """Keeps the newest of everything; `on_new` is called with each state and each scan."""

    def __init__(self, bus: Bus, on_new: Callable[[Message], None], look: Look) -> None:
        self._bus, self._look = bus, look
        self._by_commander: dict[str, PreviousTick[CmdVel]] = {}
        # age [ticks] and source; tick, and horizontal acceleration [m/s2]
        self._echoes: deque[tuple[int, str]] = deque(maxlen=MOST)
        self._shocks: deque[tuple[int, float]] = deque(maxlen=MOST)
        self._commands = Latest(CMD_VEL, bus.clock, bus.time)  # the brain's
        self._obeyed, self._end_hearing = CMD_VEL.key, _nothing
        self.bodies = bus.latest(BODY, self._hear_body)
        self._states = bus.latest(STATE, on_new)
        self._scans = bus.latest(SCAN, on_new)
        bus.subscribe(CMD_VEL, self._hear_command)
        bus.subscribe(IMU, self._hear_imu)
        for topic in OVERHEARD:
            bus.subscribe(topic, lambda _key, _message: None)
        self._worlds, self._intents = bus.latest(WORLD), bus.latest(INTENT)

    def inputs(self, body: BodyDescription) -> Inputs | None:
        """What safety goes by now.

        None while there is no state, or while a scan has come of a tick whose state is on its way.
        """
        state = self._states.fresh()
        if state is None or state.tick < self._bus.time.tick:
            return None
        commander = state.gate.commander
        heard = self._by_commander.get(commander)
        return Inputs(
            state=state,
            scan=self._scans.current,
            scan_age_ns=self._scans.age_ns(),
            silent=self._silent(body),
            bases=self._bases(),
            command=heard.at(state.boot, state.tick, STATE.stale_after_ns) if heard else None,
            echo_ages=self._echo_ages(commander),
            shock=self._shock(state),
            host=self._look(self._bus.clock.now_ns()),
        )

    def _silent(self, body: BodyDescription) -> tuple[str, ...]:
        beat_ns = round(body.thresholds.heartbeat * 1e9)
        limits_ns = (scan_limit_ns(body) + WORLD_MARGIN_NS, beat_ns, beat_ns)
        systems: tuple[Latest[Any], ...] = (self._worlds, self._intents, self._commands)
        return tuple(
            name
            for name, system, limit_ns in zip(SYSTEMS, systems, limits_ns, strict=True)
            if not system.fresh(limit_ns)
        )

    def _bases(self) -> Bases:
        def basis(of: Latest[Any]) -> int:
            return of.current.basis if of.current else 0

        return Bases(
            scan=basis(self._scans),
            world=basis(self._worlds),
            intent=basis(self._intents),
            command=basis(self._commands),
        )

    def _echo_ages(self, commander: str) -> tuple[int, ...]:
        ages = tuple(age for age, source in self._echoes if source == commander)
        self._echoes.clear()
        return ages

    def _shock(self, state: RobotState) -> float:
        """The hardest before this tick; what comes with it may be quicker or slower than it."""
        shock = max((value for tick, value in self._shocks if tick < state.tick), default=0.0)
        later = [(tick, value) for tick, value in self._shocks if tick >= state.tick]
        self._shocks = deque(later, maxlen=MOST)
        return shock

    def _hear_command(self, _key: str, command: CmdVel) -> None:
        if command.source == BRAIN:
            self._commands.take(command)
        state = self._states.current
        if state and command.source == state.gate.commander:
            if command.source not in self._by_commander:  # who has driven before drives no more
                self._by_commander = {command.source: PreviousTick()}
            self._by_commander[command.source].receive(command)
        if command.boot == self._bus.time.boot:
            self._echoes.append((max(0, self._bus.time.tick - command.tick), command.source))

    def _hear_imu(self, _key: str, imu: Imu) -> None:
        time = self._bus.time
        if imu.boot == time.boot and imu.tick <= time.tick + LEAD_TICKS:
            self._shocks.append((imu.tick, horizontal(imu.linear_acceleration)))

    def _hear_body(self, body: Body) -> None:
        """Listen to what its driver obeys, besides the usual topic; to one such at a time."""
        topic = command_topic(body.description)
        if topic.key == self._obeyed:
            return
        self._end_hearing()
        self._obeyed, self._end_hearing = topic.key, _nothing
        if topic.key != CMD_VEL.key:
            self._end_hearing = self._bus.subscribe(topic, self._hear_command)


def _nothing() -> None:
    """End what has never begun."""
