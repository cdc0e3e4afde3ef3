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
ROBOT = tuple(name for name, one in PROCESSES.items() if one.default)


class Deployment(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole deployment file."""

    body: str = "turtlebot3_waffle"  # a known robot, or the path of its robot.yaml
    link: LinkName = "sim"  # simulated, the real driver on an emulator, or the hardware
    world: str = "arena"  # of the simulation: a known world, or the path of a world file
    seed: Seed = 0  # of the start pose and the sensor noise in the simulation
    speed: Speed = 1.0  # simulated over real time; not 1: time waits for the brain
    lockstep_timeout_s: LockstepTimeout = 0.15  # longer: the same decisions on a slow machine, too
    resume: Resume = "manual"  # who drives on after a stop: a person, or `auto` in simulation
    namespace: str = ""  # the robot's own part of the key space, where one router serves several
    router: str = "tcp/127.0.0.1:7447"  # where it listens; port 0 for any, where all is on one host
    keys: str = ""  # the folder of this host's identity, or of one for each host: TLS for all
    fleet: tuple[str, ...] = ()  # namespaces of other robots that this one's router serves
    insecure: bool = False  # allow a router that other machines can reach, without keys
    # the processes of each host, by its name
    hosts: dict[str, tuple[str, ...]] = msgspec.field(default_factory=lambda: {"robot": ROBOT})
    cameras: bool = False  # on: the cameras of the body's file are used, by the process `camera`
    recognition: bool = True  # off: what cameras see is not recognised
    recognizer: RecognizerConfig = RecognizerConfig()
    tags: TagConfig = TagConfig()
    button: ButtonConfig | None = None  # an e-stop button; without its word nothing moves
    robot: dict[str, Any] = {}  # fields of the body's file that are other here, never less safe
    perception: PerceptionConfig = PerceptionConfig()
    decision: DecisionConfig = DecisionConfig()
    recorder: RecorderConfig = RecorderConfig()
    page: PageConfig = PageConfig()
    foxglove: FoxgloveConfig = FoxgloveConfig()
    ros2: Ros2Config | None = None  # the gateway to ROS 2, beside the driver unless `hosts` has it
    # of one's own; where there is one host, it runs those that `hosts` does not name
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
            raise ValueError("speed is for the simulation; other links run in real time")

    def _place_own(self) -> None:
        """Check the processes of one's own, and put those that have no host on the only one."""
        check_entries(self.processes, self.perceptors, PROCESSES)
        placed = {name for names in self.hosts.values() for name in names}
        left = [one for one in (*self.processes, *self.perceptors) if one not in placed]
        if left and len(self.hosts) > 1:
            where = ", ".join(self.hosts)
            raise ValueError(f"hosts: {left[0]} is on none; name it in one of: {where}")
        if left:
            ((host, names),) = self.hosts.items()
            structs.force_setattr(self, "hosts", {host: (*names, *left)})

    def settings(self, process: str) -> Struct | dict[str, Any]:
        """Return the part of the file for `process`; empty where it has none."""
        part = getattr(self, process, None)
        return part if isinstance(part, Struct) else {}

    def _check_router(self) -> None:
        try:
            host, port = host_and_port(self.router)
        except ValueError as error:
            raise ValueError(f"router: {error}") from None
        if len(self.hosts) > 1 and host and not port:
            raise ValueError(f"router: {self.router}: several hosts need a fixed port")
        if exposed((self.router,)) and not (self.insecure or self.keys):
            raise ValueError(
                f"router: {self.router} can be reached by anybody on the network; "
                "name `keys:` that `gigabrain keys new` and `keys issue` made, use a loopback "
                "address, or write `insecure: true`"
            )


def _is_namespace(text: str) -> bool:
    """Return whether a text can begin keys of the bus, and name a folder of a robot's state."""
    return not {"", ".", ".."} & {*text.split("/")} and not {*"*$#?"} & {*text}


def deployment_type(own: Iterable[str] = ()) -> type[Deployment]:
    """Return the type of a deployment file, with the processes and parts that packages offer.

    `own` are the names of its own processes and perceptors, which `hosts` may name as well.
    """
    types = {name: one for name, one in process_types().items() if one.named}
    broken = set(plugin_names({}, GROUP)) - set(types)  # its error comes where it is to run
    literal, some, by_name = cast(Any, Literal), cast(Any, tuple), cast(Any, dict)
    names = by_name[str, some[literal[(*types, *sorted(broken), *own)], ...]]
    hosts = ("hosts", names, msgspec.field(default_factory=lambda: {"robot": ROBOT}))
    known = Deployment.__struct_fields__
    parts = [
        _part(name, one.settings)
        for name, one in types.items()
        if one.settings and not one.derive and name not in known
    ]
    made: Any = msgspec.defstruct(
        "Deployment",
        [hosts, *parts],
        bases=(Deployment,),
        frozen=True,
        kw_only=True,
        forbid_unknown_fields=True,
    )
    return made  # type: ignore[no-any-return]


def _part(name: str, settings: type[Struct]) -> tuple[str, Any, Any]:
    """Return the field of a deployment file for settings; null where they have no defaults."""
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
    """Read a deployment file; the files it names lie beside it, unless `keys` replaces its keys.

    Raises ConfigError with file, line and what was expected.
    """
    root = with_files(config.document(config.read(path), str(path)), path.absolute().parent)
    loaded = config.converted(root, deployment_type(own_names(root)), lambda line: f"{path}:{line}")
    return structs.replace(loaded, keys=keys or loaded.keys)


def with_files(root: Node, folder: Path) -> Node:
    """Return settings in which the files that they name are taken from `folder`."""

    def beside(name: str) -> str:
        return config.beside(name, folder)

    def there(name: str) -> str:
        return str(folder.absolute() / expanded(name)) if name else name

    root = _placed(root, (), ("body", "world"), beside)
    root = _placed(root, (), ("keys",), there)
    root = _placed(root, ("perception",), ("map",), beside)
    root = _placed(root, ("recorder",), ("folder", "file"), there)
    root = _placed(root, ("recognizer",), ("onnx", "labels"), there)
    root = _placed(root, ("page",), ("certificate", "certificate_key", "tokens"), there)
    root = _placed(root, ("foxglove",), ("secret",), there)
    root = _placed(root, ("ros2",), ("types",), there)
    return _placed(root, ("decision", "settings"), ("mission", "scripts"), there)


def _placed(
    root: Node, parts: Sequence[str], names: Container[str], place: Callable[[str], str]
) -> Node:
    """Return settings with `place` of the settings `names` of a part."""

    def placed(one: Entry) -> Entry:
        if parts and one.key == parts[0] and one.node.entries is not None:
            return replace(one, node=_placed(one.node, parts[1:], names, place))
        if parts or one.key not in names:
            return one
        return replace(one, node=_with_place(one.node, place))

    entries = tuple(placed(one) for one in root.entries or ())
    return replace(root, entries=entries, value={one.key: one.node.value for one in entries})


def _with_place(node: Node, place: Callable[[str], str]) -> Node:
    """Return a text, or a list of texts, with `place` of each."""
    if node.items is not None:
        items = tuple(_with_place(one, place) for one in node.items)
        return replace(node, items=items, value=[one.value for one in items])
    return replace(node, value=place(node.value)) if isinstance(node.value, str) else node


def own_names(root: Node) -> list[str]:
    """Return the names of the processes of one's own in a file, which may still be invalid."""
    parts = (one.node for one in root.entries or () if one.key in (MODULES, PERCEPTORS))
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
    """Return the endpoint for `host` itself: with keys the Unix socket of its own router, if any.

    No other machine can interfere there. Raises ConfigError.
    """
    near = deployment.keys and "router" in deployment.hosts[host]
    connect = (local_socket(), deployment.router) if near else (deployment.router,)
    return _endpoint(deployment, host, *connect)


def _endpoint(deployment: Deployment, host: str, *connect: str) -> Endpoint:
    keys = str(identity_folder(deployment.keys, host)) if deployment.keys else ""
    return secured(Endpoint(connect=connect, namespace=deployment.namespace, keys=keys))


def check_keys(deployment: Deployment, host: str) -> None:
    """Check that the identity of `host` permits its processes. Raises ConfigError."""
    if not deployment.keys:
        return
    local_endpoint(deployment, host)  # refuse an address for which no keys would do
    folder = identity_folder(deployment.keys, host)
    rows = {name: deployed_type(deployment, name) for name in deployment.hosts[host]}
    ours = {name: row.roles for name, row in rows.items() if not row.own}
    check_identity(folder, ours, deployment.namespace, deployment.router)
    for name, row in rows.items():
        if row.own:
            check_own_identity(folder / name, name, deployment.namespace)


def recorded(path: Path) -> dict[str, Any]:
    """Return the fields of a deployment that records itself into one file, for a replay."""
    recorder = {"file": str(path.absolute()), "viewers": False}
    return {"hosts": {"robot": (*ROBOT, "recorder")}, "recorder": recorder}
