"""Makes ROS messages from Python values or JSON, with defaults, and converts them to JSON."""

import base64
import binascii
import contextlib
import functools
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys.base import normalize_fieldname
from rosbags.typesys.store import Typestore

from gigabrain_zenoh.errors import BadPayload, ConfigError, listed
from gigabrain_zenoh.ros2.type_files import DUMMY, Description

BYTES = ("uint8", "char", "byte")
DTYPES = {"bool": np.dtype(np.bool_), "char": np.dtype(np.uint8), "byte": np.dtype(np.int8)}
MakeDefault = Callable[[], Any]
Convert = Callable[[Any], Any]  # returns a value that rosbags can encode
Plan = dict[str, tuple[Description, MakeDefault, Convert]]  # by attribute, in the wire's order


def dtype(primitive: str) -> np.dtype[Any]:
    """Return numpy's type of a primitive type."""
    return DTYPES.get(primitive) or np.dtype(primitive)


def is_text(kind: Description) -> bool:
    """Return whether a field is a string."""
    return bool(kind[0] == Nodetype.BASE and kind[1][0] == "string")


class Values:
    """Makes and converts messages of the types in a store."""

    def __init__(self, store: Typestore, defaults: Mapping[str, Mapping[str, Any]]) -> None:
        self._store, self._defaults = store, defaults
        self._plans: dict[str, Plan] = {}

    def make(self, name: str, fields: Mapping[str, Any]) -> Any:
        """Make a message from `fields`; others get their defaults. Raises ConfigError."""
        plan = self._plan(name)
        values = [
            convert(fields[field]) if field in fields else default()
            for field, (_, default, convert) in plan.items()
        ]
        if not fields.keys() <= plan.keys():
            wrong = ", ".join(sorted(fields.keys() - plan.keys()))
            raise ConfigError(f"{name} has no field {wrong}; it has: {listed(plan)}")
        return self._store.types[name](*values)

    def from_dict(self, name: str, data: Any, path: str = "") -> Any:
        """Make a message from JSON values. Raises BadPayload."""
        plan = self._plan(name)
        if not isinstance(data, Mapping):
            raise BadPayload(f"{path or name}: expected an object, got {_short(data)}")
        if wrong := data.keys() - plan.keys():
            each = ", ".join(sorted(map(str, wrong)))
            raise BadPayload(f"{path or name}: no field {each}; known: {listed(plan)}")
        values = [
            self._checked(kind, data[field], f"{path}.{field}" if path else field)
            if field in data
            else default()
            for field, (kind, default, _) in plan.items()
        ]
        return self._store.types[name](*values)

    def to_dict(self, message: Any) -> dict[str, Any]:
        """Return the message as JSON values."""
        return {
            field: self._plain(kind, getattr(message, field))
            for field, (kind, *_) in self._plan(message.__msgtype__).items()
            if field != DUMMY
        }

    def known_part(self, name: str, data: Mapping[str, Any]) -> dict[str, Any]:
        """Return the JSON values without fields that the type does not have."""
        return {
            field: self._known(kind, data[field])
            for field, (kind, *_) in self._plan(name).items()
            if field in data
        }

    def default(self, kind: Description, given: Any, path: str) -> Any:
        """Check and return the default of a field in its definition. Raises BadPayload."""
        if kind[0] == Nodetype.BASE:
            return literal(kind[1], given, path)
        if kind[0] == Nodetype.NAME or kind[1][0][0] == Nodetype.NAME:
            raise BadPayload(f"{path}: a message has no default, got {_short(given)}")
        values = [] if given == "[]" else given  # rosbags parses it as a string
        if not isinstance(values, list):
            raise BadPayload(f"{path}: expected a list, got {_short(given)}")
        values = [literal(kind[1][0][1], each, path) for each in values]
        self._checked(kind, values, path)
        return values

    def _known(self, kind: Description, value: Any) -> Any:
        if kind[0] == Nodetype.NAME and isinstance(value, Mapping):
            return self.known_part(kind[1], value)
        if kind[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE) and isinstance(value, list | tuple):
            return [self._known(kind[1][0], each) for each in value]
        return value

    def _plan(self, name: str) -> Plan:
        plan = self._plans.get(name)
        if plan is None:
            given = self._defaults.get(name, {})
            plan = self._plans[name] = {}
            for field, kind in self._store.fielddefs[name][1]:
                key, convert = normalize_fieldname(field), self._converter(kind)
                default = self._default(kind)
                if key in given:
                    default = functools.partial(convert, given[key])
                plan[key] = (kind, default, convert)
        return plan

    def _default(self, kind: Description) -> MakeDefault:
        if kind[0] == Nodetype.NAME:
            return lambda: self.make(kind[1], {})
        if kind[0] == Nodetype.BASE:
            primitive = kind[1][0]
            zero: Any = {"string": "", "bool": False}.get(primitive, 0)
            zero = 0.0 if primitive.startswith("float") else zero
            return lambda: zero
        inner, size = kind[1]
        count = size if kind[0] == Nodetype.ARRAY else 0
        if inner[0] == Nodetype.BASE and inner[1][0] != "string":
            element = dtype(inner[1][0])
            return lambda: np.zeros(count, element)
        element_default = self._default(inner)
        return lambda: [element_default() for _ in range(count)]

    def _converter(self, kind: Description) -> Convert:
        """Return the conversion of a field's mappings and lists; it keeps other values."""
        if kind[0] == Nodetype.BASE:
            return lambda value: value
        if kind[0] == Nodetype.NAME:
            message = self._store.types[kind[1]]
            return lambda value: value if type(value) is message else self._nested(kind[1], value)
        inner = kind[1][0]
        if inner[0] == Nodetype.NAME:
            convert = self._converter(inner)
            return lambda value: [convert(each) for each in value]
        if inner[1][0] == "string":
            return list
        return functools.partial(_array, dtype(inner[1][0]))

    def _nested(self, name: str, value: Any) -> Any:
        return self.make(name, value) if isinstance(value, Mapping) else value

    def _checked(self, kind: Description, value: Any, path: str) -> Any:
        if kind[0] == Nodetype.NAME:
            return self.from_dict(kind[1], value, path)
        if kind[0] == Nodetype.BASE:
            return _scalar(kind[1][0], kind[1][1], value, path)
        inner, size = kind[1]
        numbers = inner[0] == Nodetype.BASE and inner[1][0] != "string"
        if numbers and inner[1][0] in BYTES and isinstance(value, str):
            value = _bytes(value, path)
            array: Any = np.frombuffer(value, dtype(inner[1][0]))
        elif not isinstance(value, list | tuple):
            raise BadPayload(f"{path}: expected a list, got {_short(value)}")
        else:
            array = [
                self._checked(inner, each, f"{path}[{index}]") for index, each in enumerate(value)
            ]
        if kind[0] == Nodetype.ARRAY and len(array) != size:
            raise BadPayload(f"{path}: expected {size} elements, got {len(array)}")
        if kind[0] == Nodetype.SEQUENCE and size and len(array) > size:
            raise BadPayload(f"{path}: expected at most {size} elements, got {len(array)}")
        return np.asarray(array, dtype(inner[1][0])) if numbers else array

    def _plain(self, kind: Description, value: Any) -> Any:
        if kind[0] == Nodetype.NAME:
            return self.to_dict(value)
        if kind[0] == Nodetype.BASE:
            return _json_number(value) if isinstance(value, float) else value
        inner = kind[1][0]
        if inner[0] == Nodetype.NAME:
            return [self.to_dict(each) for each in value]
        if inner[1][0] == "string":
            return list(value)
        if kind[0] == Nodetype.SEQUENCE and inner[1][0] in BYTES:
            return base64.b64encode(value.tobytes()).decode()
        elements = value.tolist()
        return [_json_number(each) for each in elements] if value.dtype.kind == "f" else elements


