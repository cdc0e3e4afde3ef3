"""`gigabrain topic pub`: builds a message from typed words, and publishes it or drives by it."""

import asyncio
import re
from collections.abc import Sequence
from typing import Any, TypeVar

import msgspec

from gigabrain_schemas.base import TICK_S, Message
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.topics import CMD_VEL, Topic
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.client.connection import connect
from gigabrain_zenoh.client.robot import Robot
from gigabrain_zenoh.config.name_words import plain
from gigabrain_zenoh.diagnostics.discovery import PREFIX, short_name, unknown_topic
from gigabrain_zenoh.errors import ConfigError, Refused, unknown
from gigabrain_zenoh.gate.gate import BRAIN
from gigabrain_zenoh.host.signals import run_until, stop_signals
from gigabrain_zenoh.host.this_process import user_name
from gigabrain_zenoh.runtime.connect import Where

M = TypeVar("M", bound=Message)
NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
DISCOVERY_S = 0.5  # for the discovery of subscribers, before the first message


def parse_message(topic: Topic[M], words: Sequence[str]) -> M:
    """Build a message from a JSON object, or from words such as `linear_x=0.1 pose.x=2`.

    Raises ConfigError, and UnknownName for a field.
    """
    if len(words) == 1 and words[0].lstrip().startswith("{"):
        try:
            values = msgspec.json.decode(words[0])
        except msgspec.DecodeError as error:
            raise ConfigError(f"not JSON: {error}") from None
    else:
        values = _tree(words)
    known = {field.name for field in msgspec.structs.fields(topic.type)}
    for name in values:
        if name not in known:
            raise unknown(f"field of {topic.type.__name__}", name, known)
    try:
        return msgspec.convert(values, topic.type)
    except msgspec.ValidationError as error:
        raise ConfigError(f"not a valid {topic.type.__name__}: {plain(error)}") from None


def _tree(words: Sequence[str]) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for word in words:
        path, equals, text = word.partition("=")
        if not equals or not path:
            raise ConfigError(f"{word!r}: expected field=value, or one JSON object")
        *parents, name = path.split(".")
        here = tree
        for parent in parents:
            here = here.setdefault(parent, {})
            if not isinstance(here, dict):
                raise ConfigError(f"{word!r}: {parent} already has a value")
        here[name] = _value(text)
    return tree


def _value(text: str) -> Any:
    """Parse a number or a JSON value; return any other text unchanged. Raises ConfigError."""
    if NUMBER.fullmatch(text):
        return int(text) if re.fullmatch(r"[-+]?\d+", text) else float(text)
    if text in ("true", "false", "null") or text[:1] in '[{"':
        try:
            return msgspec.json.decode(text)
        except msgspec.DecodeError as error:
            raise ConfigError(f"{text!r}: {error}") from None
    return text


async def publish(
    bus: Bus,
    topic: Topic[Any],
    message: Message,
    rate: float | None,
    count: int | None,
    name: str = "",
) -> int:
    """Publish a message once, `count` times, or at `rate` [Hz] until Ctrl-C; return the count."""
    wanted = count if count is not None else (None if rate else 1)
    sent = 0
    with stop_signals() as stop:
        await asyncio.sleep(DISCOVERY_S)
        async for _ in bus.clock.every(round(1e9 / (rate or 10.0))):
            if stop.is_set() or wanted == sent:
                break
            bus.publish(topic, message, name=name)
            sent += 1
        await bus.clock.sleep_ns(50_000_000)  # lets the last message leave
    return sent


async def drive(
    where: Where, name: str, words: Sequence[str], seconds: float | None, *, take: bool
) -> str:
    """Drive with a velocity of cmd_vel or the body's control topic; return the result as text.

    Raises UnknownName for any other topic, ConfigError and Refused.
    """
    command = parse_message(CMD_VEL, words)
    async with connect(
        where.connect,
        namespace=where.namespace,
        keys=where.keys,
        source=command.source or f"{user_name()}-pub",
        take=take,
    ) as robot:
        control_topic = (await robot.read_body()).control_topic
        if PREFIX + short_name(name) not in (CMD_VEL.key, control_topic) and name != control_topic:
            raise unknown_topic(name, (control_topic,))
        return await hold_velocity(robot, command, seconds, take=take)


async def hold_velocity(robot: Robot, command: CmdVel, seconds: float | None, *, take: bool) -> str:
    """Hold a velocity for `seconds` of the robot's time, or until Ctrl-C; return the result.

    Asks the gate for the body before, and returns it to the brain afterwards. Raises Refused.
    """
    before = (await robot.read_state()).gate
    if before.mode == "enabled" and not take:
        raise Refused(f"{before.commander} drives; take over with --take")
    await robot.enable(take=take)
    start_tick = (await robot.read_state()).tick
    try:
        with stop_signals() as stop:
            await run_until(stop, _send_velocity(robot, command, seconds))
    finally:
        await robot.stop()
    ticks = (await robot.read_state()).tick - start_tick
    return f"driven for {ticks * TICK_S:.1f} s; {await _return_body(robot, before.commander)}"


async def _send_velocity(robot: Robot, command: CmdVel, seconds: float | None) -> None:
    start = (await robot.read_state()).tick
    while seconds is None or (await robot.read_state()).tick - start < seconds * 50:
        await robot.set_base_velocity(command.linear_x, command.linear_y, command.angular_z)
        await asyncio.sleep(0.1)


async def _return_body(robot: Robot, commander: str) -> str:
    """Enable the brain again if it drove before; otherwise the gate becomes idle by itself."""
    if commander != BRAIN:
        return "the robot is idle now"
    try:
        return (await robot.enable(BRAIN, take=True)).text
    except Refused as error:
        return f"the brain does not drive again: {error}"
