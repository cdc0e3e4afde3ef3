"""The age of messages by the robot's clock, and whether they still count."""

from typing import Generic, TypeVar

from gigabrain_schemas.base import TICK_NS, Message
from gigabrain_schemas.topics import SCAN, STATE, Topic
from gigabrain_zenoh.clock import Clock

M = TypeVar("M", bound=Message)
LEAD_TICKS = 5  # how far behind the robot a process may be with reading its states
CLOCK_KEYS = (STATE.key, SCAN.key)  # what the driver sends on these moves the robot's clock
JUMP_TICKS = 50  # a message that is farther off, or of another boot, has to be confirmed
CONFIRMED = 3  # messages in a row that agree


class RobotTime:
    """The newest tick that this process has seen, and of which start of the driver.

    One message must not move it far: one flipped bit would silence the process for ever. A jump of
    more than JUMP_TICKS, and a new boot, count once CONFIRMED messages in a row agree and none
    between them continues the present count. The very first message is believed.
    """

    def __init__(self) -> None:
        self.boot = 0
        self.tick = 0
        self._claim: tuple[int, int] | None = None  # boot and tick of the last that was refused
        self._claimed_by: tuple[type[Message], int, int] | None = None  # and which message it was
        self._agree = 0  # how many have made that claim

    def observe(self, message: Message) -> bool:
        """Update from the tick on a driver's message. Return whether it is credible."""
        if not message.boot:
            return self.boot == 0  # a driver names its start in every message
        if self.boot == 0:
            self._believe(message)
            return True
        if message.boot == self.boot and abs(message.tick - self.tick) <= JUMP_TICKS:
            if message.tick > self.tick:
                self._believe(message)
            return True
        return self._confirmed(message)

    def _confirmed(self, message: Message) -> bool:
        by = (type(message), message.seq, message.tick)
        if by == self._claimed_by:
            return False  # the same message, at another subscriber of this process
        boot, tick = self._claim or (0, 0)
        agrees = message.boot == boot and abs(message.tick - tick) <= JUMP_TICKS
        self._agree = self._agree + 1 if agrees else 1
        self._claim, self._claimed_by = (message.boot, message.tick), by
        if message.boot == self.boot and message.tick < self.tick:
            return False  # time does not go back: a process that is ahead has to restart
        if self._agree < CONFIRMED:
            return False
        self._believe(message)
        return True

    def _believe(self, message: Message) -> None:
        self.boot, self.tick = message.boot, message.tick
        self._claim, self._claimed_by, self._agree = None, None, 0


class Latest(Generic[M]):
    """The newest message on a topic, while it is still worth believing."""

    def __init__(self, topic: Topic[M], clock: Clock, time: RobotTime) -> None:
        self._topic, self._clock, self._time = topic, clock, time
        self._by_wall = topic.key == STATE.key  # nothing else shows that the robot's clock stopped
        self.newest: M | None = None
        self._arrived_ns = 0
        self._arrived_tick = 0

    def store(self, message: M) -> bool:
        """Keep `message` unless it is older than the held one; return whether it was kept.

        A held tick that the robot has not reached yet keeps no other message out.
        """
        held, time = self.newest, self._time
        same_start = held and message.boot and message.boot == held.boot
        reached = held and held.tick <= time.tick + LEAD_TICKS
        if held and same_start and reached and message.tick < min(held.tick, time.tick):
            return False
        self.newest = message
        self._arrived_ns = self._clock.now_ns()
        self._arrived_tick = self._arrival(message)
        return True

    def _arrival(self, message: M) -> int:
        """Return the robot's tick at which `message` arrived, as far as this process knows."""
        now = self._time.tick
        if not message.boot:
            return now
        if message.boot != self._time.boot:
            return message.tick  # a start of the driver that is not known yet: its own count
        # a process that lags behind with states has the true tick only from the message
        return max(now, min(message.tick, now + LEAD_TICKS))

    @property
    def current(self) -> M | None:
        """Return the newest message of any age, unless it is of another start of the driver."""
        message = self.newest
        return message if message and message.boot in (0, self._time.boot) else None

    def age_ns(self) -> int | None:
        """Return the age of the newest message [ns], by the robot's clock or by arrival.

        The greater one counts. None without a message of this start of the driver.
        """
        message = self.current
        return None if message is None else max(self._silent_ns(message), self._echo_ns(message), 0)

    def _silent_ns(self, message: M) -> int:
        """Return the time since the newest message arrived [ns]."""
        silent = (self._time.tick - self._arrived_tick) * TICK_NS
        if self._by_wall or not message.boot:
            silent = max(silent, self._clock.now_ns() - self._arrived_ns)
        return silent

    def _echo_ns(self, message: M) -> int:
        """Return the age of the tick on the message [ns]."""
        return (self._time.tick - message.tick) * TICK_NS if message.boot else 0

    def fresh(self, within_ns: int | None = None) -> M | None:
        """Return the newest message; None if it is older than its promised rate allows."""
        message = self.current
        if message is None:
            return None
        limit = self._topic.stale_after_ns if within_ns is None else within_ns
        in_time = self._echo_ns(message) <= max(limit, self._topic.echo_ns)
        return message if in_time and self._silent_ns(message) <= limit else None


class PreviousTick(Generic[M]):
    """The newest message of an earlier tick."""

    def __init__(self) -> None:
        self._newest: M | None = None
        self._before: M | None = None

    def receive(self, message: M) -> None:
        """Take one message."""
        newest = self._newest
        same_start = newest and newest.boot == message.boot
        if newest and not (same_start and newest.tick >= message.tick):
            self._before = newest  # a message of the future precedes none
        self._newest = message

    def at(self, boot: int, tick: int, within_ns: int) -> M | None:
        """Return the newest message before `tick`, of this boot, at most `within_ns` old."""
        for message in (self._newest, self._before):
            if message is None or message.boot != boot:
                continue
            if 0 < (tick - message.tick) * TICK_NS <= within_ns:
                return message
        return None
