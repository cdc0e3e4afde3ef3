"""Log records on the bus. A failure to publish costs the record and nothing else."""

import asyncio
import logging
import threading
from collections.abc import Iterator

import msgspec
import numpy as np
import pytest

from gigabrain_schemas.safety import LogRecord
from gigabrain_zenoh import logs
from gigabrain_zenoh.errors import BusError


@pytest.fixture
def quiet() -> Iterator[logging.Logger]:
    logger = logging.getLogger("bus.test")
    logger.setLevel(logging.DEBUG)
    logger.propagate = False
    yield logger
    logger.handlers.clear()


async def test_the_bus_gets_records_from_info_up_as_valid_messages(quiet: logging.Logger) -> None:
    sent: list[LogRecord] = []
    quiet.addHandler(logs.BusHandler(sent.append, "driver"))
    quiet.debug("not this")
    quiet.info("ready to drive", extra={"data": {"event": "ready", "port": np.int64(7447)}})
    assert [msgspec.structs.replace(record, stamp_ns=0) for record in sent] == [
        LogRecord(
            process="driver",
            level="info",
            event="ready",
            text="ready to drive",
            data={"port": "7447"},
        )
    ]


async def test_a_record_on_the_bus_has_the_time_of_its_line_in_the_file(
    quiet: logging.Logger,
) -> None:
    sent: list[LogRecord] = []
    record = quiet.makeRecord("bus.test", logging.INFO, "", 0, "ready to drive", (), None)
    logs.BusHandler(sent.append, "driver").emit(record)
    assert sent[0].stamp_ns == logs.fields(record, "driver")["t"] > 0


async def test_the_bus_gets_the_gist_of_a_record_of_any_size(quiet: logging.Logger) -> None:
    sent: list[LogRecord] = []
    quiet.addHandler(logs.BusHandler(sent.append, "driver"))
    try:
        raise ValueError("y" * 9000)
    except ValueError:
        data = {f"k{i}" * 99: "\udc80" * 999 for i in range(99)}
        quiet.exception("x" * 9000, extra={"data": data | {"event": "e" * 99}})
    payload = msgspec.msgpack.encode(sent[0])
    assert len(payload) < 16_384
    assert msgspec.msgpack.decode(payload, type=LogRecord) == sent[0]


async def test_publishing_that_logs_does_not_log_itself(quiet: logging.Logger) -> None:
    sent: list[str] = []

    def publish(record: LogRecord) -> None:
        sent.append(record.text)
        quiet.warning("published %s", record.text)

    quiet.addHandler(logs.BusHandler(publish, "driver"))
    quiet.info("one")
    quiet.info("two")
    thread = threading.Thread(target=quiet.info, args=("three",))
    thread.start()
    thread.join()
    await asyncio.sleep(0)
    assert sent == ["one", "two", "three"]


async def test_another_threads_record_is_published_on_the_loops_thread(
    quiet: logging.Logger,
) -> None:
    threads: list[int] = []
    handler = logs.BusHandler(lambda _: threads.append(threading.get_ident()), "driver")
    quiet.addHandler(handler)
    thread = threading.Thread(target=quiet.info, args=("from physics",))
    thread.start()
    thread.join()
    await asyncio.sleep(0)
    assert threads == [threading.get_ident()]


async def test_a_bus_that_is_gone_costs_the_record_and_nothing_else(quiet: logging.Logger) -> None:
    def publish(_: LogRecord) -> None:
        raise BusError("closed")

    handler = logs.BusHandler(publish, "driver")
    quiet.addHandler(handler)
    quiet.info("one")
    quiet.info("two")
    assert handler.lost == 2


def test_a_record_after_the_loop_is_closed_is_dropped(quiet: logging.Logger) -> None:
    async def make() -> logs.BusHandler:
        return logs.BusHandler(print, "driver")

    handler = asyncio.run(make())
    quiet.addHandler(handler)
    thread = threading.Thread(target=quiet.info, args=("late",))
    thread.start()
    thread.join()
    assert handler.lost == 1
