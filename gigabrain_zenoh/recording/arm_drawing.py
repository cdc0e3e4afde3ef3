"""Draws an arm for viewers: its shapes once, and the frames of its links for each state."""

import logging
from collections.abc import Iterable

from foxglove import messages as fox

from gigabrain_schemas.body import ArmModel, RobotState
from gigabrain_schemas.brain import ArmPlan, GraspPose
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.geometry.link_model import LinkModel, Place, Quaternion, Shape, Vector, rotated
from gigabrain_zenoh.recording.drawn import BASE, BLUE, Drawn, KnownEntities, as_drawn, stamp

log = logging.getLogger(__name__)
LINKS = "arm/"  # prefix of the names of the links' frames
PATH_M, ARROW_M, ARROW_WIDTH_M = 0.004, 0.05, 0.006
GREY = fox.Color(r=0.5, g=0.5, b=0.5, a=0.6)


class ArmDrawing:
    """The arm of the newest model."""

    def __init__(self) -> None:
        self._model: LinkModel | None = None
        self._drawn, self._planned = KnownEntities(), KnownEntities()

    def draw_model(self, model: ArmModel, _: str) -> Iterable[Drawn]:
        """Draw the shapes of each link in its own frame; log a model that cannot be read."""
        try:
            self._model = LinkModel(model.mjcf)
        except ConfigError as error:
            self._model = None
            log.warning("%s", error)
            return
        entities = {
            self._frame(link): _entity(model, self._frame(link), shapes)
            for link in range(len(self._model.links))
            if (shapes := [shape for shape in self._model.shapes if shape.link == link])
        }
        yield as_drawn("arm", self._drawn.update(model, entities))

    def draw_joints(self, state: RobotState) -> Iterable[Drawn]:
        """Draw the frame of each link in the frame of its parent, at the measured positions."""
        if self._model is None or not state.joints:
            return
        places = self._model.places({joint.name: joint.position for joint in state.joints})
        frames = [
            fox.FrameTransform(
                timestamp=stamp(state),
                parent_frame_id=self._frame(link.parent),
                child_frame_id=f"{LINKS}{link.name}",
                translation=_vector(place.position),
                rotation=_quaternion(place.rotation),
            )
            for link, place in zip(self._model.links, places, strict=True)
            if link.parent >= 0
        ]
        yield as_drawn("arm_tf", fox.FrameTransforms(transforms=frames))

    def draw_plan(self, plan: ArmPlan, _: str) -> Iterable[Drawn]:
        """Draw the path of the tool, and an arrow for each grasp; the chosen one is blue."""
        points = [fox.Point3(x=x, y=y, z=z) for x, y, z in plan.points().tolist()]
        line = fox.LinePrimitive(
            type=fox.LinePrimitiveLineType.LineStrip, thickness=PATH_M, points=points, color=BLUE
        )
        colours = [BLUE, *[GREY] * len(plan.grasps)]
        arrows = [_arrow(*each) for each in zip(plan.grasps, colours, strict=False)]
        entity = fox.SceneEntity(
            timestamp=stamp(plan), frame_id=BASE, id="arm plan", arrows=arrows,
            lines=[line] if points else [],
        )  # fmt: skip
        yield as_drawn("arm_plan", self._planned.update(plan, {"arm plan": entity}))

    def _frame(self, link: int) -> str:
        assert self._model
        return f"{LINKS}{self._model.links[link].name}" if link else BASE


def _entity(at: ArmModel, frame: str, shapes: list[Shape]) -> fox.SceneEntity:
    """Draw the shapes of a link, in its frame."""
    return fox.SceneEntity(
        timestamp=stamp(at), frame_id=frame, id=frame, frame_locked=True,
        cubes=[
            fox.CubePrimitive(
                pose=_pose(shape.place), size=_doubled(*shape.size), color=_colour(shape)
            )
            for shape in shapes if shape.kind == "box"
        ],
        cylinders=[
            _cylinder(shape) for shape in shapes if shape.kind in ("cylinder", "capsule")
        ],
        spheres=[sphere for shape in shapes for sphere in _spheres(shape)],
    )  # fmt: skip


def _arrow(grasp: GraspPose, colour: fox.Color) -> fox.ArrowPrimitive:
    """Draw an arrow along the approach that ends at the tool."""
    x, y, z, w = grasp.orientation
    along = rotated((w, x, y, z), (ARROW_M, 0.0, 0.0))
    tail = fox.Vector3(**{
        axis: tip - step for axis, tip, step in zip("xyz", grasp.position, along, strict=True)
    })  # fmt: skip
    return fox.ArrowPrimitive(
        pose=fox.Pose(position=tail, orientation=_quaternion((w, x, y, z))),
        shaft_length=0.7 * ARROW_M, shaft_diameter=ARROW_WIDTH_M, head_length=0.3 * ARROW_M,
        head_diameter=2 * ARROW_WIDTH_M, color=colour,
    )  # fmt: skip


def _cylinder(shape: Shape) -> fox.CylinderPrimitive:
    radius, half, _ = shape.size
    return fox.CylinderPrimitive(
        pose=_pose(shape.place), size=_doubled(radius, radius, half), color=_colour(shape),
        top_scale=1.0, bottom_scale=1.0,
    )  # fmt: skip


def _spheres(shape: Shape) -> Iterable[fox.SpherePrimitive]:
    """Yield a sphere, an ellipsoid, or both ends of a capsule; nothing for other shapes."""
    radius, half, _ = shape.size
    size, places = _doubled(radius, radius, radius), list[Place]()
    if shape.kind == "capsule":
        places = [shape.place @ Place((0.0, 0.0, end)) for end in (-half, half)]
    elif shape.kind in ("sphere", "ellipsoid"):
        places = [shape.place]
        size = size if shape.kind == "sphere" else _doubled(*shape.size)
    for place in places:
        yield fox.SpherePrimitive(pose=_pose(place), size=size, color=_colour(shape))


def _pose(place: Place) -> fox.Pose:
    return fox.Pose(position=_vector(place.position), orientation=_quaternion(place.rotation))


def _vector(of: Vector) -> fox.Vector3:
    return fox.Vector3(x=of[0], y=of[1], z=of[2])


def _quaternion(of: Quaternion) -> fox.Quaternion:
    return fox.Quaternion(w=of[0], x=of[1], y=of[2], z=of[3])


def _doubled(x: float, y: float, z: float) -> fox.Vector3:
    return fox.Vector3(x=2 * x, y=2 * y, z=2 * z)


def _colour(shape: Shape) -> fox.Color:
    r, g, b, a = shape.colour
    return fox.Color(r=r, g=g, b=b, a=a)
