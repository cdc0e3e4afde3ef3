"""Access to the operator page, steering by one viewer, and the queue of a slow browser."""

import socket
import stat
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from cryptography.hazmat.primitives import serialization

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import Body, GateMode, GateStatus
from gigabrain_schemas.brain import Twist
from gigabrain_schemas.examples import example
from gigabrain_schemas.requests import GateReply, LimpRequest
from gigabrain_schemas.topics import BODY, LIMP, STATE, TELEOP
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.client.requests import steer
from gigabrain_zenoh.config.settings import PageConfig
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.geometry.limits import ZERO
from gigabrain_zenoh.launch.demo import with_page
from gigabrain_zenoh.launch.deployment import Deployment
from gigabrain_zenoh.security.authority import read_key
from gigabrain_zenoh.testing.in_memory import Net
from gigabrain_zenoh.testing.samples import state
from gigabrain_zenoh.testing.waiting import settle
from gigabrain_zenoh.ui.page.access import Access, check, tokens
from gigabrain_zenoh.ui.page.frames import GoalRequest, PageRequest, PageView
from gigabrain_zenoh.ui.page.node import free_port
from gigabrain_zenoh.ui.page.server import run
from gigabrain_zenoh.ui.page.sessions import RequestHandler, Viewer
from gigabrain_zenoh.ui.steering import RateLimiter, TeleopArbiter


def test_tokens_are_created_once_and_readable_only_by_their_owner(tmp_path: Path) -> None:
    path = tmp_path / "page" / "tokens.json"
    created, is_new = tokens(path)
    assert is_new
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert tokens(path) == (created, False)
    path.chmod(0o644)
    with pytest.raises(ConfigError, match="open to others"):
        tokens(path)
    path.chmod(0o600)
    path.write_text('{"operator": "short", "viewer": "short"}')
    with pytest.raises(ConfigError, match="tokens of 16 characters"):
        tokens(path)


def test_processes_that_create_tokens_at_the_same_time_get_the_same_ones(tmp_path: Path) -> None:
    for number, start in enumerate(("none", "none", "empty", "empty")):
        path = tmp_path / f"tokens-{number}.json"
        if start == "empty":
            path.touch(0o600)
        with ThreadPoolExecutor(16) as pool:
            found = list(pool.map(lambda _, path=path: tokens(path), range(32)))  # type: ignore[misc]
        assert len({both for both, _ in found}) == 1
        assert [is_new for _, is_new in found].count(True) == 1
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert len(list(tmp_path.iterdir())) == 4


def test_a_crash_before_the_tokens_are_written_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "tokens.json"
    monkeypatch.setattr("os.fsync", lambda _: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        tokens(path)
    assert list(tmp_path.iterdir()) == []


def test_tokens_are_read_from_a_folder_that_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "tokens.json"
    created, _ = tokens(path)
    read_only = OSError(30, "Read-only file system")
    monkeypatch.setattr("tempfile.NamedTemporaryFile", lambda **_: (_ for _ in ()).throw(read_only))
    assert tokens(path) == (created, False)
    with pytest.raises(ConfigError, match=r"other\.json: the disk is read-only"):
        tokens(tmp_path / "other.json")


def test_an_empty_file_of_tokens_is_replaced_with_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "tokens.json"
    path.touch(0o600)
    created, is_new = tokens(path)
    assert is_new
    assert tokens(path) == (created, False)
    assert caplog.messages == [f"{path} was empty; replaced it"]


async def test_a_page_that_cannot_be_served_makes_no_tokens(tmp_path: Path) -> None:
    path = tmp_path / "tokens.json"
    with socket.create_server(("127.0.0.1", 0)) as taken:
        config = PageConfig(port=taken.getsockname()[1], login=True, tokens=str(path))
        with pytest.raises(ConfigError, match="cannot listen on 127"):
            await run(config, Net().one, lambda: None)
    assert not path.exists()


async def test_a_certificate_that_cannot_be_served_is_refused_before_the_page_is_ready(
    fleet: Path, tmp_path: Path
) -> None:
    certificate, key = fleet / "ca.crt", fleet / "ca.key"
    secret = serialization.BestAvailableEncryption(b"secret")
    encrypted, text = tmp_path / "encrypted.key", tmp_path / "text.pem"
    encrypted.write_bytes(
        read_key(key).private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, secret
        )
    )
    text.write_text("no PEM")
    own = fleet / "operator/identity.key"
    for certificate_file, key_file, refused in (
        (text, key, f"{text} holds no certificate; "),
        (tmp_path, key, f"{tmp_path} holds no certificate; "),
        (certificate, text, f"{text} is no usable key of {certificate} "),
        (certificate, own, f"{own} is no usable key of {certificate} "),
        (certificate, encrypted, f"{encrypted} has a pass phrase; "),
    ):
        config = PageConfig(
            port=0, certificate=str(certificate_file), certificate_key=str(key_file)
        )
        with pytest.raises(ConfigError) as caught:
            await run(config, Net().one, lambda: pytest.fail("it is ready"))
        assert str(caught.value).startswith(f"page: {refused}")
    check(PageConfig(certificate=str(certificate), certificate_key=str(key)))


