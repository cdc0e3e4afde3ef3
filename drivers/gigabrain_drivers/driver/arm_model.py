"""The model of a body's arm as text that needs no other file.

A body on wheels may attach the arm of another model, by MJCF's `<attach>`. This module attaches it
as MuJoCo does, but without MuJoCo: a driver on its real link needs no simulator.
"""

from collections.abc import Collection
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from gigabrain_schemas.body import MAX_MODEL_CHARACTERS
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import file_problem, read_bounded

DEFAULT_CLASS = "main"  # MuJoCo's name of defaults without a class
NAME_ATTRIBUTES = (
    "name", "class", "childclass", "joint", "joint1", "joint2", "body", "body1", "body2",
    "geom", "geom1", "geom2", "site", "material", "tendon", "target", "objname",
)  # fmt: skip
MERGED_SECTIONS = ("contact", "equality", "tendon", "actuator")  # of an attached model
DROPPED_SECTIONS = ("asset", "sensor", "keyframe")
BASE = "base"


def arm_text(path: Path, joints: Collection[str]) -> str:
    """Return the model of an arm with these joints. Raises ConfigError.

    Attached models are merged into it. Then bodies are left out that neither move with the joints
    nor are the base, such as wheels: the base's own shapes stand for them.
    """
    root = _parse(path)
    models = {each.get("name"): each.get("file", "") for each in root.iterfind("asset/model")}
    attachments = [(parent, each) for parent in root.iter() for each in parent.findall("attach")]
    if not attachments:
        return _read_text(path)
    for parent, attach in attachments:
        if (file := models.get(attach.get("model"))) is None:
            raise ConfigError(f"{path}: <attach>: no model {attach.get('model')!r} in its assets")
        _attach(root, parent, attach, path.parent / file)
    _drop_unmoved(root, joints, path)
    return ElementTree.tostring(root, encoding="unicode")


def link_names(path: Path, joints: Collection[str]) -> list[str]:
    """Return the names of the bodies in an arm's model, except its base. Raises ConfigError."""
    try:
        bodies = ElementTree.fromstring(arm_text(path, joints)).iter("body")
    except ElementTree.ParseError as error:
        raise _parse_error(path, error) from None
    return [name for body in bodies if (name := body.get("name", "")) not in ("", BASE)]


def _attach(root: Element, parent: Element, attach: Element, path: Path) -> None:
    """Replace an `attach` element by the body of another model."""
    child, prefix = _parse(path), attach.get("prefix", "")
    for element in child.iter():
        for name in NAME_ATTRIBUTES:
            if name in element.attrib:
                element.set(name, prefix + element.attrib[name])
    wanted = prefix + attach.get("body", "")
    body = next((element for element in child.iter("body") if element.get("name") == wanted), None)
    if body is None:
        raise ConfigError(f"{path}: no body {attach.get('body')!r} to attach")
    default_class = prefix + DEFAULT_CLASS
    body.set("childclass", default_class)
    parent[list(parent).index(attach)] = body
    for default in child.findall("default"):
        default.set("class", default_class)
        _section(root, "default").append(default)
    for section in MERGED_SECTIONS:
        for element in child.iterfind(f"{section}/*"):
            if section == "actuator":
                element.attrib.setdefault("class", default_class)
            _section(root, section).append(element)


def _drop_unmoved(root: Element, joints: Collection[str], path: Path) -> None:
    """Remove bodies that the arm's joints do not move, and the elements that refer to them."""
    base = root.find(f"worldbody/body[@name='{BASE}']")
    if base is None:
        raise ConfigError(f"{path}: no body {BASE!r} in the worldbody")
    for name in ("freejoint", "body"):
        for element in base.findall(name):
            if not any(joint.get("name") in joints for joint in element.iter("joint")):
                base.remove(element)
    for motors in root.findall("actuator"):
        for element in list(motors):
            if element.get("joint") not in joints:
                motors.remove(element)
    for name in DROPPED_SECTIONS:
        for section in root.findall(name):
            root.remove(section)


def _section(root: Element, name: str) -> Element:
    found = root.find(name)
    return ElementTree.SubElement(root, name) if found is None else found


def _read_text(path: Path) -> str:
    try:
        return read_bounded(path, MAX_MODEL_CHARACTERS).decode()
    except OSError as error:
        raise ConfigError(f"{path}: the model of the arm: {file_problem(error)}") from None
    except ValueError as error:
        raise ConfigError(f"{path}: the model of the arm: {error}") from None


def _parse(path: Path) -> Element:
    try:
        return ElementTree.fromstring(_read_text(path))
    except ElementTree.ParseError as error:
        raise _parse_error(path, error) from None


def _parse_error(path: Path, error: ElementTree.ParseError) -> ConfigError:
    return ConfigError(f"{path}: the model of the arm is no XML: {error}")
