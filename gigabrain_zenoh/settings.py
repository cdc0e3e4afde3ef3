"""The settings of the processes. Kept apart, so that reading a deployment file needs no numpy."""

import re
from typing import Annotated, Literal

from msgspec import Meta, Struct

from gigabrain_schemas.base import NonNegative, Positive

LinkName = Literal["sim", "emulated", "real"]
Resume = Literal["auto", "manual"]
Seed = Annotated[int, Meta(ge=0, le=2**32)]
Speed = Annotated[float, Meta(ge=0.1, le=100)]  # of real time; other than 1 means lock-step
LockstepTimeout = Annotated[float, Meta(ge=0.15, le=60)]  # [s] of wall time


class Endpoint(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where a process finds the others."""

    connect: tuple[str, ...] = ()  # Zenoh endpoints, such as tcp/127.0.0.1:7447
    listen: tuple[str, ...] = ()  # of a router
    namespace: str = ""  # the robot's own part of the key space
    keys: str = ""  # the folder of an identity; without one, nobody asks who anybody is
    fleet: tuple[str, ...] = ()  # namespaces of other robots that a router serves
    nap_s: float = 0.0  # for how long what is tapped may gather before it is handed on


class RouterConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The settings of the router process."""

    state_dir: str = ""  # where it writes down who was not let in
    knows: tuple[str, ...] = ()  # common names that have rights; without keys none is asked for


class RelayConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The settings of the relay process."""

    router: str  # the robot's, for people to read
    keys: str = ""  # the folder of the host's identity


class PerceptionConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The `perception` part of a deployment file."""

    sector_deg: Annotated[float, Meta(gt=0, le=360)] = 30.0  # [deg], the cone that counts as ahead
    ahead: Positive = 1.0  # [m], how far it reaches
    ignore_below: NonNegative = 0.1  # [m], nearer hits are the lidar's own housing
    corridor: NonNegative = 0.45  # [m], length of the strip ahead that must be free to turn in
    turning_room: NonNegative = 0.04  # [m], kept free round the circle that a turning body sweeps
    sectors: Annotated[int, Meta(ge=4, le=360)] = 12  # all round, the first centred ahead
    mapping: Literal["off", "slam", "localize"] = "off"  # make a map, or find its way in one
    map: str = ""  # a saved map's YAML file: to be found in, or with `slam` to go on with
    state_dir: str = ""  # where `slam` saves the map every few seconds; nowhere without

    def __post_init__(self) -> None:
        if self.map and self.mapping == "off":
            raise ValueError("map: a map is for mapping: slam or localize; expected one of them")


class DecisionConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The `decision` part of a deployment file."""

    behaviour: str = "avoid"
    turn: Literal["right", "left", "clearer"] = "right"
    linear_speed: Annotated[float, Meta(gt=0, le=10)] = 0.2  # [m/s]
    angular_speed: Annotated[float, Meta(gt=0, le=10)] = 0.5  # [rad/s]
    # of `navigate`, which needs a map (perception: {mapping: slam}):
    speed_limit: Annotated[float, Meta(gt=0, le=10)] | None = None  # [m/s]; also the body's own
    # ways through what no one has seen yet; with `allow` also to places beyond the map
    unknown: Literal["avoid", "allow", "forbid"] = "avoid"
    samples: Annotated[int, Meta(ge=64, le=20_000)] = 1000  # plans to choose from, per scan
    begin: Literal["wait", "roam"] = "wait"  # roam: explore, then visit places, until it is sent
    scripts: str = ""  # the folder of the programs that missions may run; without, they run none
    state_dir: str = ""  # where it remembers what it is to do; nowhere without


class DriverConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The settings of the driver process."""

    body: str
    link: LinkName = "sim"
    world: str = "arena"
    seed: Seed = 0
    speed: Speed = 1.0
    lockstep_timeout_s: LockstepTimeout = 0.15  # how long a tick waits for the brain, off speed 1
    seconds: Positive | None = None  # of simulated time, then the body holds still
    resume: Resume = "manual"
    state_dir: str  # where it remembers what latched it
    emulator: str = ""  # the folder of the emulator's ports, where the link is `emulated`
    button: bool = False  # whether an e-stop button has to be there


class ButtonConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The `button` part of a deployment file."""

    port: str  # of the USB-serial adapter: a path, or usb:VID:PID[:SERIAL]

    def __post_init__(self) -> None:
        if not re.fullmatch(r"usb:[0-9a-fA-F]+:[0-9a-fA-F]+(:.*)?|(?!usb:).*\S.*", self.port):
            raise ValueError(f"port: expected a path, or usb:VID:PID[:SERIAL], got {self.port!r}")


class PageConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The `page` part of a deployment file."""

    listen: str = "127.0.0.1"  # an address of this host; beyond loopback it wants TLS and a login
    port: Annotated[int, Meta(ge=0, le=65535)] = 8080
    names: tuple[str, ...] = ()  # by which browsers ask for it, beside `listen`
    certificate: str = ""  # a PEM file
    certificate_key: str = ""
    login: bool = False  # want a token on loopback as well
    tokens: str = ""  # the file that keeps them; one in the user's state folder without
    tell_tokens: bool = False  # print them when they are made, for a person at a terminal


class FoxgloveConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The `foxglove` part of a deployment file."""

    port: Annotated[int, Meta(ge=0, le=65535)] = 8765  # on loopback
    origins: tuple[str, ...] = ()  # of web viewers that may connect, beside those that are known
    secret: str = ""  # the file of the secret to steer; one in the user's state folder without


class EmulatorConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The settings of the emulator process."""

    body: str
    world: str = "arena"
    seed: Seed = 0
    folder: str  # where its ports appear


class RecorderConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The `recorder` part of a deployment file."""

    folder: str = ""  # where the files go; the user's state folder without
    file: str = ""  # one file by name instead
    topics: tuple[str, ...] = ()  # names or key expressions; all without
    viewers: bool = True  # also what Foxglove, Lichtblick and Rerun draw
    split_mb: Annotated[float, Meta(gt=0)] | None = None  # begin a new file after so much
    split_s: Annotated[float, Meta(gt=0)] | None = None  # or after so long [s]
    flush_s: Annotated[float, Meta(gt=0, le=10)] = 0.25  # what dies with the process at most [s]
    queue_mb: Annotated[float, Meta(gt=0)] = 32  # what waits for a slow disk before drops begin
    keep_free_mb: Annotated[float, Meta(ge=0)] = 200  # of the disk, for all that is not a recording
    notes: dict[str, str] = {}  # kept in the file, for replay
