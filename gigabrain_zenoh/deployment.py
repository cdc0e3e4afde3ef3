"""A deployment file: which body on which link, and which process runs on which host."""

import re
import socket
import sys
from collections.abc import Iterator, Mapping
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import msgspec
from msgspec import Struct

from gigabrain_zenoh import config, config_yaml
from gigabrain_zenoh.errors import ConfigError, unknown
from gigabrain_zenoh.keeper import ProcessSpec
from gigabrain_zenoh.process_config import ProcessConfig
from gigabrain_zenoh.settings import (
    ButtonConfig,
    DecisionConfig,
    DriverConfig,
    EmulatorConfig,
    Endpoint,
    LinkName,
    PerceptionConfig,
    Resume,
    Seed,
    Speed,
)

EMULATOR = "emulator"  # runs beside the driver where the link is `emulated`; not in `hosts`
BUTTON = "button"  # runs beside the driver where there is one, unless `hosts` says where
ProcessName = Literal["router", "driver", "perception", "decision", "control", "safety", "button"]
ALL: tuple[ProcessName, ...] = (
    "router", "driver", "perception", "decision", "control", "safety",
)  # fmt: skip
LOOPBACK = ("127.", "localhost", "[::1]")


class Deployment(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole deployment file."""

    body: str = "turtlebot3_waffle"
    link: LinkName = "sim"
    world: str = "arena"
    seed: Seed = 0
    speed: Speed = 1.0
    resume: Resume = "manual"
    namespace: str = ""  # the robot's own part of the key space, where one router serves several
    router: str = "tcp/127.0.0.1:7447"  # where it listens; port 0 for any, where all is on one host
    insecure: bool = False  # allow a router that other machines can reach
    hosts: dict[str, tuple[ProcessName, ...]] = msgspec.field(
        default_factory=lambda: {"robot": ALL}
    )
    button: ButtonConfig | None = None  # an e-stop button; without its word nothing moves
    perception: PerceptionConfig = PerceptionConfig()
    decision: DecisionConfig = DecisionConfig()

    def __post_init__(self) -> None:
        if not self.hosts:
            raise ValueError("hosts: expected at least one, with the processes that it runs")
        if len(self.hosts) > 1 and self.router.endswith(":0"):
            raise ValueError(f"router {self.router}: several hosts must know its port")
        placed = [name for names in self.hosts.values() for name in names]
        twice = sorted({name for name in placed if placed.count(name) > 1})
        if twice:
            raise ValueError(f"{', '.join(twice)} must run once, on one host")
        if BUTTON in placed and self.button is None:
            raise ValueError("hosts: a button runs nowhere unless `button: {port: …}` says which")
        if self.button and self.speed != 1.0:
            raise ValueError("button: a person presses it in real time, so leave out `speed`")
        address = self.router.partition("/")[2]
        if not self.insecure and not address.startswith(LOOPBACK):
            raise ValueError(
                f"router {self.router} can be reached by anybody on the network; "
                "use a loopback address, or write `insecure: true`"
            )
        if self.resume == "auto" and self.link == "real":
            raise ValueError("resume: auto is for simulation; a real body is enabled by a person")
        if self.speed != 1.0 and self.link != "sim":
            raise ValueError("speed is for the simulation; other links run in real time")


def deployment_folder() -> Path:
    """The deployment files that come with the package, in a wheel as in a checkout."""
    package = Path(str(resources.files("gigabrain_zenoh")))
    installed = package / "deploy"
    return installed if installed.is_dir() else package.parent / "deploy"


def deployment_path(name: str) -> Path:
    """The deployment file at a path, or the one of ours with that name. Raises UnknownName."""
    path = Path(name)
    ours = {file.stem: file for file in sorted(deployment_folder().glob("*.yaml"))}
    if not path.exists() and not name.endswith((".yaml", ".yml")):
        if name not in ours:
            raise unknown("deployment", name, ours)
        return ours[name]
    if not path.exists() and path.stem in ours and path.parent in (Path(), Path("deploy")):
        return ours[path.stem]
    return path


def load_deployment(path: Path) -> Deployment:
    """Read a deployment file. Raises ConfigError with file, line and what was expected."""
    return config.load(path, Deployment)


def located(path: Path, error: ConfigError) -> ConfigError:
    """What a process says of a name that it was given, with that name's line in the file."""
    if named := re.match(r"no \w+ ('.*?');", str(error)):
        for node in _scalars(config_yaml.read(path.read_text(encoding="utf-8"))):
            if repr(node.value) == named[1]:
                return ConfigError(f"{path}:{node.line}: {error}")
    return error


def _scalars(node: config_yaml.Node) -> Iterator[config_yaml.Node]:
    children = [entry.node for entry in node.entries or ()] + list(node.items or ())
    if not children:
        yield node
    for child in children:
        yield from _scalars(child)


def host_of(deployment: Deployment, name: str | None) -> str:
    """The host to start: `name`, or the only one there is. Raises ConfigError."""
    hosts = deployment.hosts
    if name is None:
        if len(hosts) > 1:
            raise ConfigError(f"which host is this? choose one with --host: {', '.join(hosts)}")
        return next(iter(hosts), "")
    if name not in hosts:
        raise unknown("host", name, hosts)
    return name


def with_free_port(deployment: Deployment) -> Deployment:
    """The deployment with a free port in place of port 0."""
    protocol, _, address = deployment.router.partition("/")
    host, _, port = address.rpartition(":")
    if port != "0":
        return deployment
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.create_server((host.strip("[]"), 0), family=family) as probe:
            free = probe.getsockname()[1]
    except OSError as error:
        raise ConfigError(f"router {deployment.router}: {error.strerror}") from None
    return msgspec.structs.replace(deployment, router=f"{protocol}/{host}:{free}")


def client_endpoint(deployment: Deployment) -> Endpoint:
    """Where anybody meets this deployment."""
    return Endpoint(connect=(deployment.router,), namespace=deployment.namespace)


def process_specs(
    deployment: Deployment,
    host: str,
    run_dir: Path,
    state_dir: Path,
    *,
    seconds: float | None = None,
    level: str = "info",
) -> list[ProcessSpec]:
    """What the supervisor of `host` has to run, in readiness order: the router first."""
    names: list[str] = sorted(deployment.hosts[host], key=(*ALL, BUTTON).index)
    placed = any(BUTTON in others for others in deployment.hosts.values())
    if deployment.button and "driver" in names and not placed:
        names.append(BUTTON)
    if deployment.link == "emulated" and "driver" in names:
        names.insert(names.index("driver"), EMULATOR)
    settings = _settings(deployment, run_dir, state_dir, seconds)
    specs = []
    for name in names:
        endpoint = client_endpoint(deployment)
        if name == "router":
            endpoint = Endpoint(listen=(deployment.router,), namespace=deployment.namespace)
        process = ProcessConfig(
            name=name,
            endpoint=endpoint,
            settings=settings.get(name, {}),
            run_dir=str(run_dir),
            json_console=True,
            level=level,
        )
        first = ("router", EMULATOR) if name == "driver" else ("router",)
        after = tuple(other for other in first if other in names and other != name)
        specs.append(
            ProcessSpec(
                name=name,
                argv=(*COMMAND, msgspec.json.encode(process).decode()),
                after=after,
                stop_last=name == "router",
                ready_timeout_s=30.0 if after else 3600.0,  # elsewhere, the router may come later
            )
        )
    return specs


# -P: a folder that happens to be the current one must not stand in for an installed package
COMMAND = (sys.executable, "-P", "-m", "gigabrain_zenoh.process")


def _settings(
    deployment: Deployment, run_dir: Path, state_dir: Path, seconds: float | None
) -> Mapping[str, dict[str, Any]]:
    ports = str(run_dir / "ports") if deployment.link == "emulated" else ""
    driver = DriverConfig(
        body=deployment.body,
        link=deployment.link,
        world=deployment.world,
        seed=deployment.seed,
        speed=deployment.speed,
        seconds=seconds,
        resume=deployment.resume,
        state_dir=str(state_dir),
        emulator=ports,
        button=deployment.button is not None,
    )
    emulator = EmulatorConfig(
        body=deployment.body, world=deployment.world, seed=deployment.seed, folder=ports
    )
    return {
        "driver": msgspec.to_builtins(driver),
        EMULATOR: msgspec.to_builtins(emulator),
        BUTTON: msgspec.to_builtins(deployment.button) if deployment.button else {},
        "perception": msgspec.to_builtins(deployment.perception),
        "decision": msgspec.to_builtins(deployment.decision),
    }
