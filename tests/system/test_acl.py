"""Rights of each role to publish, query and reply: on a real router, over TLS, for each key."""

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
import zenoh

from gigabrain_schemas.topics import ESTOP_TOPIC, SERVICES, TELEOP, TOPICS
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.security.authority import issue
from gigabrain_zenoh.testing.processes import SampleCollector, repeat
from tests.system.keys import Site, make_fleet, raw, site

MAY_PUBLISH = {
    "brain": "world perceived/perception detections labels/perception objects solids pose map "
    "zones intent task arm_plan request_log input_log/perception health/perception log estop",
    "operator": "teleop joint_teleop cmd_vel joint_cmd button log estop",
    "viewer": "",
}
MAY_QUERY = {
    "brain": "estop describe/driver",
    "operator": "estop release enable goal mission task_change map_save map_list map_load "
    "zones_change pose_set objects_change sim_change limp audit_log param/driver describe/driver",
    "viewer": "map_list audit_log describe/driver",
}
PUBLISHED_KEYS = [topic.at("perception") for topic in (*TOPICS, ESTOP_TOPIC)]
QUERIED_KEYS = [service.at("driver") for service in SERVICES]


@pytest.fixture
async def net(fleet: Path) -> AsyncIterator[Site]:
    async with site(fleet) as made:
        yield made


async def answer(_: bytes) -> tuple[bytes, str]:
    return b"answered", ""


async def ask(session: zenoh.Session, key: str, payload: bytes = b"") -> list[bytes]:
    def get() -> list[bytes]:
        replies = session.get(key, payload=payload, timeout=5.0)
        return [reply.ok.payload.to_bytes() for reply in replies if reply.ok]

    return await asyncio.to_thread(get)


async def query_until_answered(session: zenoh.Session, key: str) -> None:
    async with asyncio.timeout(30):
        while not await ask(session, key):
            pass


async def keys_received(
    net: Site, ear: SampleCollector, session: zenoh.Session, keys: list[str], known: set[str]
) -> set[str]:
    """Let a session publish each key; return the keys that arrive, once the `known` ones do.

    Another session publishes afterwards, and its message arrives last.
    """
    payload_of_session, last_payload = (
        str(session.zid()).encode(),
        f"after {session.zid()}".encode(),
    )

    def publish_all() -> None:
        for key in keys:
            session.put(f"red/{key}", payload_of_session)

    def arrived() -> set[str]:
        return {key for key, payload in ear.samples if payload == payload_of_session}

    await repeat(publish_all, lambda: arrived() >= known)
    publish_all()
    await query_until_answered(session, "red/robot/describe/driver")
    last = net.raw("brain@red")
    await repeat(
        lambda: last.put("red/robot/world", last_payload), lambda: last_payload in ear.payloads
    )
    return arrived()


async def test_each_role_can_publish_only_its_own_topics(net: Site) -> None:
    robot = await net.client("robot@red", "red")
    robot.serve("robot/describe/driver", answer)
    ear = SampleCollector(robot, "robot/**")
    for role, expected in MAY_PUBLISH.items():
        session = net.raw(f"{role}@red")
        may = {f"robot/{name}" for name in expected.split()}
        await query_until_answered(session, "red/robot/describe/driver")
        assert await keys_received(net, ear, session, PUBLISHED_KEYS, may) == may


async def test_each_role_can_query_only_its_own_services(net: Site) -> None:
    robot = await net.client("robot@red", "red")
    for key in QUERIED_KEYS:
        robot.serve(key, answer)
    for role, expected in MAY_QUERY.items():
        session = net.raw(f"{role}@red")
        await query_until_answered(session, "red/robot/describe/driver")  # declared last
        answered = {key for key in QUERIED_KEYS if await ask(session, f"red/{key}")}
        assert answered == {f"robot/{name}" for name in expected.split()}


async def test_a_users_process_can_publish_and_query_only_what_it_declares(
    net: Site,
) -> None:
    robot = await net.client("robot@red", "red")
    mine = net.raw("process.mine@red")
    ear = SampleCollector(robot, "robot/**")
    own = ["robot/lamp/on", "robot/health/mine"]
    published, declared = [*PUBLISHED_KEYS, *own], {"robot/intent", "robot/log", *own}
    for key in [*QUERIED_KEYS, "robot/lamp/ask"]:
        robot.serve(key, answer)

    await query_until_answered(mine, "red/robot/lamp/ask")  # declared last
    assert await keys_received(net, ear, mine, published, declared) == declared
    answered = {key for key in QUERIED_KEYS if await ask(mine, f"red/{key}")}
    assert answered == {"robot/goal", "robot/describe/driver"}


