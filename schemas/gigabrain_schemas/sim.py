"""A simulated world, for viewers: its shapes and their poses, and requests to change it."""

from typing import Annotated, Literal, get_args

from msgspec import Meta

from gigabrain_schemas.base import Coordinate, Count, Key, Message, Name, Pose, Record, Text
from gigabrain_schemas.base import array_meta as array

MAX_SHAPES, MAX_BODIES = 20_000, 1_000
MAX_MESHES, MAX_MESH_BYTES = 1_000, 4 * 1024 * 1024  # of a scene; bytes of all meshes together
ShapeKind = Literal["plane", "box", "cylinder", "sphere", "capsule", "ellipsoid", "mesh"]
SHAPE_KINDS: tuple[ShapeKind, ...] = get_args(ShapeKind)
ThingKind = Literal["box", "cylinder", "person"]
Extent = Annotated[float, Meta(ge=0.02, le=20.0)]  # [m]
ThingName = Annotated[str, Meta(pattern=r"^(\w[\w-]*)?$(?!\n)", max_length=32)]
SceneName = Annotated[str, Meta(max_length=128)]


class SceneMesh(Record, frozen=True, kw_only=True):
    """A mesh of triangles, in its own frame."""

    vertices: Annotated[bytes, array(MAX_MESH_BYTES, "float32", ("n", 3), "m")]
    faces: Annotated[bytes, array(MAX_MESH_BYTES, "uint32", ("m", 3))]  # indices of vertices


class Thing(Record, frozen=True, kw_only=True):
    """An object that a person added to a simulated world, in the world's frame."""

    kind: ThingKind = "box"
    name: ThingName = ""  # if empty in a request, one is chosen
    x: Coordinate = 0.0  # [m]
    y: Coordinate = 0.0  # [m]
    yaw: Annotated[float, Meta(ge=-10.0, le=10.0)] = 0.0  # [rad]
    size: tuple[Extent, Extent, Extent] = (0.3, 0.3, 0.5)
    # [m], along its own x and y, and height; x and y are a cylinder's diameter; not for persons
    path: Annotated[tuple[tuple[Coordinate, Coordinate], ...], Meta(max_length=16)] = ()
    # [m], points that a person walks to, and back; empty: the person stands
    speed: Annotated[float, Meta(ge=0.05, le=3.0)] = 0.8  # [m/s], of a person


class SimScene(Message, frozen=True, kw_only=True):
    """The shapes of a simulated world, for viewers. The robot itself does not use them.

    Body 0 does not move; the newest SimPoses of this version has the poses of the others. A thing
    and its body have the same name.
    """

    version: Count  # number of changes
    world: Key  # name or file
    bodies: Annotated[tuple[SceneName, ...], Meta(min_length=1, max_length=MAX_BODIES)]
    kinds: Annotated[bytes, array(MAX_SHAPES, "uint8", ("n",))]  # indices in SHAPE_KINDS
    owners: Annotated[bytes, array(2 * MAX_SHAPES, "uint16", ("n",))]  # indices in `bodies`
    sizes: Annotated[bytes, array(12 * MAX_SHAPES, "float32", ("n", 3), "m")]
    # [m], half sizes of a box or an ellipsoid; radius and half length; index of a mesh
    places: Annotated[bytes, array(28 * MAX_SHAPES, "float32", ("n", 7), "m")]
    # [m], in the frame of its body: x, y, z, and a quaternion w, x, y, z
    colours: Annotated[bytes, array(4 * MAX_SHAPES, "uint8", ("n", 4))]  # red, green, blue, alpha
    meshes: Annotated[tuple[SceneMesh, ...], Meta(max_length=MAX_MESHES)] = ()
    things: Annotated[tuple[Thing, ...], Meta(max_length=64)] = ()

    def __post_init__(self) -> None:
        count = len(self.kinds)
        for name, width in (("owners", 2), ("sizes", 12), ("places", 28), ("colours", 4)):
            if len(getattr(self, name)) != width * count:
                raise ValueError(f"{name} needs {width} bytes for each of {count} kinds")


class SimPoses(Message, frozen=True, kw_only=True):
    """The true poses of the bodies of a SimScene. The robot itself does not use them."""

    version: Count  # of the scene
    poses: Annotated[bytes, array(28 * MAX_BODIES, "float32", ("n", 7), "m")]
    # [m], of bodies[1:]: x, y, z, and a quaternion w, x, y, z


class SimRequest(Message, frozen=True, kw_only=True):
    """Add a thing to a simulated world, or remove one. An empty request lists all."""

    do: Literal["list", "add", "remove"] = "list"
    thing: Thing | None = None  # to add
    name: Annotated[str, Meta(max_length=32)] = ""  # of the thing to remove
    source: Name = "anonymous"


class SimReply(Message, frozen=True, kw_only=True):
    """The answer to a SimRequest, with the present things."""

    ok: bool
    text: Text  # a sentence for people
    things: Annotated[tuple[Thing, ...], Meta(max_length=64)] = ()
    robot: Pose | None = None  # of the robot, in the world
