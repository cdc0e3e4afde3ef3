"""The model of a body's arm as text that needs no other file.

A body on wheels may take its arm from another body's model, by MJCF's `<attach>`. This is done here
as MuJoCo does it, without MuJoCo: a driver on its real link does without the simulator.
"""

from collections.abc import Collection
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from gigabrain_schemas.body import MAX_MODEL_CHARACTERS
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import read_bounded

MAIN = "main"  # what MuJoCo calls defaults without a class
NAMES = (
    "name", "class", "childclass", "joint", "joint1", "joint2", "body", "body1", "body2",
    "geom", "geom1", "geom2", "site", "material", "tendon", "target", "objname",
)  # fmt: skip
TAKEN = ("contact", "equality", "tendon", "actuator")  # sections of an attached model
LEFT_OUT = ("asset", "sensor", "keyframe")
BASE = "base"


def arm_text(path: Path, joints: Collection[str]) -> str:
    """Return the model of an arm with these joints. Raises ConfigError.

    One that attaches others comes with them, and without what neither moves with the joints nor is
    part of the base, such as wheels: the base's own shapes stand for them.
    """
    root = _parsed(path)
    models = {one.get("name"): one.get("file", "") for one in root.iterfind("asset/model")}
    places = [(above, one) for above in root.iter() for one in above.findall("attach")]
    if not places:
        return _text(path)
    for above, attach in places:
        if (file := models.get(attach.get("model"))) is None:
            raise ConfigError(f"{path}: <attach>: no model {attach.get('model')!r} in its assets")
        _attach(root, above, attach, path.parent / file)
    _reduce(root, joints, path)
    return ElementTree.tostring(root, encoding="unicode")


def link_names(path: Path, joints: Collection[str]) -> list[str]:
    """Return the bodies of the model of an arm, without its base. Raises ConfigError."""
    try:
        bodies = ElementTree.fromstring(arm_text(path, joints)).iter("body")
    except ElementTree.ParseError as error:
        raise _no_xml(path, error) from None
    return [name for body in bodies if (name := body.get("name", "")) not in ("", BASE)]


def _attach(root: Element, above: Element, attach: Element, path: Path) -> None:
    """Put the body of another model in the place of an `attach` element."""
    child, prefix = _parsed(path), attach.get("prefix", "")
    for element in child.iter():
        for name in NAMES:
            if name in element.attrib:
                element.set(name, prefix + element.attrib[name])
    wanted = prefix + attach.get("body", "")
    body = next((one for one in child.iter("body") if one.get("name") == wanted), None)
    if body is None:
        raise ConfigError(f"{path}: no body {attach.get('body')!r} to attach")
    main = prefix + MAIN
    body.set("childclass", main)
    above[list(above).index(attach)] = body
    for default in child.findall("default"):
        default.set("class", main)
        _section(root, "default").append(default)
    for section in TAKEN:
        for one in child.iterfind(f"{section}/*"):
            if section == "actuator":
                one.attrib.setdefault("class", main)
            _section(root, section).append(one)


def _reduce(root: Element, joints: Collection[str], path: Path) -> None:
    """Leave out bodies that the arm's joints do not move, and what refers to them."""
    base = root.find(f"worldbody/body[@name='{BASE}']")
    if base is None:
        raise ConfigError(f"{path}: no body {BASE!r} in the worldbody")
    for name in ("freejoint", "body"):
        for one in base.findall(name):
            if not any(joint.get("name") in joints for joint in one.iter("joint")):
                base.remove(one)
    for motors in root.findall("actuator"):
        for one in list(motors):
            if one.get("joint") not in joints:
                motors.remove(one)
    for name in LEFT_OUT:
        for section in root.findall(name):
            root.remove(section)


def _section(root: Element, name: str) -> Element:
    found = root.find(name)
    return ElementTree.SubElement(root, name) if found is None else found


def _text(path: Path) -> str:
    try:
        return read_bounded(path, MAX_MODEL_CHARACTERS).decode()
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: the model of the arm: {error}") from None


def _parsed(path: Path) -> Element:
    try:
        return ElementTree.fromstring(_text(path))
    except ElementTree.ParseError as error:
        raise _no_xml(path, error) from None


def _no_xml(path: Path, error: ElementTree.ParseError) -> ConfigError:
    return ConfigError(f"{path}: the model of the arm is no XML: {error}")
