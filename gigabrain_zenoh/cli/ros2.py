"""`gigabrain ros2`: runs the gateway to ROS 2, lists topics of ROS, and passes messages."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
from cyclopts import Parameter

from gigabrain_zenoh.cli.options import (
    LOCAL,
    JsonLines,
    RobotAddress,
    checked,
    print_json,
    print_line,
    print_progress,
    print_table,
)
from gigabrain_zenoh.config.settings import Endpoint, ProcessConfig, Ros2Config, Ros2Link
from gigabrain_zenoh.errors import BusError
from gigabrain_zenoh.host.files import expanded
from gigabrain_zenoh.host.signals import run_async
from gigabrain_zenoh.launch.processes import gateway_config, run_process, with_ros_router
from gigabrain_zenoh.runtime.running import find_endpoint

if TYPE_CHECKING:
    from gigabrain_zenoh.gateway.topic_list import TopicRow
    from gigabrain_zenoh.ros2.types import Types

RENAMED = {"namespace": "ros_namespace"}  # option by setting, where they differ


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class RosLinkOptions:
    """Settings with which a node joins ROS 2."""

    transport: Literal["rmw_zenoh", "dds"] = "rmw_zenoh"
    "RMW of the other nodes: rmw_zenoh over a router, or DDS."
    domain: int = 0
    "ROS_DOMAIN_ID of the other nodes."
    ros_namespace: str = "/"
    "Namespace of the gateway's node and of its topics."
    node: str = "gigabrain"
    "Name of the gateway's node."
    router: str = ""
    "Zenoh endpoint of a ROS router. Without it, the robot's own router."
    distro: Literal["humble", "iron", "jazzy", "kilted", "rolling"] = "jazzy"
    "Distribution of the other nodes. Humble has no type hashes."
    localhost: bool = False
    "Find nodes of this machine only, by DDS."
    types: tuple[Path, ...] = ()
    "File of ROS types, or folder of them; may be given again."

    def given(self) -> dict[str, Any]:
        """Return the settings by their names in a deployment file."""
        given = {name: getattr(self, name) for name in self.__dataclass_fields__}
        types = tuple(str(expanded(file).absolute()) for file in self.types)
        return given | {"types": types, "namespace": given.pop(RENAMED["namespace"])}


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class RosOptions(RosLinkOptions):
    """Settings of the gateway."""

    take: bool = False
    "Take the body from another commander with the first /cmd_vel."
    cmd_vel_timeout: float = 0.2
    "Time in seconds that a /cmd_vel stays valid."
    leave_out: tuple[str, ...] = ()
    "ROS topic or service not to offer; may be given again."
    free_fleet: bool = False
    "Also offer what Open-RMF's adapter free_fleet uses, below the robot's namespace."


LOCAL_ROS, LOCAL_LINK = RosOptions(), RosLinkOptions()


def ros2(*, options: RosOptions = LOCAL_ROS, at: RobotAddress = LOCAL) -> int:
    """Run the gateway to ROS 2: the robot becomes a node there.

    Example: gigabrain ros2 --transport dds

    ROS sees the robot's topics, and may drive it, send it goals and stop it.
    If it ends, the robot's other processes keep running. In a deployment
    file, a part `ros2:` starts it with the robot.
    """
    from gigabrain_zenoh.ros2.opening import load_types

    wanted = checked(options.given(), Ros2Config, RENAMED)
    load_types(wanted)  # raises for a wrong file, before connecting
    endpoint = _endpoint(at)
    config = gateway_config(wanted, endpoint)
    settings = msgspec.to_builtins(config)
    return run_process(ProcessConfig(name="ros2", endpoint=endpoint, settings=settings))


def topics(
    *,
    options: RosLinkOptions = LOCAL_LINK,
    at: RobotAddress = LOCAL,
    all_topics: bool = False,
    json: JsonLines = False,
) -> None:
    """List topics, services and actions of ROS, with the robot's keys beside them.

    Example: gigabrain ros2 topics --transport dds

    It joins ROS for a few seconds, until nothing new is found. Give it
    the gateway's own options: transport, domain and namespace. Below the list
    it names what keeps nodes apart, such as types or QoS that do not match.

    Args:
        all_topics: Also list the topics that every node has, and the parts of actions.
    """
    from gigabrain_zenoh.ros2.opening import load_types

    link = checked(options.given(), Ros2Link, RENAMED)
    types = load_types(link)
    if link.transport == "rmw_zenoh" and not link.router:
        link = with_ros_router(link, _endpoint(at))
    listed = run_async(_listed(link, types, all_topics=all_topics))
    if json:
        for row in listed:
            print_json(row)
        return
    from gigabrain_zenoh.gateway.topic_list import gateway_node, topic_table

    print_table(topic_table(listed))
    for name, trouble in dict.fromkeys((row.name, text) for row in listed for text in row.troubles):
        print_line(f"{name}: {trouble}")
    if not any(row.robot_keys for row in listed):
        print_progress(f"the gateway's node {gateway_node(link)} is not among them")


async def _listed(link: Ros2Link, types: "Types", *, all_topics: bool) -> "list[TopicRow]":
    """Join ROS for a while, and list its topics. Raises BusError if there is no other node."""
    from gigabrain_zenoh.gateway.topic_list import rows
    from gigabrain_zenoh.ros2.graph import discovered, unreached
    from gigabrain_zenoh.ros2.opening import ROUTER_S, open_transport

    own = msgspec.structs.replace(link, node=f"{link.node}_topics", namespace="/")
    async with open_transport(own, types, timeout_s=ROUTER_S) as ros:
        found = await discovered(ros.endpoints)
    if not found:
        do = unreached(link.transport, link.domain, link.router)
        raise BusError(f"no node of ROS in domain {link.domain}: {do}")
    return rows(found, link, all_topics=all_topics)


def pass_(
    source: str,
    target: str,
    type: str,
    /,
    *,
    as_: Annotated[Literal["fields", "json", "cdr"], Parameter(name="--as")] = "fields",
    options: RosLinkOptions = LOCAL_LINK,
    at: RobotAddress = LOCAL,
) -> None:
    """Pass messages from a key to a ROS topic, or from a ROS topic to a key, until Ctrl-C.

    Example: gigabrain ros2 pass robot/world /world std_msgs/String --as json

    A ROS topic starts with /, a key does not. A key may be any topic of the
    robot, or one of your own below robot/, with JSON or MessagePack. ROS
    writes to your own keys only: it drives the robot through the gateway.
    Messages are encoded only while something subscribes.

    Args:
        source: Key or ROS topic to read.
        target: ROS topic or key to write.
        type: ROS type of the topic, such as std_msgs/String.
        as_: Equal field names, JSON in the type's one string field, or unchanged CDR.
    """
    from gigabrain_zenoh import logs
    from gigabrain_zenoh.gateway.passing import pass_on, route
    from gigabrain_zenoh.ros2.opening import load_types

    link = checked(options.given(), Ros2Link, RENAMED)
    types = load_types(link)
    chosen = route(source, target, type, as_, types)
    link = with_ros_router(link, _endpoint(at))
    logs.setup("pass", None, json_console=False)
    run_async(pass_on(chosen, at.where(), link, types))


def _endpoint(at: RobotAddress) -> Endpoint:
    return find_endpoint(at.connect, at.namespace, at.folder)
