"""Writing behind the loop: whoever waits hears how it went, whatever happens."""

from collections.abc import Sequence

from gigabrain_zenoh.host.threads import BackgroundWriter


async def test_who_waits_hears_of_any_exception_and_the_next_is_written() -> None:
    written: list[Sequence[int]] = []

    def write(items: Sequence[int]) -> str:
        if 1 in items:
            raise ValueError("cannot encode that")
        written.append(items)
        return ""

    writer = BackgroundWriter(write, room=4)
    assert await writer.put(1) == "ValueError: cannot encode that"
    assert await writer.put(2) == ""
    assert written == [(2,)]
    await writer.close()
