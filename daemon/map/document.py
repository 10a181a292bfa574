"""The envelope of our JSON files: format, version, checksum, content."""

from __future__ import annotations

import hashlib
import json
import stat
from pathlib import Path
from typing import Any, NoReturn

from ceilvo.daemon.map.checks import Damage, keys, shown


def content_bytes(path: Path, limit: int) -> bytes | None:
    """What a file holds, one more than the limit at most; None where there is none. A pipe would never end."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise Damage("a folder, a pipe or a device, expected a file")
        with path.open("rb") as f:
            return f.read(limit + 1)
    except FileNotFoundError:
        if path.is_symlink():
            raise Damage(f"a link to {path.readlink()}, which is not there") from None
        return None
    except (OSError, ValueError) as e:
        why = (e.strerror or str(e)) if isinstance(e, OSError) else str(e)
        raise Damage(f"cannot be read: {why}, check its owner") from e


def content_of(raw: bytes, kind: str, newest: int, limit: int) -> tuple[Any, int]:
    """What a document holds, and its version."""
    document = parsed(raw, limit)
    if not isinstance(document, dict) or document.get("format") != kind:
        raise Damage(f"not a {kind} file")
    version = document.get("version")
    if type(version) is not int or version < 1:
        raise Damage(f"version is {shown(version)}, expected a whole number from 1 to {newest}")
    if version > newest:
        raise Damage(f"version {version} was written by a newer ceilvo, this one reads up to {newest}; update it")
    keys(document, {"format", "version", "sha256", "content"}, "file")
    if document["sha256"] != digest(document["content"]):
        raise Damage("checksum does not match, the content was changed or damaged")
    return document["content"], version


def parsed(raw: bytes, limit: int) -> Any:
    """JSON, of any kind."""
    if len(raw) > limit:
        raise Damage(f"longer than the largest allowed {limit} bytes")
    try:
        return json.loads(raw.decode("utf-8"), parse_constant=_no_constant)
    except (ValueError, RecursionError) as e:
        raise Damage(f"damaged or cut short: {str(e).splitlines()[0][:120]}") from e


def document_of(kind: str, version: int, content: Any) -> str:
    """One line of JSON with the checksum of its content."""
    document = {"format": kind, "version": version, "sha256": digest(content), "content": content}
    return json.dumps(document, allow_nan=False, sort_keys=False) + "\n"


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a number")


def digest(content: Any) -> str:
    """SHA-256 of the canonical form; floats survive because Python writes the shortest text that reads back equal."""
    try:
        text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
        return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()
    except (ValueError, RecursionError) as e:
        raise Damage(f"values that cannot be stored: {e}") from e