async def test_a_users_process_reads_all_of_its_robot_and_replies_only_for_itself(
    net: Site,
) -> None:
    red, blue = await net.client("robot@red", "red"), await net.client("robot@blue", "blue")
    mine = await net.client("process.mine@red", "red")
    ear = SampleCollector(mine, "robot/**")
    for key in ("robot/estop", "robot/describe/driver", "robot/describe/mine"):
        mine.serve(key, answer)

    def send() -> None:
        for publish in (red.publish, blue.publish):
            for topic in TOPICS:
                publish(topic, topic.at("driver"), b"x", "")

    wanted = {topic.at("driver") for topic in TOPICS}
    await repeat(send, lambda: {key for key, _ in ear.samples} >= wanted)
    assert len({key for key, _ in ear.samples}) == len(wanted)
    operator = net.raw("operator@red")
    await query_until_answered(operator, "red/robot/describe/mine")
    assert await ask(operator, "red/robot/estop") == []
    assert await ask(operator, "red/robot/describe/driver") == []


FLEET_TOPICS = ("tf", "battery_state", "navigate_to_pose/_action/feedback")
FLEET_SERVICES = [f"navigate_to_pose/_action/{name}" for name in ("send_goal", "get_result")]


@pytest.mark.parametrize("who", ["dispatcher", "dispatcher@red"])
async def test_the_open_rmf_adapter_can_use_only_the_keys_of_free_fleet(
    net: Site, who: str
) -> None:
    robot, gateway = [await net.client(one, "red") for one in ("robot@red", "process.ros2@red")]
    rmf, received = net.raw(who), set[str]()
    wanted = {f"red/{key}" for key in FLEET_TOPICS}
    for key in ("**", *wanted):
        rmf.declare_subscriber(key, lambda sample: received.add(str(sample.key_expr)))
    for key in QUERIED_KEYS:
        robot.serve(key, answer)
    for key in FLEET_SERVICES:
        gateway.serve(key, answer)

    def send() -> None:
        for topic in TOPICS:
            robot.publish(topic, topic.at("driver"), b"x", "")
        for key in FLEET_TOPICS:
            gateway.publish(TELEOP, key, b"x", "")

    await repeat(send, lambda: received >= wanted)
    for key in FLEET_SERVICES:
        await query_until_answered(rmf, f"red/{key}")
    assert [key for key in QUERIED_KEYS if await ask(rmf, f"red/{key}")] == []
    assert received == wanted
    ears = [SampleCollector(robot, key) for key in ("tf", "robot/teleop")]
    await repeat(send, lambda: all(ear.samples for ear in ears))
    for key in ("tf", "robot/teleop"):
        rmf.put(f"red/{key}", b"forged")
    await query_until_answered(rmf, f"red/{FLEET_SERVICES[0]}")  # arrives after its forged messages
    count = len(ears[0].samples)
    await repeat(send, lambda: len(ears[0].samples) > count + 1)
    assert not any(b"forged" in ear.payloads for ear in ears)


async def test_only_open_rmf_can_query_the_goal_services_of_free_fleet(net: Site) -> None:
    gateway = await net.client("process.ros2@red", "red")
    for key in FLEET_SERVICES:
        gateway.serve(key, answer)
    await query_until_answered(net.raw("dispatcher@red"), f"red/{FLEET_SERVICES[-1]}")
    for who in ("brain@red", "operator@red", "operator", "viewer@red", "process.mine@red"):
        assert await ask(net.raw(who), f"red/{FLEET_SERVICES[-1]}") == [], who


async def test_only_the_robot_can_reply_for_its_gate(net: Site) -> None:
    for role in ("brain", "operator", "viewer"):
        (await net.client(f"{role}@red", "red")).serve("robot/estop", answer)
    brain = await net.client("brain@red", "red")
    brain.serve("robot/goal", answer)
    operator = net.raw("operator@red")
    await query_until_answered(operator, "red/robot/goal")  # declared last
    assert await ask(operator, "red/robot/estop") == []


