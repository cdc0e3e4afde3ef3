"""A deployment file: which body on which link, and which process runs on which host."""

from collections import Counter
from collections.abc import Callable, Container, Iterable, Sequence
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any, Literal, cast

import msgspec
from msgspec import Struct, structs

from gigabrain_zenoh.bus.key_expressions import key_expressions
from gigabrain_zenoh.bus.zenoh.config import secured
from gigabrain_zenoh.config import loading as config
from gigabrain_zenoh.config.settings import (
    ButtonConfig,
    DecisionConfig,
    Endpoint,
    FoxgloveConfig,
    LinkName,
    LockstepTimeout,
    OwnName,
    OwnPerceptor,
    OwnProcess,
    PageConfig,
    PerceptionConfig,
    RecognizerConfig,
    RecorderConfig,
    Resume,
    Ros2Config,
    Seed,
    Speed,
    TagConfig,
)
from gigabrain_zenoh.config.yaml_text import Entry, Node
from gigabrain_zenoh.errors import ConfigError, unknown
from gigabrain_zenoh.host.files import expanded
from gigabrain_zenoh.host.network import exposed, host_and_port, reserve_port
from gigabrain_zenoh.launch.own_processes import MODULES, PERCEPTORS, check_entries
from gigabrain_zenoh.launch.processes import (
    GROUP,
    PROCESSES,
    deployed_type,
    process_types,
)
from gigabrain_zenoh.plugins import plugin_names
from gigabrain_zenoh.runtime.running import local_socket
from gigabrain_zenoh.security.identity_files import (
    check_identity,
    check_own_identity,
    identity_folder,
)

MAX_HOSTS = 64
ROBOT = tuple(name for name, row in PROCESSES.items() if row.default)


