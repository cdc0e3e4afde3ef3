"""Opening a transport: errors name what is missing, and nothing is left open."""

import socket
from pathlib import Path

import psutil
import pytest

from gigabrain_zenoh.config.settings import Endpoint, Ros2Config, Ros2Link
from gigabrain_zenoh.errors import BusError, ConfigError
from gigabrain_zenoh.ros2 import opening
from gigabrain_zenoh.ros2.opening import load_types, open_transport
from gigabrain_zenoh.ros2.qos import LATCHED, SENSOR_DATA, Qos, mismatch
from gigabrain_zenoh.ros2.rmw_zenoh import RmwZenohTransport
from gigabrain_zenoh.ros2.rtps_discovery import multicast_port
from gigabrain_zenoh.ros2.types import Types


@pytest.fixture(scope="session")
def types() -> Types:
    return Types()


@pytest.mark.long
async def test_dds_without_its_library_names_the_extra(
    types: Types, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(opening, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"gigabrain-zenoh\[dds\]"):
        async with open_transport(Ros2Link(transport="dds"), types):
            pass


@pytest.mark.skipif(not hasattr(psutil.Process, "num_fds"), reason="Windows counts no files")
async def test_a_domain_that_cannot_be_joined_leaves_no_file_open(types: Types) -> None:
    pytest.importorskip("cyclonedds")
    with socket.socket(type=socket.SOCK_DGRAM) as taken:
        taken.bind(("", multicast_port(230)))
        link, files = Ros2Link(transport="dds", domain=230), []
        for _ in range(3):  # a driver tries it five times a second
            with pytest.raises(BusError, match="UDP port 64900 of DDS domain 230"):
                async with open_transport(link, types):
                    pass
            files.append(psutil.Process().num_fds())
    assert files[2] == files[0]


async def test_rmw_zenoh_without_a_router_names_the_option(types: Types) -> None:
    with pytest.raises(ConfigError, match="router: tcp"):
        async with open_transport(Ros2Config(), types, Endpoint()):
            pass


def test_the_deployments_own_router_is_used_outside_the_robots_namespace(types: Types) -> None:
    own = Endpoint(connect=("tcp/127.0.0.1:7447",), namespace="robot1", keys="", nap_s=0.1)
    default = RmwZenohTransport(Ros2Link(), types, own)
    assert default.endpoint == Endpoint(connect=("tcp/127.0.0.1:7447",), stamps=True)
    other = RmwZenohTransport(Ros2Link(router="tcp/10.0.0.2:7447"), types, own)
    assert other.endpoint.connect == ("tcp/10.0.0.2:7447",)


@pytest.mark.long
def test_types_of_the_user_are_loaded(tmp_path: Path) -> None:
    (tmp_path / "msg").mkdir()
    (tmp_path / "msg/Thing.msg").write_text("int32 a\n")
    link = Ros2Link(types=(str(tmp_path),))
    assert load_types(link).make(f"{tmp_path.name}/msg/Thing").a == 0


@pytest.mark.parametrize(
    ("offered", "requested", "words"),
    [
        (Qos(), Qos(), ""),
        (Qos(), SENSOR_DATA, ""),
        (LATCHED, Qos(), ""),
        (SENSOR_DATA, Qos(), "best effort"),
        (Qos(), LATCHED, "volatile"),
    ],
)
def test_a_mismatch_of_qos_is_named(offered: Qos, requested: Qos, words: str) -> None:
    assert words in mismatch(offered, requested)
    assert bool(words) == bool(mismatch(offered, requested))


@pytest.mark.parametrize("depth", [0, 1001])
def test_a_depth_out_of_range_is_rejected(depth: int) -> None:
    with pytest.raises(ValueError, match="1 to 1000"):
        Qos(depth=depth)