def test_new_tokens_are_printed_once(tmp_path: Path) -> None:
    config = PageConfig(login=True, tokens=str(tmp_path / "tokens.json"))
    first, second = Access(config, 8080), Access(config, 8080)
    created, _ = tokens(tmp_path / "tokens.json")
    assert (
        first.new_tokens_text()
        == f"to drive:     {created.operator}\nto view only: {created.viewer}"
    )
    assert second.new_tokens_text() == ""
    assert Access(PageConfig(), 8080).new_tokens_text() == ""


def test_a_page_for_the_network_requires_tls_and_a_token(tmp_path: Path) -> None:
    check(PageConfig())
    for listen in ("0.0.0.0", "192.168.1.10", "::"):
        with pytest.raises(ConfigError, match="can be reached from the network"):
            check(PageConfig(listen=listen))
    with pytest.raises(ConfigError, match="certificate_key, or neither"):
        check(PageConfig(certificate="cert.pem"))
    with pytest.raises(ConfigError, match="cannot read"):
        check(PageConfig(certificate="none.pem", certificate_key="none.key"))
    path = tmp_path / "tokens.json"
    access = Access(PageConfig(listen="192.168.1.10", tokens=str(path)), 8080)
    created, _ = tokens(path)
    assert [access.role(token) for token in (created.operator, created.viewer, "", "é")] == [
        "operator", "viewer", None, None,
    ]  # fmt: skip
    assert Access(PageConfig(), 8080).role("") == "operator"


@pytest.mark.parametrize(
    ("host", "origin", "named", "own"),
    [
        ("127.0.0.1:8080", "http://127.0.0.1:8080", True, True),
        ("LOCALHOST:8080", "http://localhost:8080", True, True),
        ("robot.lan:8080", "http://robot.lan:8080", True, True),
        ("127.0.0.1:8080", "http://localhost:8080", True, False),
        ("127.0.0.1:8080", "https://127.0.0.1:8080", True, False),
        ("127.0.0.1:8080", "null", True, False),
        ("127.0.0.1:8080", "", True, False),
        ("127.0.0.1:9090", "http://127.0.0.1:9090", True, True),  # by a tunnel
        ("[::1]:9090", "http://[::1]:9090", True, True),
        ("localhost", "http://localhost", True, True),
        ("localhost:9090", "http://localhost:3000", True, False),
        ("localhost:9090", "http://127.0.0.1:9090", True, False),
        ("localhost:8080", "http://localhost:9090", True, False),
        ("localhost:9090", "http://evil.example:9090", True, False),
        ("localhost.evil.example:9090", "http://localhost.evil.example:9090", False, False),
        ("localhost:9090:evil", "http://localhost:9090:evil", False, False),
        ("robot.lan:9090", "http://robot.lan:9090", False, False),
        ("evil.example:8080", "http://evil.example:8080", False, False),
        ("", "", False, False),
    ],
)
def test_it_accepts_only_its_own_names_and_its_own_pages(
    host: str, origin: str, named: bool, own: bool
) -> None:
    access = Access(PageConfig(names=("robot.lan",)), 8080)
    headers = {"host": host, "origin": origin}
    assert (access.named(headers), access.own_page(headers)) == (named, own)