class Deployment(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole deployment file."""

    body: str = "turtlebot3_waffle"  # a known robot, or the path of its robot.yaml
    link: LinkName = "sim"  # simulated, the real driver on an emulator, or the hardware
    world: str = "arena"  # of the simulation: a known world, or the path of a world file
    seed: Seed = 0  # of the start pose and the sensor noise in the simulation
    speed: Speed = 1.0  # simulated over real time; other than 1: time waits for the brain
    lockstep_timeout_s: LockstepTimeout = 0.15  # a slow machine needs more, for the same decisions
    resume: Resume = "manual"  # after a stop a person resumes; `auto`: the robot, in simulation
    namespace: str = ""  # prefix of the robot's keys; required where one router serves several
    router: str = "tcp/127.0.0.1:7447"  # its endpoint; port 0: any free one, on a single host
    keys: str = ""  # folder of this host's identity, or of those of all hosts; enables TLS
    fleet: tuple[str, ...] = ()  # namespaces of other robots that this one's router serves
    insecure: bool = False  # allow a router that other machines can reach, without keys
    # processes by host
    hosts: dict[str, tuple[str, ...]] = msgspec.field(default_factory=lambda: {"robot": ROBOT})
    cameras: bool = False  # use the cameras of the body's file, in the process `camera`
    recognition: bool = True  # recognise things and tags in pictures
    recognizer: RecognizerConfig = RecognizerConfig()
    tags: TagConfig = TagConfig()
    button: ButtonConfig | None = None  # an e-stop button; while it is silent, nothing moves
    robot: dict[str, Any] = {}  # replaces fields of the body's file, but never less safely
    perception: PerceptionConfig = PerceptionConfig()
    decision: DecisionConfig = DecisionConfig()
    recorder: RecorderConfig = RecorderConfig()
    page: PageConfig = PageConfig()
    foxglove: FoxgloveConfig = FoxgloveConfig()
    ros2: Ros2Config | None = None  # gateway to ROS 2, beside the driver unless `hosts` names it
    # processes of the user's own; a single host also runs those that `hosts` does not name
    processes: dict[OwnName, OwnProcess] = {}
    perceptors: dict[OwnName, OwnPerceptor] = {}

    def __post_init__(self) -> None:
        if not self.hosts:
            raise ValueError("hosts: expected at least one, with the processes that it runs")
        if len(self.hosts) > MAX_HOSTS:
            raise ValueError(f"hosts: {len(self.hosts)} of them; expected at most {MAX_HOSTS}")
        self._place_own()
        for host, names in self.hosts.items():
            if not names:
                raise ValueError(f"hosts.{host}: no process; name at least one, or remove the host")
        placed = Counter(name for names in self.hosts.values() for name in names)
        twice = sorted(name for name, times in placed.items() if times > 1)
        if twice:
            raise ValueError(f"hosts: {', '.join(twice)} repeated; list each once")
        for name in placed:
            if getattr(self, name, self) is None:
                raise ValueError(f"hosts: {name} needs settings; add a part `{name}:` to this file")
        if self.button and self.speed != 1.0:
            raise ValueError("button: works in real time only; remove `speed`")
        if self.namespace and not _is_namespace(self.namespace):
            raise ValueError(
                f"namespace: expected a name such as red, or names joined by '/', "
                f"got {self.namespace!r}"
            )
        self._check_router()
        try:
            key_expressions(self.recorder.topics)
        except ConfigError as error:
            raise ValueError(f"recorder.topics: {error}") from None
        if self.fleet and not self.namespace:
            raise ValueError("fleet: this robot has no namespace; set `namespace`")
        if self.resume == "auto" and self.link == "real":
            raise ValueError("resume: auto is not allowed with link real; use manual")
        if self.speed != 1.0 and self.link != "sim":
            raise ValueError("speed: works in simulation only; remove it, or use link sim")

    def _place_own(self) -> None:
        """Check the user's own processes, and place those without a host on the only one."""
        check_entries(self.processes, self.perceptors, PROCESSES)
        placed = {name for names in self.hosts.values() for name in names}
        unplaced = [name for name in (*self.processes, *self.perceptors) if name not in placed]
        if unplaced and len(self.hosts) > 1:
            where = ", ".join(self.hosts)
            raise ValueError(f"hosts: {unplaced[0]} runs on none; add it to one of: {where}")
        if unplaced:
            ((host, names),) = self.hosts.items()
            structs.force_setattr(self, "hosts", {host: (*names, *unplaced)})

    def settings(self, process: str) -> Struct | dict[str, Any]:
        """Return the part of the file for `process`; empty if there is none."""
        part = getattr(self, process, None)
        return part if isinstance(part, Struct) else {}

    def _check_router(self) -> None:
        try:
            host, port = host_and_port(self.router)
        except ValueError as error:
            raise ValueError(f"router: {error}") from None
        if len(self.hosts) > 1 and host and not port:
            raise ValueError(f"router: {self.router}: several hosts need a fixed port; replace 0")
        if exposed((self.router,)) and not (self.insecure or self.keys):
            raise ValueError(
                f"router: {self.router} can be reached by anybody on the network; "
                "name `keys:` that `gigabrain keys new` and `keys issue` made, use a loopback "
                "address, or write `insecure: true`"
            )


def _is_namespace(text: str) -> bool:
    """Return whether a text can be a prefix of keys, and the name of a robot's state folder."""
    return not {"", ".", ".."} & {*text.split("/")} and not {*"*$#?"} & {*text}


def deployment_type(own: Iterable[str] = ()) -> type[Deployment]:
    """Return the type of a deployment file, with the processes and parts that packages offer.

    `own` are the names of the user's own processes and perceptors, which `hosts` may name too.
    """
    rows = {name: row for name, row in process_types().items() if row.named}
    broken = set(plugin_names({}, GROUP)) - set(rows)  # their errors appear at their start
    literal, some, by_name = cast(Any, Literal), cast(Any, tuple), cast(Any, dict)
    names = by_name[str, some[literal[(*rows, *sorted(broken), *own)], ...]]
    hosts = ("hosts", names, msgspec.field(default_factory=lambda: {"robot": ROBOT}))
    known = Deployment.__struct_fields__
    parts = [
        _part(name, row.settings)
        for name, row in rows.items()
        if row.settings and not row.derive and name not in known
    ]
    file_type: Any = msgspec.defstruct(
        "Deployment",
        [hosts, *parts],
        bases=(Deployment,),
        frozen=True,
        kw_only=True,
        forbid_unknown_fields=True,
    )
    return file_type  # type: ignore[no-any-return]


def _part(name: str, settings: type[Struct]) -> tuple[str, Any, Any]:
    """Return the field of a deployment file for settings; null by default if one is required."""
    if any(field.required for field in structs.fields(settings)):
        return name, settings | None, None
    return name, settings, msgspec.field(default_factory=settings)


def deployment_folder() -> Path:
    """Return the folder of the shipped deployment files, in a wheel or a checkout."""
    package = Path(str(resources.files("gigabrain_zenoh")))
    installed = package / "deploy"
    return installed if installed.is_dir() else package.parent / "deploy"


def deployment_path(name: str) -> Path:
    """Return the deployment file at a path, or the shipped one of that name. Raises UnknownName."""
    path = Path(name)
    ours = {file.stem: file for file in sorted(deployment_folder().glob("*.yaml"))}
    if name in ours and path.is_dir():
        return ours[name]
    if not name or (not path.exists() and not name.endswith((".yaml", ".yml"))):
        if name not in ours:
            raise unknown("deployment", name, ours)
        return ours[name]
    if not path.exists() and path.stem in ours and path.parent in (Path(), Path("deploy")):
        return ours[path.stem]
    return path


def load_deployment(path: Path, keys: str = "") -> Deployment:
    """Read a deployment file; its paths are relative to its folder. `keys` replaces its keys.

    Raises ConfigError with file, line and what was expected.
    """
    root = with_files(config.document(config.read(path), str(path)), path.absolute().parent)
    loaded = config.converted(root, deployment_type(own_names(root)), lambda line: f"{path}:{line}")
    return structs.replace(loaded, keys=keys or loaded.keys)


def with_files(root: Node, folder: Path) -> Node:
    """Return settings whose paths of files are made absolute, relative to `folder`."""

    def beside(name: str) -> str:
        return config.beside(name, folder)

    def inside(name: str) -> str:
        return str(folder.absolute() / expanded(name)) if name else name

    root = _placed(root, (), ("body", "world"), beside)
    root = _placed(root, (), ("keys",), inside)
    root = _placed(root, ("perception",), ("map",), beside)
    root = _placed(root, ("recorder",), ("folder", "file"), inside)
    root = _placed(root, ("recognizer",), ("onnx", "labels"), inside)
    root = _placed(root, ("page",), ("certificate", "certificate_key", "tokens"), inside)
    root = _placed(root, ("foxglove",), ("secret",), inside)
    root = _placed(root, ("ros2",), ("types",), inside)
    return _placed(root, ("decision", "settings"), ("mission", "scripts"), inside)


def _placed(
    root: Node, parts: Sequence[str], names: Container[str], place: Callable[[str], str]
) -> Node:
    """Return settings with `place` applied to the settings `names` of the section `parts`."""

    def placed(entry: Entry) -> Entry:
        if parts and entry.key == parts[0] and entry.node.entries is not None:
            return replace(entry, node=_placed(entry.node, parts[1:], names, place))
        if parts or entry.key not in names:
            return entry
        return replace(entry, node=_with_place(entry.node, place))

    entries = tuple(placed(entry) for entry in root.entries or ())
    return replace(root, entries=entries, value={entry.key: entry.node.value for entry in entries})


def _with_place(node: Node, place: Callable[[str], str]) -> Node:
    """Return a text, or a list of texts, with `place` applied to each."""
    if node.items is not None:
        items = tuple(_with_place(item, place) for item in node.items)
        return replace(node, items=items, value=[item.value for item in items])
    return replace(node, value=place(node.value)) if isinstance(node.value, str) else node


def own_names(root: Node) -> list[str]:
    """Return the names of the user's own processes in a file, which need not be valid."""
    parts = (each.node for each in root.entries or () if each.key in (MODULES, PERCEPTORS))
    return [entry.key for part in parts for entry in part.entries or ()]


def host_of(deployment: Deployment, name: str | None) -> str:
    """Return the host to start: `name`, or the only one. Raises ConfigError."""
    hosts = deployment.hosts
    if name is None:
        if len(hosts) > 1:
            raise ConfigError(f"which host is this? choose one with --host: {', '.join(hosts)}")
        return next(iter(hosts), "")
    if name not in hosts:
        raise unknown("host", name, hosts)
    return name


def with_free_port(deployment: Deployment) -> Deployment:
    """Return the deployment with a free port in place of port 0."""
    protocol, _, address = deployment.router.partition("/")
    host, _, port = address.rpartition(":")
    if port != "0":
        return deployment
    try:
        free = reserve_port(host.strip("[]"))
    except OSError as error:
        raise ConfigError(f"router {deployment.router}: {error.strerror}") from None
    return msgspec.structs.replace(deployment, router=f"{protocol}/{host}:{free}")


def client_endpoint(deployment: Deployment, host: str = "") -> Endpoint:
    """Return the endpoint at which clients of the robot connect. Raises ConfigError."""
    return _endpoint(deployment, host, deployment.router)


def local_endpoint(deployment: Deployment, host: str) -> Endpoint:
    """Return the endpoint for processes on `host`: with keys its own router's Unix socket, if any.

    No other machine can reach that socket. Raises ConfigError.
    """
    has_socket = deployment.keys and "router" in deployment.hosts[host]
    connect = (local_socket(), deployment.router) if has_socket else (deployment.router,)
    return _endpoint(deployment, host, *connect)


def _endpoint(deployment: Deployment, host: str, *connect: str) -> Endpoint:
    keys = str(identity_folder(deployment.keys, host)) if deployment.keys else ""
    return secured(Endpoint(connect=connect, namespace=deployment.namespace, keys=keys))


def check_keys(deployment: Deployment, host: str) -> None:
    """Check that the identity of `host` permits its processes. Raises ConfigError."""
    if not deployment.keys:
        return
    local_endpoint(deployment, host)  # raises for an address that cannot have keys
    folder = identity_folder(deployment.keys, host)
    rows = {name: deployed_type(deployment, name) for name in deployment.hosts[host]}
    ours = {name: row.roles for name, row in rows.items() if not row.own}
    check_identity(folder, ours, deployment.namespace, deployment.router)
    for name, row in rows.items():
        if row.own:
            check_own_identity(folder / name, name, deployment.namespace)


def recorded(path: Path) -> dict[str, Any]:
    """Return the fields of a deployment that records into the file `path`, for a replay."""
    recorder = {"file": str(path.absolute()), "viewers": False}
    return {"hosts": {"robot": (*ROBOT, "recorder")}, "recorder": recorder}
