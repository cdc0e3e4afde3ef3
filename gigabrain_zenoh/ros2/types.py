"""Types of ROS 2 messages: their CDR, their hashes, and values made from Python's own.

Messages are instances of the dataclasses that rosbags generates; arrays of numbers are numpy
arrays. Definitions are those of Jazzy that rosbags brings, those in `definitions/`, and the user's.
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

DEFAULTS: dict[str, dict[str, Any]] = {  # of types in rosbags' store, which keeps none
    "geometry_msgs/msg/Quaternion": {"w": 1.0},
    "sensor_msgs/msg/NavSatStatus": {"status": -2},
}
MAX_PAYLOAD = 64 << 20  # bytes of one message
MAX_COMMAND = 64 << 10  # bytes of one that ROS commands or asks by; a goal takes 150
LARGE = 1 << 16  # bytes


class Types:
    """All message, service and action types that this process knows."""

    def __init__(self, more: Iterable[Path] = ()) -> None:
        """Load the definitions; `more` are files or folders of the user's. Raises ConfigError."""
        self._store: Any = get_typestore(Stores.ROS2_JAZZY)
        self._interfaces: dict[str, Fields] = {}  # services and actions
        self._hashes: dict[str, str] = {}
        self._defaults = dict(DEFAULTS)
        self._values = Values(self._store, self._defaults)
        for found in (read_files([SHIPPED]), read_files(more)):
            self._add(found)

    def known(self, name: str) -> str:
        """Return the name of a message type. Raises ConfigError if it is unknown."""
        if name not in self._store.fielddefs:
            close = difflib.get_close_matches(name, self._store.fielddefs, n=1)
            hint = f"did you mean {close[0]!r}?" if close else "add its definition by `types:`"
            raise UnknownName(f"no ROS message type {name!r}; {hint}", value=name)
        return name

    def messages(self) -> tuple[str, ...]:
        """Return the names of all message types."""
        return tuple(sorted(self._store.fielddefs))

    def encode(self, name: str, message: object) -> bytes:
        """Return the message as CDR, little-endian, with its header of 4 bytes."""
        return bytes(self._store.serialize_cdr(message, self.known(name), little_endian=True))

    def decode(self, name: str, payload: bytes) -> Any:
        """Return the message in a payload; ignores a tail and the content of padding.

        Arrays of numbers are views of the payload. Raises BadPayload, and nothing else.
        """
        return decoded(self._store, self.known(name), payload)

    def decode_command(self, name: str, payload: bytes, max_bytes: int = MAX_COMMAND) -> Any:
        """Return a command or request; to decode a large one would hold up the others.

        Raises BadPayload, and nothing else.
        """
        if len(payload) > max_bytes:
            raise BadPayload(f"{name}: {len(payload)} bytes; expected at most {max_bytes}")
        return self.decode(name, payload)

    def make(self, name: str, /, **fields: Any) -> Any:
        """Make a message; fields that are left out get their defaults, in nested ones as well.

        Values are taken as they are, but for lists of numbers, and mappings in place of messages.
        Raises ConfigError for an unknown type or field.
        """
        return self._values.make(self.known(name), fields)

    def from_dict(self, name: str, data: Mapping[str, Any]) -> Any:
        """Make a message from JSON's values, checked. Raises BadPayload with the field."""
        return self._values.from_dict(self.known(name), data)

    def to_dict(self, message: object) -> dict[str, Any]:
        """Return the message in JSON's values: bytes as base64, and NaN and Infinity as texts."""
        return self._values.to_dict(message)

    def known_part(self, name: str, data: Mapping[str, Any]) -> dict[str, Any]:
        """Return the part of JSON's values that a type has fields for, in nested ones as well."""
        return self._values.known_part(self.known(name), data)

    def only_text(self, name: str) -> str:
        """Return the name of a type's field if it has but one, a text; else an empty text."""
        field, kind = self.fields(name)[0]
        return field if len(self.fields(name)) == 1 and is_text(kind) else ""

    def definition(self, name: str) -> str:
        """Return a message's definition with all that it holds, as bags and viewers want it."""
        text: str = self._store.generate_msgdef(self.known(name), ros_version=2)[0]
        return text

    def hash(self, name: str) -> str:
        """Return `RIHS01_…` of a message, service or action. Raises ConfigError if unknown."""
        if name not in self._hashes:
            self._hashes[name] = rihs01(name, self._fields)
        return self._hashes[name]

    def fields(self, name: str) -> Fields:
        """Return the fields of a message type, as rosbags describes them. Raises ConfigError."""
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

    def _checked_defaults(self, of: Definition) -> dict[str, Any]:
        """Return the defaults of fields by their attributes; check the constants as well."""
        kinds = dict(of.fields)
        try:
            for name, primitive, value in of.constants:
                if primitive != "string":  # which may be without quotes, and then seem a number
                    literal((primitive, 0), value, f"constant {name}")
            return {
                normalize_fieldname(field): self._values.default(
                    kinds[field], value, f"default of {field}"
                )
                for field, value in of.defaults.items()
            }
        except BadPayload as error:
            raise ConfigError(f"{of.file}: {error}") from None


def decoded(store: Any, name: str, payload: bytes) -> Any:
    """Return the message in a payload, of a type in a store of rosbags. Raises BadPayload."""
    if not 4 <= len(payload) <= MAX_PAYLOAD or payload[0] or payload[1] > 1:
        raise BadPayload(f"{name}: no CDR: {len(payload)} bytes, {payload[:4].hex()}…")
    definition = store.get_msgdef(name)
    read = definition.deserialize_cdr_le if payload[1] else definition.deserialize_cdr_be
    try:
        return read(_body(payload), 0, definition.cls, store)[0]
    except (SerdeError, struct.error, ValueError) as error:
        raise BadPayload(f"{name}: {error}") from None


def _body(payload: bytes) -> bytes | memoryview:
    """Return what follows the header, without a copy where a copy would cost more."""
    return payload[4:] if len(payload) < LARGE else memoryview(payload)[4:]