@pytest.mark.parametrize(
    ("config", "port", "host"),
    [
        (PageConfig(names=("Robot.local",)), 8080, "robot.local:8080"),
        (PageConfig(names=("fd00::5",)), 8080, "[fd00::5]:8080"),
        (PageConfig(names=("[FD00:0::5]",)), 8080, "[fd00::5]:8080"),
        (PageConfig(listen="127.0.0.2"), 8080, "127.0.0.2:8080"),
        (PageConfig(listen="::1"), 8080, "[::1]:8080"),
        (PageConfig(), 80, "127.0.0.1"),
        (PageConfig(), 80, "localhost:80"),
    ],
)
def test_it_accepts_names_as_browsers_write_them(config: PageConfig, port: int, host: str) -> None:
    access = Access(config, port)
    assert access.own_page({"host": host, "origin": f"http://{host}"})
    assert not access.named({"host": f"x{host}"})


def test_a_page_for_the_network_refuses_loopback_names(tmp_path: Path) -> None:
    config = PageConfig(listen="192.168.1.10", tokens=str(tmp_path / "tokens.json"))
    assert not Access(config, 8080).named({"host": "localhost:8080"})


async def test_a_slow_browser_gets_the_newest_and_never_more_than_64_frames() -> None:
    viewer = Viewer(1, "viewer")
    for n in range(5):
        viewer.queue("state", b"%d" % n)
    viewer.queue("scan", b"scan")
    assert [await viewer.next_frame(), await viewer.next_frame()] == [b"4", b"scan"]
    for n in range(1000):
        viewer.queue(f"log/{n}", b"%d" % n)
    assert await viewer.next_frame() == b"936"


async def test_log_lines_displace_no_other_frames_of_a_slow_browser() -> None:
    viewer = Viewer(1, "viewer")
    once = [b"about", b"map", b"zones", b"reply/1"]
    for frame in once:
        viewer.queue(frame.decode(), frame)
    for n in range(100):
        viewer.queue(f"log/{n}", b"log %d" % n)
    viewer.queue("state", b"state")
    got = [await viewer.next_frame() for _ in range(64)]
    assert got == [*once, *(b"log %d" % n for n in range(41, 100)), b"state"]


def test_120_messages_a_second_are_processed_per_viewer() -> None:
    rates = RateLimiter()
    assert not any(rates.is_exceeded(1, 10.0 + n / 200) for n in range(120))
    assert rates.is_exceeded(1, 10.7)
    assert not rates.is_exceeded(2, 10.7)
    assert not rates.is_exceeded(1, 11.1)


class SteeredPage:
    """A page with two viewers and a Waffle. The test passes the time of each command."""

    def __init__(self, send: Callable[[str, bytes], None] = lambda _slot, _frame: None) -> None:
        self.net, self.steered = Net(), list[Twist]()
        self.scene = PageView(self.net.one, send)
        self.net.two.subscribe(TELEOP, lambda _key, twist: self.steered.append(twist))
        self.net.two.publish(
            BODY, Body(description=load_robot("turtlebot3_waffle").description(), link="sim")
        )
        self.arbiter = TeleopArbiter(self.scene)
        self.one, self.two = 1, 2

    @property
    def speeds(self) -> list[float]:
        return [twist.linear_x for twist in self.steered]


async def test_one_viewer_steers_until_it_releases_or_stops_sending() -> None:
    page = SteeredPage()
    await settle()
    fast, slow = Velocity(linear_x=9.0), Velocity(linear_x=0.1)
    assert page.arbiter.drive(page.one, fast, 0.0)
    assert page.arbiter.drive(page.one, fast, 0.1)
    assert not page.arbiter.drive(page.two, slow, 0.5)
    assert page.arbiter.drive(page.two, ZERO, 0.5)  # ignored, and ends no other stream
    assert page.arbiter.drive(page.two, slow, 0.7)
    assert page.arbiter.drive(page.two, slow, 0.8)
    page.arbiter.leave(page.one)
    assert page.arbiter.driving(0.8) == 2
    assert page.arbiter.drive(page.two, ZERO, 0.8)
    assert page.arbiter.driving(0.8) == 0
    page.arbiter.leave(page.one)
    await settle()
    assert page.speeds == [0.26, 0.1, 0.0]


