"""ROS 2 message types: encodes and decodes CDR, hashes types, and makes messages.

Messages are instances of dataclasses that rosbags generates; arrays of numbers are numpy arrays.
Definitions come from rosbags (Jazzy), `definitions/`, and the user's files.
"""

import difflib
import struct
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.base import TypesysError, normalize_fieldname

from gigabrain_zenoh.errors import BadPayload, ConfigError, UnknownName
from gigabrain_zenoh.ros2.type_files import SHIPPED, Definition, Fields, Found, read_files
from gigabrain_zenoh.ros2.type_hash import rihs01
from gigabrain_zenoh.ros2.type_values import Values, is_text, literal

DEFAULTS: dict[str, dict[str, Any]] = {  # for types of rosbags, which has no default values
    "geometry_msgs/msg/Quaternion": {"w": 1.0},
    "sensor_msgs/msg/NavSatStatus": {"status": -2},
}
MAX_PAYLOAD = 64 << 20  # bytes of one message
MAX_COMMAND = 64 << 10  # bytes of one command or request; a goal has 150
MIN_VIEW_BYTES = 1 << 16  # a copy of a shorter payload is cheaper than a view


class Types:
    """All message, service and action types that this process knows."""

    def __init__(self, more: Iterable[Path] = ()) -> None:
        """Load all definitions; `more` are the user's files or folders. Raises ConfigError."""
        self._store: Any = get_typestore(Stores.ROS2_JAZZY)
        self._interfaces: dict[str, Fields] = {}  # services and actions
        self._hashes: dict[str, str] = {}
        self._defaults = dict(DEFAULTS)
        self._values = Values(self._store, self._defaults)
        for found in (read_files([SHIPPED]), read_files(more)):
            self._add(found)

    def known(self, name: str) -> str:
        """Return `name`. Raises UnknownName, a ConfigError, if there is no such message type."""
        if name not in self._store.fielddefs:
            close = difflib.get_close_matches(name, self._store.fielddefs, n=1)
            hint = f"did you mean {close[0]!r}?" if close else "add its definition by `types:`"
            raise UnknownName(f"no ROS message type {name!r}; {hint}", value=name)
        return name

    def messages(self) -> tuple[str, ...]:
        """Return the names of all message types."""
        return tuple(sorted(self._store.fielddefs))

    def encode(self, name: str, message: object) -> bytes:
        """Return the message as little-endian CDR, with its 4-byte header."""
        return bytes(self._store.serialize_cdr(message, self.known(name), little_endian=True))

    def decode(self, name: str, payload: bytes) -> Any:
        """Return the message in a payload; ignores padding, and bytes after the message.

        Arrays of numbers are views of the payload. Raises only BadPayload, for any payload.
        """
        return decoded(self._store, self.known(name), payload)

    def decode_command(self, name: str, payload: bytes, max_bytes: int = MAX_COMMAND) -> Any:
        """Decode a command or request of limited size, because a large one would block others.

        Raises only BadPayload, for any payload.
        """
        if len(payload) > max_bytes:
            raise BadPayload(f"{name}: {len(payload)} bytes; expected at most {max_bytes}")
        return self.decode(name, payload)

    def make(self, name: str, /, **fields: Any) -> Any:
        """Make a message. Omitted fields get their defaults, also in nested messages.

        Lists of numbers, and mappings in place of messages, are converted; other values are not.
        Raises ConfigError for an unknown type or field.
        """
        return self._values.make(self.known(name), fields)

    def from_dict(self, name: str, data: Mapping[str, Any]) -> Any:
        """Check JSON values, and make a message. Raises BadPayload, which names the field."""
        return self._values.from_dict(self.known(name), data)

    def to_dict(self, message: object) -> dict[str, Any]:
        """Return the message as JSON values: bytes as base64, NaN and Infinity as strings."""
        return self._values.to_dict(message)

    def known_part(self, name: str, data: Mapping[str, Any]) -> dict[str, Any]:
        """Return the JSON values without unknown fields, also in nested messages."""
        return self._values.known_part(self.known(name), data)

    def only_text(self, name: str) -> str:
        """Return the name of a type's only field if that is a string; otherwise an empty string."""
        field, kind = self.fields(name)[0]
        return field if len(self.fields(name)) == 1 and is_text(kind) else ""

    def definition(self, name: str) -> str:
        """Return a message's definition with all nested ones, in the format of bags and viewers."""
        text: str = self._store.generate_msgdef(self.known(name), ros_version=2)[0]
        return text

    def hash(self, name: str) -> str:
        """Return `RIHS01_…` of a message, service or action. Raises ConfigError if unknown."""
        if name not in self._hashes:
            self._hashes[name] = rihs01(name, self._fields)
        return self._hashes[name]

    def fields(self, name: str) -> Fields:
        """Return rosbags' description of the fields of a message type. Raises ConfigError."""
        fields: Fields = self._store.fielddefs[self.known(name)][1]
        return fields

    def _fields(self, name: str) -> Fields:
        fields = self._interfaces.get(name)
        return self.fields(name) if fields is None else fields

    def _add(self, found: Found) -> None:
        messages = found.messages
        try:
            self._store.register(
                {name: (each.constants, each.fields) for name, each in messages.items()}
            )
        except TypesysError as error:
            raise ConfigError(f"types: {error}; rename the type") from None
        self._interfaces |= found.interfaces
        for name, each in messages.items():
            if defaults := self._checked_defaults(each):
                self._defaults[name] = defaults
            try:
                self.hash(name)
            except ConfigError as error:
                raise ConfigError(f"{each.file}: a field of {name}: {error}") from None

    def _checked_defaults(self, definition: Definition) -> dict[str, Any]:
        """Return a definition's defaults by attribute; check its constants as well."""
        kinds = dict(definition.fields)
        try:
            for name, primitive, value in definition.constants:
                if primitive != "string":  # an unquoted string may look like a number
                    literal((primitive, 0), value, f"constant {name}")
            return {
                normalize_fieldname(field): self._values.default(
                    kinds[field], value, f"default of {field}"
                )
                for field, value in definition.defaults.items()
            }
        except BadPayload as error:
            raise ConfigError(f"{definition.file}: {error}") from None


def decoded(store: Any, name: str, payload: bytes) -> Any:
    """Return the message in a payload, by a type store of rosbags. Raises only BadPayload."""
    if not 4 <= len(payload) <= MAX_PAYLOAD or payload[0] or payload[1] > 1:
        raise BadPayload(f"{name}: not CDR: {len(payload)} bytes, {payload[:4].hex()}…")
    definition = store.get_msgdef(name)
    read = definition.deserialize_cdr_le if payload[1] else definition.deserialize_cdr_be
    try:
        return read(_body(payload), 0, definition.cls, store)[0]
    except (SerdeError, struct.error, ValueError) as error:
        raise BadPayload(f"{name}: {error}") from None


def _body(payload: bytes) -> bytes | memoryview:
    """Return the payload without its header: a copy, or a view if that is cheaper."""
    return payload[4:] if len(payload) < MIN_VIEW_BYTES else memoryview(payload)[4:]
