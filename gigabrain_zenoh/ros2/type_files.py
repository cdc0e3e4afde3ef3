"""Reads .msg, .srv and .action files into field definitions of rosbags.

The messages of a service, and the services and topics of an action, are derived as in `rosidl`.
"""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from rosbags.interfaces import Nodetype
from rosbags.typesys.base import TypesysError, create_field_desc
from rosbags.typesys.msg import MSGParser

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import cannot_read

Description = tuple[Any, Any]  # rosbags' description of a type: (Nodetype, its parameters)
Fields = list[tuple[str, Description]]
SHIPPED = Path(__file__).parent / "definitions"
KINDS = ("msg", "srv", "action")
PARTS = {
    "msg": ("",),
    "srv": ("_Request", "_Response"),
    "action": ("_Goal", "_Result", "_Feedback"),
}
UUID = "unique_identifier_msgs/msg/UUID"
TIME = "builtin_interfaces/msg/Time"
EVENT_INFO = "service_msgs/msg/ServiceEventInfo"
DUMMY = "structure_needs_at_least_one_member"  # field of an empty message, also on the wire


class Definition(NamedTuple):
    """One message type."""

    constants: list[tuple[str, str, Any]]  # name, type, value
    fields: Fields
    defaults: dict[str, Any]  # by field, if it has one; unchecked, as the constants are
    file: Path


class Found(NamedTuple):
    """All types in a number of files."""

    messages: dict[str, Definition]
    interfaces: dict[str, Fields]  # services and actions, with the fields that `rosidl` hashes


def base(name: str) -> Description:
    """Return the description of a field of a primitive type."""
    return (Nodetype.BASE, (name, 0))


def named(name: str) -> Description:
    """Return the description of a field of a message type."""
    return (Nodetype.NAME, name)


def read_files(paths: Iterable[Path]) -> Found:
    """Read files, and all files in folders. Raises ConfigError."""
    found = Found({}, {})
    for path in paths:
        for file in _files(path):
            for name, text in _parts(file):
                found.messages[name] = _parse(name, text, file)
            _derive(file, found)
    return found


def _files(path: Path) -> Iterator[Path]:
    if path.is_dir():
        found = sorted(each for kind in KINDS for each in path.rglob(f"*.{kind}"))
        if not found:
            raise ConfigError(f"{path}: no .msg, .srv or .action file in this folder")
        yield from found
    elif path.suffix[1:] in KINDS and path.is_file():
        yield path
    else:
        raise ConfigError(f"{path}: expected a .msg, .srv or .action file, or a folder of them")


def _name_of(file: Path) -> str:
    """Return the type's name: `my_msgs/msg/A` for my_msgs/msg/A.msg or my_msgs/A.msg."""
    kind, folder = file.suffix[1:], file.resolve().parent
    package = folder.parent.name if folder.name == kind else folder.name
    return f"{package}/{kind}/{file.stem}"


def _parts(file: Path) -> Iterator[tuple[str, str]]:
    """Yield (name, text) of each message in a file."""
    kind = file.suffix[1:]
    try:
        text = file.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise cannot_read(file, error) from None
    except UnicodeDecodeError:
        raise ConfigError(f"{file}: expected UTF-8 text") from None
    texts: list[str] = [""]
    for line in text.splitlines():
        if line.split("#")[0].strip() == "---":
            texts.append("")
        else:
            texts[-1] += line + "\n"
    endings = PARTS[kind]
    if len(texts) != len(endings):
        raise ConfigError(f"{file}: expected {len(endings)} parts between ---, got {len(texts)}")
    for ending, part in zip(endings, texts, strict=True):
        yield _name_of(file) + ending, part


def _parse(name: str, text: str, file: Path) -> Definition:
    package, _, short = name.split("/")
    try:  # parsed as a message, so that a bare type name means a message of this package
        (message,) = MSGParser(f"MSG: {package}/msg/{short}\n{text}").specification()
    except TypesysError as error:
        line = str(error).splitlines()[-1] if str(error).splitlines() else ""
        raise ConfigError(f"{file}: no ROS message definition, near {line[:60]!r}") from None
    except (AssertionError, ValueError) as error:  # from rosbags' parser and int()
        raise ConfigError(f"{file}: {str(error) or 'a constant is a list'}") from None
    if wrong := [each.name for each in message.fields if min(each.typ.size, each.typ.str_size) < 0]:
        raise ConfigError(f"{file}: {wrong[0]}: expected a size of 0 or more")
    fields = [(each.name, create_field_desc(each.typ)) for each in message.fields]
    return Definition(
        [(each.name, each.typ.value, each.value) for each in message.constants],
        fields or [(DUMMY, base("uint8"))],
        {each.name: each.value for each in message.fields if each.value is not None},
        file,
    )


def _derive(file: Path, found: Found) -> None:
    """Add the types that `rosidl` derives from a service or an action."""
    name, kind = _name_of(file), file.suffix[1:]
    if kind == "srv":
        _derive_service(name, file, found)
    if kind != "action":
        return
    derived: dict[str, Fields] = {
        "_SendGoal_Request": [("goal_id", named(UUID)), ("goal", named(f"{name}_Goal"))],
        "_SendGoal_Response": [("accepted", base("bool")), ("stamp", named(TIME))],
        "_GetResult_Request": [("goal_id", named(UUID))],
        "_GetResult_Response": [("status", base("int8")), ("result", named(f"{name}_Result"))],
        "_FeedbackMessage": [("goal_id", named(UUID)), ("feedback", named(f"{name}_Feedback"))],
    }
    for ending, fields in derived.items():
        found.messages[name + ending] = Definition([], fields, {}, file)
    _derive_service(f"{name}_SendGoal", file, found)
    _derive_service(f"{name}_GetResult", file, found)
    found.interfaces[name] = [
        ("goal", named(f"{name}_Goal")),
        ("result", named(f"{name}_Result")),
        ("feedback", named(f"{name}_Feedback")),
        ("send_goal_service", named(f"{name}_SendGoal")),
        ("get_result_service", named(f"{name}_GetResult")),
        ("feedback_message", named(f"{name}_FeedbackMessage")),
    ]


def _derive_service(name: str, file: Path, found: Found) -> None:
    request, response = named(f"{name}_Request"), named(f"{name}_Response")
    found.messages[f"{name}_Event"] = Definition(
        [],
        [
            ("info", named(EVENT_INFO)),
            ("request", (Nodetype.SEQUENCE, (request, 1))),
            ("response", (Nodetype.SEQUENCE, (response, 1))),
        ],
        {},
        file,
    )
    found.interfaces[name] = [
        ("request_message", request),
        ("response_message", response),
        ("event_message", named(f"{name}_Event")),
    ]
