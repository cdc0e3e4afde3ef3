"""Access to the page: tokens for operators and viewers, and the names of its host."""

import hmac
import ipaddress
import os
import re
import secrets
import ssl
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import msgspec
from msgspec import Struct

from gigabrain_zenoh.codec import DECODE_ERRORS
from gigabrain_zenoh.config.settings import PageConfig
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.network import is_ip, is_loopback
from gigabrain_zenoh.host.run_folders import state_dir
from gigabrain_zenoh.security.identity_files import made_once

Role = Literal["operator", "viewer"]
LOOPBACK_NAMES = ("127.0.0.1", "localhost", "::1")
PORTS = {"http": 80, "https": 443}
PORT = re.compile(r":\d{1,5}\Z", re.ASCII)
TOKEN_BYTES = 24


class Tokens(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Secrets of operators and of viewers."""

    operator: str
    viewer: str

    def __post_init__(self) -> None:
        if min(len(self.operator), len(self.viewer)) < 16 or self.operator == self.viewer:
            raise ValueError("expected two different tokens of 16 characters or more")


def wants_login(config: PageConfig) -> bool:
    """Return whether the page asks for a token."""
    return config.login or not is_loopback(config.listen)


def check(config: PageConfig) -> None:
    """Raise ConfigError for a page that needs TLS and has none, or whose TLS cannot work."""
    if bool(config.certificate) != bool(config.certificate_key):
        raise ConfigError("page: set both certificate and certificate_key, or neither")
    if not is_loopback(config.listen) and not config.certificate:
        raise ConfigError(
            f"page: {config.listen} can be reached from the network; set certificate and "
            "certificate_key (PEM files), or listen on 127.0.0.1 and use an SSH tunnel"
        )
    for file in filter(None, (config.certificate, config.certificate_key)):
        if not os.access(file, os.R_OK):
            raise ConfigError(f"page: cannot read {file}; check its path and its rights")
    if config.certificate:
        _check_certificate(config.certificate, config.certificate_key)


def _check_certificate(certificate: str, key: str) -> None:
    """Raise ConfigError for files that cannot serve TLS."""

    def refuse() -> str:
        raise ConfigError(
            f"page: {key} has a pass phrase; set certificate_key to a file without one: "
            f"openssl pkey -in {key} -out page.key"
        )

    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        context.load_verify_locations(certificate)
    except OSError:
        raise ConfigError(
            f"page: {certificate} holds no certificate; set certificate to a PEM file"
        ) from None
    try:
        context.load_cert_chain(certificate, key, refuse)
    except OSError as error:
        raise ConfigError(
            f"page: {key} is no usable key of {certificate} ({error.strerror}); "
            "set certificate_key to the key that it was made with, a PEM file"
        ) from None


def token_file(named: str) -> Path:
    """Return the path of the token file: `named`, or the default one if it is empty."""
    return Path(named) if named else state_dir() / "page" / "tokens.json"


def tokens(path: Path) -> tuple[Tokens, bool]:
    """Return the tokens in a private file, and whether the file is new. Raises ConfigError."""
    new_tokens = Tokens(
        operator=secrets.token_urlsafe(TOKEN_BYTES), viewer=secrets.token_urlsafe(TOKEN_BYTES)
    )
    content, is_new = made_once(path, msgspec.json.encode(new_tokens))
    try:
        return msgspec.json.decode(content, type=Tokens), is_new
    except DECODE_ERRORS as error:
        raise ConfigError(f"{path}: {error}; remove the file to have new tokens made") from None


class Access:
    """Decides which requests and tokens are accepted."""

    def __init__(self, config: PageConfig, port: int) -> None:
        self._tokens, self.tokens_are_new = None, False
        if wants_login(config):
            self._tokens, self.tokens_are_new = tokens(token_file(config.tokens))
        self._scheme = "https" if config.certificate else "http"
        local = LOOPBACK_NAMES if is_loopback(config.listen) else ()
        names = {_in_header(name) for name in (config.listen, *local, *config.names)}
        self._hosts = {f"{name}:{port}" for name in names}
        if port == PORTS[self._scheme]:
            self._hosts |= names  # browsers leave out the default port
        # these may have any port, as a tunnel has its own; no other site can have such a name
        self._loopback = {name for name in names if is_loopback(name.strip("[]"))}

    def new_tokens_text(self) -> str:
        """Return the tokens with their uses if they are new, else an empty text."""
        if self._tokens is None or not self.tokens_are_new:
            return ""
        return f"to drive:     {self._tokens.operator}\nto view only: {self._tokens.viewer}"

    def role(self, token: str) -> Role | None:
        """Return the role of a token; None if it is unknown."""
        if self._tokens is None:
            return "operator"
        if _equal(token, self._tokens.operator):
            return "operator"
        return "viewer" if _equal(token, self._tokens.viewer) else None

    def named(self, headers: Mapping[str, str]) -> bool:
        """Return whether the Host is a name of this page (DNS rebinding, RFC 9110 7.2)."""
        host = headers.get("host", "").lower()
        return host in self._hosts or PORT.sub("", host) in self._loopback

    def own_page(self, headers: Mapping[str, str]) -> bool:
        """Return whether a WebSocket is opened by this page, and not by another site."""
        origin = headers.get("origin", "").lower()
        return self.named(headers) and origin == f"{self._scheme}://{headers['host'].lower()}"


def _in_header(name: str) -> str:
    """Return a name or address as browsers write it in Host and Origin (RFC 3986, 3.2.2)."""
    name = name.strip("[]").lower()
    return f"[{ipaddress.ip_address(name)}]" if ":" in name and is_ip(name) else name


def _equal(one: str, other: str) -> bool:
    return hmac.compare_digest(one.encode(), other.encode())
