"""The frames of an arm for ROS: one joint per link, and their poses."""

from collections.abc import Collection, Iterator, Mapping
from typing import NamedTuple

from gigabrain_schemas.body import BodyDescription, JointDescription, RobotState
from gigabrain_zenoh.gateway.conversions.frames import BASE, Placed, camera_frames
from gigabrain_zenoh.geometry.link_model import (
    Follower,
    Link,
    LinkJoint,
    LinkModel,
    Place,
    moved,
)

HERE = Place()


class Mimic(NamedTuple):
    """Mimic joint: its position is `multiplier` times that of `joint`, plus `offset`."""

    joint: str
    multiplier: float
    offset: float  # [rad] or [m]


class ArmJoint(NamedTuple):
    """A joint that turns about an axis of its frame, or slides along one."""

    about: LinkJoint
    limits: JointDescription  # of the leading joint, for a mimic joint
    mimic: Mimic | None = None

    def position(self, positions: Mapping[str, float]) -> float:
        """Return its position [rad] or [m], from measured `positions`."""
        mimic = self.mimic
        if mimic and mimic.joint in positions and self.about.name not in positions:
            return mimic.multiplier * positions[mimic.joint] + mimic.offset
        return positions.get(self.about.name, self.about.rest)


class ArmFrame(NamedTuple):
    """A frame in its parent frame, at joint position 0."""

    name: str
    parent: str
    place: Place
    joint: ArmJoint | None = None  # at its origin
    link: int = -1  # of the model, whose shapes it has; -1: none


class ArmFrames:
    """The frames of one arm's model."""

    def __init__(self, model: LinkModel, about: BodyDescription, taken: Collection[str]) -> None:
        """Make the frames; links with names in `taken` get other names."""
        self.model, self._about, self._taken = model, about, taken
        self._followers = {one.name: one for one in model.followers}
        self._limits = {joint.name: joint for joint in about.joints}
        self._rests = {one.name: one.rest for link in model.links for one in link.joints}
        self._names = {0: BASE}  # of the frames of links, by the links' numbers
        self.frames = tuple(self._of_links())
        names = {model.links[number].name: name for number, name in self._names.items()}
        self.cameras = tuple(
            frame
            for camera in about.cameras
            if camera.link and camera.link in names
            for frame in camera_frames(camera, names[camera.link])
        )

    def static(self) -> list[Placed]:
        """Return the frames that are fixed to their parents."""
        own = [_placed(one, one.place) for one in self.frames if one.joint is None]
        return [*own, *self.cameras]

    def moving(self, state: RobotState) -> list[Placed]:
        """Return the moving frames, from the measured joints."""
        at = {joint.name: joint.position for joint in state.joints}
        return [
            _placed(one, one.place @ moved(one.joint.about, one.joint.position(at)))
            for one in self.frames
            if one.joint
        ]

    def _of_links(self) -> Iterator[ArmFrame]:
        names = self._names
        parents = {link.parent for link in self.model.links}
        carriers = {shape.link for shape in self.model.every_shape}
        needed = {one.link for one in self._about.cameras if one.link}  # other sites are of sensors
        if self._about.arm:
            needed.add(self._about.arm.tool)
        for number, link in enumerate(self.model.links[1:], 1):
            if number in parents | carriers or link.joints or link.name in needed:
                names[number] = self._own_name(link.name)
                yield from self._of_link(number, link, names[number], names[link.parent])

    def _of_link(self, number: int, link: Link, name: str, parent: str) -> Iterator[ArmFrame]:
        """Yield the frame of each joint, and the link's own frame if it differs."""
        place = link.place
        known = [(one, joint) for one in link.joints if (joint := self._joint(one))]
        for about, joint in known:
            at = place @ Place(about.anchor) @ moved(about, -about.rest)
            here = (about, joint) == known[-1] and about.anchor == HERE.position
            own = name if here else self._own_name(f"{name}_{about.name}")
            yield ArmFrame(own, parent, at, joint, number if here else -1)
            parent, place = own, Place((-about.anchor[0], -about.anchor[1], -about.anchor[2]))
        if parent != name:
            yield ArmFrame(name, parent, place, link=number)

    def _joint(self, about: LinkJoint) -> ArmJoint | None:
        """Return a measured joint or its mimic; None for others."""
        if about.name in self._limits:
            return ArmJoint(about, self._limits[about.name])
        follower = self._followers.get(about.name)
        if follower is None or follower.leader not in self._limits:
            return None
        return ArmJoint(about, self._limits[follower.leader], self._mimic(about, follower))

    def _mimic(self, about: LinkJoint, follower: Follower) -> Mimic:
        """Return the linear part of how a joint follows; ROS knows no other."""
        shift, slope = (*follower.polynomial, 0.0, 0.0)[:2]
        offset = about.rest + shift - slope * self._rests[follower.leader]
        return Mimic(follower.leader, slope, offset)

    def _own_name(self, name: str) -> str:
        plain = name.replace(" ", "_")
        return f"arm_{plain}" if plain in self._taken else plain


def _placed(frame: ArmFrame, at: Place) -> Placed:
    w, x, y, z = at.rotation
    return Placed(frame.parent, frame.name, *at.position, (x, y, z, w))
