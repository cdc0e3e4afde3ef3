"""The parameters of the gateway's node, read-only for all ROS tools.

They are its settings in the deployment file; a change needs a restart.
"""

from collections.abc import Callable, Mapping
from typing import Any

from msgspec.structs import asdict

from gigabrain_zenoh.config.settings import Ros2Config
from gigabrain_zenoh.errors import BadPayload
from gigabrain_zenoh.ros2.transport import RosTransport
from gigabrain_zenoh.ros2.types import Types

Value = bool | int | float | str | tuple[str, ...]
NOT_SET = 0
# numbers of rcl_interfaces/ParameterType, and the field of ParameterValue
KINDS: Mapping[type, tuple[int, str]] = {
    bool: (1, "bool_value"),
    int: (2, "integer_value"),
    float: (3, "double_value"),
    str: (4, "string_value"),
    tuple: (9, "string_array_value"),
}
READ_ONLY = "is read-only; set it in the part `ros2` of the deployment file, and start again"
MAX_NAMES = 1000  # of one request


class Parameters:
    """Serves rcl_interfaces for the settings of the gateway."""

    def __init__(
        self, ros: RosTransport, types: Types, config: Ros2Config, simulated: Callable[[], bool]
    ) -> None:
        self._types, self._config, self._simulated = types, config, simulated
        acts: dict[str, Callable[[Any], dict[str, Any]]] = {
            "GetParameters": self._get,
            "GetParameterTypes": self._get_types,
            "DescribeParameters": self._describe,
            "ListParameters": self._list,
            "SetParameters": self._set,
            "SetParametersAtomically": self._set_atomically,
        }
        for name, act in acts.items():
            ros.serve(f"{config.node}/{_snake(name)}", f"rcl_interfaces/srv/{name}",
                      self._answerer(name, act))  # fmt: skip

    @property
    def values(self) -> dict[str, Value]:
        """The present parameters, by name."""
        return {"use_sim_time": self._simulated(), **asdict(self._config)}

    def _answerer(self, name: str, act: Callable[[Any], dict[str, Any]]) -> Any:
        request, response = (f"rcl_interfaces/srv/{name}_{end}" for end in ("Request", "Response"))

        async def answer(payload: bytes) -> bytes:
            asked = self._types.decode_command(request, payload)
            for names in (getattr(asked, "names", ()), getattr(asked, "parameters", ())):
                if len(names) > MAX_NAMES:
                    raise BadPayload(f"{len(names)} names; expected at most {MAX_NAMES}")
            return self._types.encode(response, self._types.make(response, **act(asked)))

        return answer

    def _get(self, asked: Any) -> dict[str, Any]:
        values = self.values
        return {"values": [self._value(values.get(name)) for name in asked.names]}

    def _get_types(self, asked: Any) -> dict[str, Any]:
        values = self.values
        return {"types": [_kind(values.get(name)) for name in asked.names]}

    def _describe(self, asked: Any) -> dict[str, Any]:
        values = self.values
        make, kind = self._types.make, "rcl_interfaces/msg/ParameterDescriptor"
        return {
            "descriptors": [
                make(kind, name=name, type=_kind(values.get(name)), read_only=True)
                for name in asked.names
            ]
        }

    def _list(self, asked: Any) -> dict[str, Any]:
        prefixes = list(asked.prefixes)
        names = [
            name
            for name in self.values
            if not prefixes or any(name == one or name.startswith(f"{one}.") for one in prefixes)
        ]
        made = self._types.make("rcl_interfaces/msg/ListParametersResult", names=names, prefixes=[])
        return {"result": made}

    def _set(self, asked: Any) -> dict[str, Any]:
        return {"results": [self._refusal(one.name) for one in asked.parameters]}

    def _set_atomically(self, asked: Any) -> dict[str, Any]:
        return {"result": self._refusal(", ".join(one.name for one in asked.parameters))}

    def _refusal(self, name: str) -> Any:
        reason = f"{name[:200]} {READ_ONLY}"
        return self._types.make(
            "rcl_interfaces/msg/SetParametersResult", successful=False, reason=reason
        )

    def _value(self, value: Value | None) -> Any:
        kind = "rcl_interfaces/msg/ParameterValue"
        if value is None:
            return self._types.make(kind, type=NOT_SET)
        number, field = KINDS[type(value)]
        held = list(value) if isinstance(value, tuple) else value
        return self._types.make(kind, type=number, **{field: held})


def _kind(value: Value | None) -> int:
    return NOT_SET if value is None else KINDS[type(value)][0]


def _snake(name: str) -> str:
    """Return `get_parameters` for GetParameters."""
    return "".join(f"_{c.lower()}" if c.isupper() else c for c in name).lstrip("_")