async def test_a_viewer_reads_all_of_its_robot_and_nothing_of_another(net: Site) -> None:
    red, blue = await net.client("robot@red", "red"), await net.client("robot@blue", "blue")
    received: list[str] = []
    viewer, fleet = net.raw("viewer@red"), net.raw("operator")
    for key in ("red/robot/**", "blue/robot/**", "**"):
        viewer.declare_subscriber(key, lambda sample: received.append(str(sample.key_expr)))
    of_all: list[str] = []
    fleet.declare_subscriber("*/robot/scan", lambda sample: of_all.append(str(sample.key_expr)))
    sends = [red.publish, blue.publish]

    def send() -> None:
        for publish in sends:
            for topic in TOPICS:
                publish(topic, topic.at("driver"), b"x", "")

    wanted = {f"red/{topic.at('driver')}" for topic in TOPICS}
    await repeat(send, lambda: set(received) >= wanted and len(set(of_all)) == 2)
    assert set(received) == wanted
    assert set(of_all) == {"red/robot/scan", "blue/robot/scan"}


async def test_a_hostile_robot_of_the_fleet_cannot_affect_another_robot(net: Site) -> None:
    """None of 10,000 commands and forged states arrives; blue can still publish its own topics."""
    red = await net.client("robot@red", "red")
    red.serve("robot/estop", answer)
    red.serve("robot/enable", answer)
    red_ear, viewer_ear = (
        SampleCollector(red, "robot/**"),
        SampleCollector(await net.client("viewer@red", "red"), "robot/**"),
    )
    blue_ear = SampleCollector(await net.client("robot@blue", "blue"), "robot/**")
    blue = net.raw("robot@blue")
    commands = [blue.declare_publisher(f"red/robot/{key}") for key in ("cmd_vel", "teleop")]
    for i in range(5000):
        for publisher in commands:
            publisher.put(i.to_bytes(4, "big"), encoding="application/msgpack;gigabrain.CmdVel")
        blue.put("red/robot/state", b"forged")
        blue.put("*/robot/cmd_vel", b"wild")
        if i % 500 == 0:
            await asyncio.sleep(0)
    assert await ask(blue, "red/robot/estop") == []
    assert await ask(blue, "red/robot/enable") == []
    assert await ask(blue, "*/robot/enable") == []
    await repeat(lambda: blue.put("blue/robot/cmd_vel", b"own"), lambda: blue_ear.samples)
    assert red_ear.samples == viewer_ear.samples == []


async def test_a_robot_unknown_to_the_router_can_neither_read_nor_publish(net: Site) -> None:
    red = await net.client("robot@red", "red")
    red.serve("robot/describe/driver", answer)
    ear, received = (
        SampleCollector(await net.client("operator@red", "red"), "robot/**"),
        list[str](),
    )
    green = net.raw("robot@green")
    green.declare_subscriber(
        "**",
        lambda sample: received.append(str(sample.key_expr)),
        allowed_origin=zenoh.Locality.REMOTE,  # without its own messages
    )
    green.put("red/robot/cmd_vel", b"x")
    assert await ask(green, "red/robot/describe/driver") == []
    green.put("green/robot/cmd_vel", b"x")
    topic = TOPICS[0]
    await repeat(lambda: red.publish(topic, "robot/scan", b"x", ""), lambda: ear.samples)
    assert {key for key, _ in ear.samples} == {"robot/scan"}
    assert received == []


async def test_no_role_can_read_the_admin_space_of_the_router(net: Site) -> None:
    for name in ("robot@red", "operator", "robot@green"):
        session = net.raw(name)
        router = str(session.info.routers_zid()[0])
        replies = await asyncio.to_thread(lambda s=session: list(s.get("@/**", timeout=5.0)))
        keys = [str(reply.ok.key_expr) for reply in replies if reply.ok]
        assert not [key for key in keys if key.startswith(f"@/{router}/")]


async def test_sessions_without_keys_of_this_fleet_are_refused(net: Site, tmp_path: Path) -> None:
    strangers = make_fleet(tmp_path / "other", "home")  # a fleet of another authority
    mixed = issue(strangers, "operator", name="mixed")  # but it trusts our authority
    (mixed / "ca.crt").write_bytes((net.fleet / "ca.crt").read_bytes())
    for keys in (str(strangers / "operator"), str(mixed), ""):
        with pytest.raises(zenoh.ZError), raw(Endpoint(connect=(net.address,), keys=keys)):
            pass
