"""`gigabrain ros2`: the gateway to ROS 2, by hand."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec
from cyclopts import Parameter

from gigabrain_zenoh.cli.options import LOCAL, RobotAddress, checked
from gigabrain_zenoh.config.settings import ProcessConfig, Ros2Config
from gigabrain_zenoh.launch.processes import run_process, with_ros_router
from gigabrain_zenoh.runtime.running import find_endpoint


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class RosOptions:
    """Settings with which the node joins ROS 2."""

    transport: Literal["rmw_zenoh", "dds"] = "rmw_zenoh"
    "How the other nodes talk: by rmw_zenoh over a router, or by DDS."
    domain: int = 0
    "ROS_DOMAIN_ID of the other nodes."
    ros_namespace: str = "/"
    "Namespace of the node and of its topics."
    node: str = "gigabrain"
    "Name of the node."
    router: str = ""
    "Zenoh endpoint of a ROS router. Without it, the robot's own router."
    distro: Literal["humble", "iron", "jazzy", "kilted", "rolling"] = "jazzy"
    "Distribution of the other nodes. Humble has no type hashes."
    localhost: bool = False
    "Find nodes of this machine only, by DDS."
    types: tuple[Path, ...] = ()
    "File of ROS types, or folder of them; may be given again."
    take: bool = False
    "Take the body from another commander with the first /cmd_vel."
    cmd_vel_timeout: float = 0.2
    "Longest time in seconds that a /cmd_vel counts."
    leave_out: tuple[str, ...] = ()
    "ROS topic or service not to offer; may be given again."
    free_fleet: bool = False
    "Also offer what Open-RMF's adapter free_fleet uses, below the robot's namespace."

    def config(self) -> Ros2Config:
        """Return the settings of the process. Raises ConfigError."""
        given = {name: getattr(self, name) for name in self.__dataclass_fields__}
        types = tuple(str(file.expanduser().absolute()) for file in self.types)
        given |= {"types": types, "namespace": given.pop("ros_namespace")}
        return checked(given, Ros2Config)


LOCAL_ROS = RosOptions()


def ros2(*, options: RosOptions = LOCAL_ROS, at: RobotAddress = LOCAL) -> int:
    """Run the gateway to ROS 2: the robot becomes a node there.

    Example: gigabrain ros2 --transport dds

    ROS sees the robot's topics, and may drive it, send it goals and stop it.
    If the gateway ends, nothing else of the robot notices. In a deployment
    file, a part `ros2:` starts it with the robot.
    """
    endpoint = find_endpoint(at.connect, at.namespace, at.folder)
    config = with_ros_router(options.config(), endpoint)
    settings = msgspec.to_builtins(config)
    return run_process(ProcessConfig(name="ros2", endpoint=endpoint, settings=settings))