def _array(element: np.dtype[Any], value: Any) -> Any:
    if isinstance(value, bytes | bytearray | memoryview):
        return np.frombuffer(value, element)
    return np.ascontiguousarray(value, element).reshape(-1)


def _json_number(number: float) -> float | str:
    """Return a finite number as it is, and others as text, because JSON has none for them."""
    if math.isfinite(number):
        return number
    if math.isnan(number):
        return "NaN"
    return "Infinity" if number > 0 else "-Infinity"


NON_FINITE = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}


def literal(kind: tuple[str, int], given: Any, path: str) -> Any:
    """Return a constant or default of a primitive type, as in rosidl. Raises BadPayload."""
    primitive, max_length = kind
    if primitive == "byte":  # 0 to 255 in a definition; -128 to 127 in rosbags
        return int(np.uint8(_scalar("uint8", 0, given, path)).astype(np.int8))
    if primitive == "bool" and given in (0, 1):
        given = bool(given)
    if primitive.startswith("float") and isinstance(given, str):
        with contextlib.suppress(ValueError):  # such as nan
            given = float(given)
    return _scalar(primitive, max_length, given, path)


def _scalar(primitive: str, max_length: int, value: Any, path: str) -> Any:
    """Check and return a number, bool or string of a primitive type. Raises BadPayload."""
    if primitive == "string":
        if isinstance(value, str) and "\0" not in value:
            if max_length and len(value.encode(errors="replace")) > max_length:
                raise BadPayload(f"{path}: expected at most {max_length} bytes")
            return value.encode(errors="replace").decode()
        raise BadPayload(f"{path}: expected a text, got {_short(value)}")
    if primitive == "bool":
        if isinstance(value, bool):
            return value
        raise BadPayload(f"{path}: expected true or false, got {_short(value)}")
    if primitive.startswith("float"):
        return _float(primitive, value, path)
    limits = np.iinfo(dtype(primitive))
    if isinstance(value, int) and not isinstance(value, bool) and limits.min <= value <= limits.max:
        return value
    raise BadPayload(
        f"{path}: expected a whole number from {limits.min} to {limits.max}, got {_short(value)}"
    )


def _float(primitive: str, value: Any, path: str) -> float:
    if isinstance(value, str) and value in NON_FINITE:
        return NON_FINITE[value]
    largest = float(np.finfo(dtype(primitive)).max)
    if isinstance(value, int | float) and not isinstance(value, bool):
        if isinstance(value, float) and not math.isfinite(value):
            return value
        if -largest <= value <= largest:
            return float(value)
    raise BadPayload(
        f"{path}: expected a number up to {largest:.3g}, or NaN, Infinity or -Infinity as text, "
        f"got {_short(value)}"
    )


def _bytes(text: str, path: str) -> bytes:
    try:
        return base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        raise BadPayload(f"{path}: expected a list of numbers, or base64") from None


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:40]}…"
