"""Makes cyclonedds types from the ROS definitions of rosbags.

cyclonedds uses only their layout: to check received samples, and to announce it to peers that
compare types. Samples are written and read as CDR.
"""

from collections.abc import Callable
from typing import Any

import cyclonedds.idl.types as idl
from cyclonedds.idl import make_idl_struct
from rosbags.interfaces import Nodetype

from gigabrain_zenoh.ros2.transport import dds_type
from gigabrain_zenoh.ros2.type_files import Description, Fields

of: Any = idl  # as Any: `of.array[type, size]` is valid, though mypy sees no generic type
PRIMITIVES: dict[str, Any] = {
    "bool": bool,
    "char": idl.uint8,
    "byte": idl.uint8,
    "int8": idl.int8,
    "uint8": idl.uint8,
    "int16": idl.int16,
    "uint16": idl.uint16,
    "int32": idl.int32,
    "uint32": idl.uint32,
    "int64": idl.int64,
    "uint64": idl.uint64,
    "float32": idl.float32,
    "float64": idl.float64,
    "string": str,
}


class IdlTypes:
    """Makes cyclonedds types, each once."""

    def __init__(self, fields_of: Callable[[str], Fields]) -> None:
        self._fields_of = fields_of
        self._structs: dict[str, Any] = {}

    def struct(self, name: str) -> Any:
        """Return the cyclonedds type of a message. Raises the errors of `fields_of`."""
        if name not in self._structs:
            fields = {field: self._element(kind) for field, kind in self._fields_of(name)}
            full_name = dds_type(name).replace("::", ".")
            self._structs[name] = make_idl_struct(full_name.rpartition(".")[2], full_name, fields)
        return self._structs[name]

    def _element(self, kind: Description) -> Any:
        if kind[0] == Nodetype.NAME:
            return self.struct(kind[1])
        if kind[0] == Nodetype.BASE:
            primitive, max_length = kind[1]
            return of.bounded_str[max_length] if max_length else PRIMITIVES[primitive]
        inner, size = kind[1]
        element = self._element(inner)
        if kind[0] == Nodetype.ARRAY:
            return of.array[element, size]
        return of.sequence[element, size] if size else of.sequence[element]
