import asyncio

from gigabrain_zenoh.clock import Clock, FakeClock

MS = 1_000_000


async def ticks(clock: Clock, period_ns: int, seen: list[int]) -> None:
    async for now in clock.every(period_ns):
        seen.append(now)


async def test_sleepers_wake_in_the_order_in_which_they_are_due() -> None:
    clock, woken = FakeClock(), []

    async def sleeper(name: str, duration_ns: int) -> None:
        await clock.sleep_ns(duration_ns)
        woken.append((name, clock.now_ns()))

    tasks = [
        asyncio.ensure_future(sleeper(name, duration_ns))
        for name, duration_ns in (("c", 30), ("a", 10), ("b", 20), ("b2", 20), ("late", 41))
    ]
    await clock.advance(40)
    assert woken == [("a", 10), ("b", 20), ("b2", 20), ("c", 30)]
    assert clock.now_ns() == 40
    tasks[-1].cancel()
    await clock.advance(40)
    assert len(woken) == 4


async def test_a_period_yields_at_once_and_then_each_time() -> None:
    clock, seen = FakeClock(), list[int]()
    task = asyncio.ensure_future(ticks(clock, 20 * MS, seen))
    await clock.advance(60 * MS)
    task.cancel()
    assert seen == [0, 20 * MS, 40 * MS, 60 * MS]


async def test_missed_periods_are_skipped_and_the_others_stay_where_they_were() -> None:
    clock, seen = FakeClock(), list[int]()

    async def slow() -> None:
        async for now in clock.every(20 * MS):
            seen.append(now)
            if len(seen) == 2:
                await clock.sleep_ns(70 * MS)

    task = asyncio.ensure_future(slow())
    await clock.advance(130 * MS)
    task.cancel()
    assert seen == [0, 20 * MS, 90 * MS, 100 * MS, 120 * MS]


async def test_the_fake_calendar_goes_with_the_fake_clock() -> None:
    clock = FakeClock()
    await clock.advance(5)
    assert clock.unix_ns() == 1_000_000_000_000_000_005


async def test_the_real_clock_goes_forwards_while_it_sleeps() -> None:
    clock = Clock()
    before = clock.now_ns()
    await clock.sleep_ns(2 * MS)
    assert clock.now_ns() - before >= 1 * MS
    assert clock.unix_ns() > 1_700_000_000_000_000_000
    seen: list[int] = []
    async for now in clock.every(MS):
        seen.append(now)
        if len(seen) == 3:
            break
    assert seen == sorted(seen)
