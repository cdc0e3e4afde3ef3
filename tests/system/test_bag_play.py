"""Playing a recording: completely, in time, and harmlessly beside a robot."""

import asyncio
from pathlib import Path
from types import SimpleNamespace

import pytest
from msgspec.structs import replace

from gigabrain_schemas.examples import example
from gigabrain_schemas.requests import DescribeRequest, EnableRequest, ReleaseRequest
from gigabrain_schemas.topics import CMD_VEL, DESCRIBE, ENABLE, MAP, RELEASE, TELEOP
from gigabrain_zenoh import codec
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.cli.app import make_app
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.errors import ConfigError, Refused
from gigabrain_zenoh.recording import player
from gigabrain_zenoh.recording.bag_reader import Bag
from gigabrain_zenoh.recording.bag_writer import BagWriter
from gigabrain_zenoh.recording.player import Player, PlayOptions, check_no_driver
from gigabrain_zenoh.testing.in_memory import Net, RobotInMemory
from gigabrain_zenoh.testing.processes import repeat, robot
from gigabrain_zenoh.testing.waiting import until
from tests.unit.recording import bags

pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording of 2 s: a map at the start, states and scans."""
    path = tmp_path_factory.mktemp("bag") / "drive.mcap"
    grid = bags.arrival(1, "robot/map", codec.encode(example(MAP.type)))
    assert bags.write(path, iter([grid, *bags.drive(100)])) == 121
    return path


@pytest.mark.parametrize("rate", [1.0, 2.0])
async def test_playing_drops_no_message(drive: Path, rate: float) -> None:
    async with robot() as network:
        await network.router()
        ear, mouth = await network.client(), await network.client()
        received: list[tuple[str, str, bytes]] = []
        ear.tap("robot/**", lambda *sample: received.append(sample))
        await repeat(lambda: mouth.publish(TELEOP, TELEOP.key, b"", ""), lambda: received)
        player = Player(drive, PlayOptions(rate=rate), mouth)
        await player.play()
        await until(lambda: sum(key != TELEOP.key for key, _, _ in received) == 121)
    assert player.sent == 121
    others = (TELEOP.key, "robot/map")
    assert [(key, encoding, data) for key, encoding, data in received if key not in others] == [
        (s.key, s.encoding, s.payload) for s in Bag(drive) if s.key not in others
    ]


async def test_from_the_middle_the_map_comes_first_and_late_joiners_get_it(drive: Path) -> None:
    network = LocalNetwork()
    player = Player(drive, PlayOptions(rate=100.0, start_s=1.0), network.transport())
    await player.play()
    keys = [key for key, _ in network.sent]
    assert sorted(keys[:2]) == ["robot/map", "robot/state"]  # the newest kept messages
    assert keys[2:].count("robot/state") == 50
    assert keys.count("robot/scan") == 11
    late = Bus(network.transport(), Clock())
    assert await late.kept(MAP) == [codec.encode(example(MAP.type))]
    await late.close()


async def test_playing_can_loop_choose_topics_and_remap_keys(drive: Path) -> None:
    network = LocalNetwork()
    remap = {"robot/scan": "old/scan"}
    options = PlayOptions(rate=100.0, loop=True, topics=("scan",), remap=remap)
    playing = asyncio.ensure_future(Player(drive, options, network.transport()).play())
    await until(lambda: len(network.sent) > 45)
    playing.cancel()
    await asyncio.wait((playing,))
    assert {key for key, _ in network.sent} == {"old/scan"}
    assert network.sent[0] == network.sent[20]


async def test_each_round_of_a_loop_equals_the_first(tmp_path: Path) -> None:
    path, grid = tmp_path / "maps.mcap", example(MAP.type)
    maps = [codec.encode(replace(grid, seq=seq)) for seq in (1, 2)]
    expected = [("robot/scan", bags.scan(1)), *(("robot/map", each) for each in maps)]
    bags.write(path, (bags.arrival(n * 10**9, *each) for n, each in enumerate(expected)))
    network = LocalNetwork()
    options = PlayOptions(rate=100.0, loop=True)
    playing = asyncio.ensure_future(Player(path, options, network.transport()).play())
    await until(lambda: len(network.sent) >= 6)
    playing.cancel()
    await asyncio.wait((playing,))
    assert network.sent[:6] == expected * 2


async def test_a_loop_over_a_single_message_pauses_between_rounds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pauses: list[float] = []
    sleep = asyncio.sleep

    async def note(seconds: float) -> None:
        pauses.append(seconds)
        await sleep(0)

    monkeypatch.setattr(asyncio, "sleep", note)
    monkeypatch.setattr(player, "time", SimpleNamespace(monotonic=lambda: 0.0))
    path, network = tmp_path / "map.mcap", LocalNetwork()
    bags.write(path, iter([bags.arrival(1, "robot/map", codec.encode(example(MAP.type)))]))
    looped = Player(path, PlayOptions(rate=2.0, loop=True), network.transport())
    playing = asyncio.ensure_future(looped.play())
    while looped.sent < 20:
        await sleep(0)
    playing.cancel()
    await asyncio.wait((playing,))
    assert pauses.count(0.05) >= 19


async def test_messages_appended_during_playing_are_not_played(tmp_path: Path) -> None:
    network, file = LocalNetwork(), BagWriter(tmp_path / "a.mcap", viewers=False, notes={})
    growing = Player(file.path, PlayOptions(rate=100.0), network.transport())

    def append(key: str, payload: bytes) -> None:
        file.add(bags.arrival(len(network.sent), key, payload))
        file.flush()

    append("robot/state", bags.state(1))
    playing = asyncio.ensure_future(growing.play())
    await asyncio.sleep(0)  # the file is read; playing waits for subscribers
    append("robot/state", bags.state(2))
    append("robot/scan", bags.scan(1))
    await playing
    file.close()
    assert network.sent == [("robot/state", bags.state(1))]


async def test_playing_keeps_the_timing_of_the_recording(drive: Path) -> None:
    network = LocalNetwork()
    loop = asyncio.get_running_loop()
    began_s = loop.time()
    await Player(drive, PlayOptions(rate=4.0), network.transport()).play()
    assert loop.time() - began_s >= 2.0 / 4.0


async def test_playing_beside_a_running_driver_is_refused() -> None:
    net = Net()
    await check_no_driver(net.one)

    async def describe(_: DescribeRequest) -> object:
        return example(DESCRIBE.reply)

    net.two.serve(DESCRIBE, describe, name="driver")  # type: ignore[arg-type]
    with pytest.raises(Refused, match=r"a driver runs on this bus \(pid 4710\): "):
        await check_no_driver(net.one)
    await net.one.close()
    await net.two.close()


async def test_played_commands_do_not_move_a_running_robot(tmp_path: Path) -> None:
    async with RobotInMemory(tmp_path / "state", resume="manual") as living:
        await living.go(50)
        assert living.state
        path = tmp_path / "commands.mcap"
        file = BagWriter(path, viewers=False, notes={})
        for seq in range(1, 101):  # valid except for their boot, an earlier one
            command = CMD_VEL.type(
                linear_x=0.2, source="script", seq=seq,
                boot=living.state.boot ^ 1, tick=living.state.tick + seq // 2,
                basis=living.state.tick + seq // 2,
            )  # fmt: skip
            file.add(bags.arrival(seq * 10_000_000, CMD_VEL.key, codec.encode(command)))
        file.finish()
        file.close()
        generation = living.state.gate.estop_generation
        await living.operator.ask(RELEASE, ReleaseRequest(estop_generation=generation))
        (reply,) = await living.operator.ask(ENABLE, EnableRequest(source="script", take=True))
        assert reply.ok
        player = Player(path, PlayOptions(rate=100.0), living.network.transport())
        playing = asyncio.ensure_future(player.play())
        speeds: list[float] = []
        while not playing.done():
            await asyncio.sleep(0.001)
            if player.sent:
                speeds += await living.go(1)
        assert player.sent == 100
        assert max(map(abs, speeds)) == 0.0
        assert living.counters["refused_boot"] == 100


async def test_an_empty_bag_and_bad_options_are_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "empty.mcap"
    bags.write(path, iter(()))
    with pytest.raises(ConfigError, match="holds no message to play"):
        await Player(path, PlayOptions(), LocalNetwork().transport()).play()


@pytest.mark.parametrize(
    ("topics", "length"),
    [((), r"the recording has 2\.001 s$"), (("map",), "the recording has 0 s of these topics$")],
)
async def test_a_start_behind_the_end_is_refused(
    drive: Path, topics: tuple[str, ...], length: str
) -> None:
    options = PlayOptions(start_s=2.1, topics=topics)
    with pytest.raises(ConfigError, match=f"--start: {length}"):
        await Player(drive, options, LocalNetwork().transport()).play()


@pytest.mark.parametrize(
    ("option", "complaint"),
    [
        (("--rate", "0"), "--rate: expected a number from 0.01 to 100, got 0"),
        (("--start", "nan"), "--start: expected a number, got nan"),
        (("--remap", "a"), "--remap: expected old/key=new/key, got 'a'"),
        (("--remap", "a=b*"), "--remap: expected old/key=new/key, got 'a=b*'"),
        (("--remap", "a=/b"), "expected a key expression, got '/b'"),
        (("--remap", "a="), "expected a key expression, got ''"),
    ],
)
def test_options_are_checked_before_anything_is_sent(
    drive: Path, option: tuple[str, str], complaint: str
) -> None:
    command = ("bag", "play", str(drive), *option)
    with pytest.raises(ConfigError) as error:
        make_app(command)(
            command, exit_on_error=False, print_error=False, result_action="return_value"
        )
    assert str(error.value).startswith(complaint)


async def test_a_remapped_key_that_is_not_played_is_refused(drive: Path) -> None:
    for key in ("scan", "robot/state"):
        options = PlayOptions(topics=("scan",), remap={key: "old/scan"})
        with pytest.raises(ConfigError, match=f"no key '{key}'.* known: robot/scan$"):
            await Player(drive, options, LocalNetwork().transport()).play()
