"""A map from a place that the robot's owner named: a file, or a web server."""

from __future__ import annotations

import hashlib
import http.client
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any
from urllib.parse import SplitResult, unquote, urlsplit

from ceilvo.daemon.editing.sources import read
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.errors import CeilvoError, one_line

MOST_BYTES = 2**28
"""Of a map that is brought; chosen: some 800,000 landmarks as JSON."""
_SILENT_S, _MOST_S = 10.0, 600.0
"""Of a server, and of the whole: a robot does not wait for ever. Chosen."""
_BLOCK = 2**16
_SHOWN_CHARS = 72
"""Of a link in a message, which is one line of at most 160; chosen."""


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    """Elsewhere is not what the owner named."""

    def redirect_request(self, *_: Any, **__: Any) -> None:
        return None


def download(link: str, allowed: Sequence[str], sha256: str = "") -> MapContent:
    """The only map of a database, of a map.json or of an export.

    Args:
        allowed: what links may begin with (vda5050.map_sources).
        sha256: of the file in hexadecimal; "" where it was not said.

    Raises:
        CeilvoError: it may not be had from there, does not come, or is no map.
    """
    parts = _allowed(link, allowed)
    name = Path(unquote(parts.path)).name or "map"
    try:
        with tempfile.TemporaryDirectory(prefix="ceilvo-map-") as folder:
            file = Path(folder) / f"download{Path(name).suffix[:8]}"
            with _opened(parts, link) as stream, file.open("wb") as out:
                found = _copied(stream, out, link)
            if sha256 and sha256.strip().lower() != found:
                raise CeilvoError(
                    f"mapHash: found {found[:16]}..., expected {one_line(sha256, 64)}: sha256 of {_shown(link)}"
                )
            try:
                return read(file)
            except CeilvoError as e:
                raise CeilvoError(f"{_shown(link)}: {str(e).removeprefix(f'{file}: ')}") from e
    except (OSError, http.client.HTTPException) as e:
        why = getattr(e, "reason", None) or getattr(e, "strerror", None) or e
        raise CeilvoError(f"{_shown(link)}: did not come: {one_line(str(why)) or type(e).__name__}") from e


def _allowed(link: str, allowed: Sequence[str]) -> SplitResult:
    if not allowed:
        raise CeilvoError(
            "vda5050.map_sources: found nothing, expected what links may begin with, such as https://maps.example/robots/"
        )
    try:
        parts = urlsplit(link)
        fits = not _steps_up(parts.path) and any(_is_below(parts, urlsplit(a)) for a in allowed)
    except ValueError as e:
        raise CeilvoError(f"{_shown(link)}: no address: {one_line(str(e))}") from e
    if not fits:
        raise CeilvoError(f"{_shown(link)}: expected a link below vda5050.map_sources: {', '.join(allowed)}")
    return parts


def _steps_up(path: str) -> bool:
    return ".." in unquote(path).split("/")


def _is_below(link: SplitResult, allowed: SplitResult) -> bool:
    folder = unquote(allowed.path).rstrip("/") + "/"
    same = (link.scheme, link.netloc.lower()) == (allowed.scheme, allowed.netloc.lower())
    return same and unquote(link.path).startswith(folder)


def _opened(parts: SplitResult, link: str) -> Any:
    if parts.scheme == "file":
        path = Path(unquote(parts.path))
        if path.exists() and not path.is_file():  # a pipe would be waited for
            raise CeilvoError(f"{_shown(link)}: not a file, expected a map")
        return path.open("rb")
    opener = urllib.request.build_opener(_NoRedirect())
    try:
        return opener.open(urllib.request.Request(link, headers={"User-Agent": "ceilvo"}), timeout=_SILENT_S)
    except urllib.error.HTTPError as e:
        e.close()
        raise CeilvoError(f"{_shown(link)}: did not come: {e.code} {one_line(str(e.reason))}") from e


def _copied(stream: IO[bytes], out: IO[bytes], link: str) -> str:
    """Its digest."""
    count, digest, until_s = 0, hashlib.sha256(), time.monotonic() + _MOST_S
    while block := stream.read(_BLOCK):
        count += len(block)
        if count > MOST_BYTES:
            raise CeilvoError(f"{_shown(link)}: found more than {MOST_BYTES} bytes, expected a map")
        if time.monotonic() > until_s:
            raise CeilvoError(f"{_shown(link)}: did not come within {_MOST_S:g} s")
        digest.update(block)
        out.write(block)
    return digest.hexdigest()


def _shown(link: str) -> str:
    """Its begin and its end, which names the file: a longer one would leave no room for what went wrong."""
    line = one_line(link, 4 * _SHOWN_CHARS)
    return line if len(line) <= _SHOWN_CHARS else f"{line[: _SHOWN_CHARS // 3]}...{line[-_SHOWN_CHARS // 2 :]}"
