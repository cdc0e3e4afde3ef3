"""Encodes messages to bytes and decodes them. A decoded message is valid."""

from collections.abc import Callable
from typing import Any, Generic, TypeVar

import msgspec

from gigabrain_schemas.base import Message

M = TypeVar("M", bound=Message)

# all exceptions that msgspec raises on invalid input
DECODE_ERRORS = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError)
MAX_ERROR_CHARS = 200  # an error quotes the message, which may have 60 kB


def _plain(value: Any) -> Any:
    """Convert a scalar of NumPy to Python's own type. Raises TypeError."""
    if getattr(value, "ndim", None) != 0:
        kind = f"{type(value).__module__}.{type(value).__name__}"
        raise TypeError(f"Encoding objects of type {kind} is unsupported")
    return value.item()


encode = msgspec.msgpack.Encoder(enc_hook=_plain).encode


def encoding_of(message: type[Message]) -> str:
    """Return the Zenoh encoding of a message type."""
    return f"application/msgpack;gigabrain.{message.__name__}"


class Codec(Generic[M]):
    """Decodes one message type, from MessagePack or from JSON."""

    def __init__(self, message: type[M], max_bytes: int) -> None:
        self.max_bytes = max_bytes
        self._msgpack: Callable[[bytes], M] = msgspec.msgpack.Decoder(message).decode
        self._json: Callable[[bytes], M] = msgspec.json.Decoder(message).decode

    def decode(self, payload: bytes) -> M:
        """Return the message in `payload`. Raises ValueError if it is invalid.

        The first byte decides, since foreign clients rarely set a Zenoh encoding: JSON begins with
        ASCII, a MessagePack map never does.
        """
        if len(payload) > self.max_bytes:
            raise ValueError(f"{len(payload)} bytes, at most {self.max_bytes} are read")
        try:
            return self._json(payload) if payload[:1] < b"\x80" else self._msgpack(payload)
        except DECODE_ERRORS as error:
            raise ValueError(str(error)[:MAX_ERROR_CHARS]) from None
