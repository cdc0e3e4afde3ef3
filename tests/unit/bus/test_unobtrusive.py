"""Those who only look on wake seldom."""

from gigabrain_zenoh.bus.zenoh.workarounds import ReceiveThrottle


class Thread:
    """One that receives, in a time of its own."""

    def __init__(self) -> None:
        self.now_s, self.slept_s, self.got = 100.0, list[float](), list[str]()
        nap = ReceiveThrottle(0.04, lambda: self.now_s, self._sleep)
        self._take = nap.after_each(self.got.append)

    def _sleep(self, seconds: float) -> None:
        self.slept_s.append(seconds)
        self.now_s += seconds

    def receive(self, sample: str, after_s: float) -> None:
        self.now_s += after_s
        self._take(sample)


def test_a_message_that_finds_the_thread_idle_is_taken_at_once_and_slept_after() -> None:
    thread = Thread()
    thread.receive("one", after_s=0.01)
    assert (thread.got, thread.slept_s) == (["one"], [0.04])


def test_what_has_gathered_meanwhile_is_taken_without_a_nap_between() -> None:
    thread = Thread()
    for sample, after_s in (("one", 0.01), ("two", 0.0001), ("three", 0.0001)):
        thread.receive(sample, after_s)
    assert (thread.got, thread.slept_s) == (["one", "two", "three"], [0.04])


def test_a_flood_finds_a_thread_that_never_sleeps() -> None:
    thread = Thread()
    for _ in range(1000):
        thread.receive("more", after_s=0.0002)
    assert thread.slept_s == []


def test_320_messages_a_second_wake_the_thread_50_times() -> None:
    thread, began_s, wakes = Thread(), 100.0, 0
    for i in range(320):  # a second's messages, evenly
        due_s = began_s + i / 320
        waits = max(0.0, due_s - thread.now_s)
        wakes += waits > 0
        thread.receive("one", after_s=waits)
    assert len(thread.slept_s) + wakes == 50  # of each 13 messages, one; and the end of its nap
