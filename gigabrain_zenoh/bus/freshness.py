"""The age of messages by the robot's clock, and the newest message while it is fresh."""

from typing import Generic, TypeVar

from gigabrain_schemas.base import TICK_NS, Message
from gigabrain_schemas.topics import SCAN, STATE, Topic
from gigabrain_zenoh.clock import Clock

M = TypeVar("M", bound=Message)
LEAD_TICKS = 5  # a process may lag behind by this much in reading states
CLOCK_KEYS = (STATE.key, SCAN.key)  # messages of the driver that move the robot's clock
JUMP_TICKS = 50  # a larger jump, or another boot, has to be confirmed
CONFIRMATIONS = 3  # messages in a row that have to agree


class RobotTime:
    """The newest tick that this process knows, and the driver's boot.

    One message must not move it far: a flipped bit would silence the process for ever. A jump of
    more than JUMP_TICKS, or a new boot, is accepted once CONFIRMATIONS messages in a row agree. A
    message that advances the present count discards them. The first message is always accepted.
    """

    def __init__(self) -> None:
        self.boot = 0
        self.tick = 0
        self._refused: tuple[int, int] | None = None  # boot and tick of the newest refusal
        self._refused_message: tuple[type[Message], int, int] | None = None  # type, seq and tick
        self._agreeing = 0  # refused messages in a row that agree

    def observe(self, message: Message) -> bool:
        """Update from the tick on a driver's message. Return whether it is credible."""
        if not message.boot:
            return self.boot == 0  # every message of a driver has its boot
        if self.boot == 0:
            self._accept(message)
            return True
        if message.boot == self.boot and abs(message.tick - self.tick) <= JUMP_TICKS:
            if message.tick > self.tick:
                self._accept(message)
            return True
        return self._is_confirmed(message)

    def _is_confirmed(self, message: Message) -> bool:
        by = (type(message), message.seq, message.tick)
        if by == self._refused_message:
            return False  # the same message, from another subscription of this process
        boot, tick = self._refused or (0, 0)
        agrees = message.boot == boot and abs(message.tick - tick) <= JUMP_TICKS
        self._agreeing = self._agreeing + 1 if agrees else 1
        self._refused, self._refused_message = (message.boot, message.tick), by
        if message.boot == self.boot and message.tick < self.tick:
            return False  # time does not go back: a process that is ahead has to restart
        if self._agreeing < CONFIRMATIONS:
            return False
        self._accept(message)
        return True

    def _accept(self, message: Message) -> None:
        self.boot, self.tick = message.boot, message.tick
        self._refused, self._refused_message, self._agreeing = None, None, 0


class Latest(Generic[M]):
    """The newest message on a topic, and its age."""

    def __init__(self, topic: Topic[M], clock: Clock, time: RobotTime) -> None:
        self._topic, self._clock, self._time = topic, clock, time
        # only wall time shows that the robot's clock has stopped
        self._uses_wall_time = topic.key == STATE.key
        self.newest: M | None = None
        self._arrived_ns = 0
        self._arrived_tick = 0

    def store(self, message: M) -> bool:
        """Keep `message` unless it is older than the held one; return whether it was kept.

        A held message from the future does not count as newer.
        """
        held, time = self.newest, self._time
        same_start = held and message.boot and message.boot == held.boot
        reached = held and held.tick <= time.tick + LEAD_TICKS
        if held and same_start and reached and message.tick < min(held.tick, time.tick):
            return False
        self.newest = message
        self._arrived_ns = self._clock.now_ns()
        self._arrived_tick = self._arrival_tick(message)
        return True

    def _arrival_tick(self, message: M) -> int:
        """Return the robot's tick at which `message` arrived, as far as this process knows."""
        now = self._time.tick
        if not message.boot:
            return now
        if message.boot != self._time.boot:
            return message.tick  # the driver's new boot is not known yet
        # if this process lags behind with states, only the message has the true tick
        return max(now, min(message.tick, now + LEAD_TICKS))

    @property
    def current(self) -> M | None:
        """Return the newest message of any age; None if it is of another boot."""
        message = self.newest
        return message if message and message.boot in (0, self._time.boot) else None

    def age_ns(self) -> int | None:
        """Return the newest message's age [ns]: of its tick or since its arrival, the larger one.

        None without a message of this boot.
        """
        message = self.current
        if message is None:
            return None
        return max(self._since_arrival_ns(message), self._tick_age_ns(message), 0)

    def _since_arrival_ns(self, message: M) -> int:
        """Return the time since the newest message arrived [ns]."""
        silent = (self._time.tick - self._arrived_tick) * TICK_NS
        if self._uses_wall_time or not message.boot:
            silent = max(silent, self._clock.now_ns() - self._arrived_ns)
        return silent

    def _tick_age_ns(self, message: M) -> int:
        """Return the age of the message's tick [ns]."""
        return (self._time.tick - message.tick) * TICK_NS if message.boot else 0

    def fresh(self, within_ns: int | None = None) -> M | None:
        """Return the newest message; None if it is older than its promised rate allows."""
        message = self.current
        if message is None:
            return None
        limit = self._topic.stale_after_ns if within_ns is None else within_ns
        in_time = self._tick_age_ns(message) <= max(limit, self._topic.echo_ns)
        return message if in_time and self._since_arrival_ns(message) <= limit else None


class PreviousTick(Generic[M]):
    """The newest message of an earlier tick."""

    def __init__(self) -> None:
        self._newest: M | None = None
        self._before: M | None = None

    def receive(self, message: M) -> None:
        """Store a message."""
        newest = self._newest
        same_start = newest and newest.boot == message.boot
        if newest and not (same_start and newest.tick >= message.tick):
            self._before = newest  # a message of a later tick precedes none
        self._newest = message

    def at(self, boot: int, tick: int, within_ns: int) -> M | None:
        """Return the newest message before `tick`, of this boot, at most `within_ns` old."""
        for message in (self._newest, self._before):
            if message is None or message.boot != boot:
                continue
            if 0 < (tick - message.tick) * TICK_NS <= within_ns:
                return message
        return None