async def test_a_stream_during_a_latch_steers_only_after_a_pause() -> None:
    page, ahead = SteeredPage(), Velocity(linear_x=0.1)

    async def held(*at_s: float, mode: GateMode) -> list[float]:
        page.net.two.publish(STATE, state(10, gate=GateStatus(mode=mode, commander="control")))
        await settle()
        page.steered.clear()
        for each in at_s:
            page.arbiter.drive(page.one, ahead, each)
        await settle()
        return page.speeds

    assert await held(0.0, 0.1, mode="enabled") == [0.1]
    assert await held(0.2, 0.3, mode="latched") == []
    assert await held(0.4, 0.5, 0.6, mode="enabled") == []
    page.arbiter.drive(page.one, ZERO, 0.65)  # released
    assert await held(0.7, 0.8, mode="enabled") == [0.1]
    assert await held(0.9, mode="latched") == []
    assert await held(1.2, 1.3, mode="enabled") == [0.1]


async def test_two_pages_with_the_same_name_are_two_sources() -> None:
    net, sources = Net(), list[str]()
    net.one.subscribe(TELEOP, lambda _key, twist: sources.append(twist.source))
    for bus in (net.two, Bus(net.two.transport, net.two.clock, net.two.process)):
        steer(bus, Velocity(linear_x=0.1))
    await settle()
    assert len(set(sources)) == 2
    assert all(source.startswith(net.two.process) for source in sources)


async def test_commands_buffered_by_a_network_do_not_steer() -> None:
    page = SteeredPage()
    await settle()
    for at_s in (1.0, 1.04, 1.08):
        page.arbiter.drive(page.one, Velocity(linear_x=0.1), at_s)
    await settle()
    assert page.speeds == []
    page.arbiter.drive(page.one, Velocity(linear_x=0.1), 1.12)
    for _ in range(75):  # after a cut of three seconds
        page.arbiter.drive(page.one, Velocity(linear_x=0.2), 4.12)
    page.arbiter.drive(page.one, ZERO, 4.12)
    await settle()
    assert page.speeds == [0.1, 0.0]


async def test_a_goal_without_a_server_is_refused_with_the_reason() -> None:
    page = SteeredPage()
    goal = PageRequest(id=7, what="goal", goal=GoalRequest(x=1.0, y=2.0))
    reply = await RequestHandler(page.net.one).handle(goal)
    assert (reply.id, reply.ok) == (7, False)
    assert reply.text == "no process serves goals: this robot runs no navigation"


async def test_an_arm_goes_limp_only_if_a_person_agrees() -> None:
    page, asked = SteeredPage(), list[bool]()

    async def let_go(request: LimpRequest) -> GateReply:
        asked.append(request.limp)
        return example(GateReply)

    page.net.two.serve(LIMP, let_go)
    handler = RequestHandler(page.net.one)
    for value in ("", "no"):
        reply = await handler.handle(PageRequest(id=7, what="limp", value=value))
        assert not reply.ok
        assert reply.text == "a limp arm may fall: a person must confirm this first"
    assert not asked
    assert (await handler.handle(PageRequest(id=8, what="limp", value="yes"))).ok
    assert (await handler.handle(PageRequest(id=9, what="hold"))).ok
    assert asked == [True, False]


def test_a_demo_on_a_shared_machine_prints_an_address_that_logs_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    deployment, address = with_page(Deployment(body="mock"), 0, login=True)
    at, token = address.split("/#")
    assert at == f"http://127.0.0.1:{deployment.page.port}"
    assert Access(deployment.page, deployment.page.port).role(token) == "operator"
    assert Access(deployment.page, deployment.page.port).role("") is None
    deployment, address = with_page(Deployment(body="mock"), 0)
    assert address == f"http://127.0.0.1:{deployment.page.port}"


def test_a_taken_port_is_replaced_by_a_free_one() -> None:
    import socket

    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert free_port(port) not in (0, port)
    assert free_port(port) == port
