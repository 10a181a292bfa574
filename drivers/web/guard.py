"""Who may look and who may command: this computer, or beyond it whoever brings the owner's token, by a page of ours."""

from __future__ import annotations

import hmac
import secrets
import ssl
import time
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from urllib.parse import urlsplit

from aiohttp import web

from ceilvo.config import Web
from ceilvo.config.zenoh_names import on_loopback
from ceilvo.drivers.bus.command_guard import read_token
from ceilvo.errors import ConfigError, one_line
from ceilvo.files import read_secret

_SESSION_S = 12 * 3600.0
"""That a browser stays signed in: a working day; chosen."""
_SESSIONS = 64
"""Signed in at most; the oldest goes."""
_KEY_BYTES = 1 << 16
"""Of a private key's file."""
_CHANGES = ("POST", "PUT", "PATCH", "DELETE")


class Guard:
    """For one thread."""

    def __init__(self, config: Web, clock: Callable[[], float] = time.monotonic) -> None:
        """
        Raises:
            ConfigError: a file cannot be used.
        """
        self._config, self._clock = config, clock
        self._token = read_token(Path(config.token_file), "web.token_file") if config.token_file else b""
        self._sessions: OrderedDict[str, float] = OrderedDict()
        self.tls = _tls(config)
        self._encrypted = self.tls is not None or config.behind_proxy
        self._cookie = "__Host-ceilvo" if self._encrypted else "ceilvo"

    @property
    def needs_token(self) -> bool:
        return bool(self._token)

    def admit(self, request: web.Request) -> None:
        """Whether it may be answered at all; any address may see the page that asks for the token.

        Raises:
            web.HTTPException: why not.
        """
        if not self._token and not on_loopback(_host(request)):
            # A name that somebody else's page has pointed at this computer.
            raise web.HTTPMisdirectedRequest(text="found another host's name, expected localhost or 127.0.0.1\n")
        self._check_origin(request)

    def authorise(self, request: web.Request) -> None:
        """
        Raises:
            web.HTTPUnauthorized: it brings neither the token nor a session.
        """
        if self._token and not (self._has_session(request) or self._has_token(request)):
            raise web.HTTPUnauthorized(text="expected the token\n", headers={"WWW-Authenticate": "Bearer"})

    def sign_in(self, token: str, response: web.StreamResponse) -> bool:
        """Whether the token is right; the response takes a session along then."""
        if not self._token or not hmac.compare_digest(token.strip().encode("utf-8", "replace"), self._token):
            return False
        session = secrets.token_urlsafe(32)
        self._sessions[session] = self._clock() + _SESSION_S
        while len(self._sessions) > _SESSIONS:
            self._sessions.popitem(last=False)
        response.set_cookie(
            self._cookie, session, max_age=int(_SESSION_S), httponly=True, secure=self._encrypted, samesite="Strict"
        )
        return True

    def sign_out(self, request: web.Request, response: web.StreamResponse) -> None:
        self._sessions.pop(request.cookies.get(self._cookie, ""), None)
        response.del_cookie(self._cookie, secure=self._encrypted, httponly=True, samesite="Strict")

    def _check_origin(self, request: web.Request) -> None:
        """What changes anything, and what reads without end, must come from a page of ours or from no page at all."""
        upgrade = "websocket" in request.headers.get("Upgrade", "").lower()
        if request.method not in _CHANGES and not upgrade:
            return
        origin = request.headers.get("Origin")
        try:
            foreign = origin is not None and urlsplit(origin).netloc.lower() != request.headers.get("Host", "").lower()
        except ValueError:
            foreign = True
        if foreign or request.headers.get("Sec-Fetch-Site", "none") not in ("same-origin", "none"):
            raise web.HTTPForbidden(text="found another site's request, expected one of this page\n")

    def _has_session(self, request: web.Request) -> bool:
        session = request.cookies.get(self._cookie, "")
        ends = self._sessions.get(session)
        if ends is None:
            return False
        if self._clock() > ends:
            del self._sessions[session]
            return False
        return True

    def _has_token(self, request: web.Request) -> bool:
        scheme, _, value = request.headers.get("Authorization", "").partition(" ")
        given = value.strip().encode("utf-8", "replace")
        return scheme.lower() == "bearer" and hmac.compare_digest(given, self._token)


def _host(request: web.Request) -> str:
    """Of the Host header, without the port; "" where it is none."""
    try:
        return urlsplit(f"//{request.headers.get('Host', '')}").hostname or ""
    except ValueError:
        return ""


def _tls(config: Web) -> ssl.SSLContext | None:
    """
    Raises:
        ConfigError: certificate or key cannot be used.
    """
    if not config.certificate_file:
        return None
    key, where = Path(config.key_file), "web.key_file"
    read_secret(key, where, "a private key in PEM", _KEY_BYTES, "make one with openssl", f"chmod 640 {key}")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2

    def no_password() -> str:
        raise ConfigError(f"{where}: {key} is encrypted, expected a key without a password")

    try:
        context.load_cert_chain(config.certificate_file, key, no_password)
    except (OSError, ssl.SSLError) as e:
        raise ConfigError(
            f"web.certificate_file: {config.certificate_file} with {where}: {key}: {one_line(e)}, "
            "expected a certificate in PEM and its own key"
        ) from e
    return context
