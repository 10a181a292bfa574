"""Writing files so that a reader never meets half of one, setting aside those that cannot be read, reading secrets."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from pathlib import Path

from ceilvo.errors import ConfigError

REJECTED = ".rejected"
MOST_REJECTED = 9
"""Files of one name that are set aside; chosen: of a disk that spoils one at every start the first ones tell most."""


def write_atomic(path: Path, data: bytes | str, mode: int = 0o644) -> None:
    """Write next to the target, flush to disk, rename over it; on any failure the old file stays as it was.

    Raises:
        OSError: names the target.
    """
    try:
        _write_atomic(path, data, mode)
    except OSError as e:
        raise OSError(e.errno, e.strerror, str(path)) from e


def _write_atomic(path: Path, data: bytes | str, mode: int) -> None:
    raw = data.encode() if isinstance(data, str) else data
    fd, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".tmp")
    tmp = Path(name)
    try:
        with os.fdopen(fd, "wb") as f:
            f.write(raw)
            f.flush()
            os.fsync(f.fileno())
        tmp.chmod(mode)
        tmp.replace(path)
    except BaseException:
        tmp.unlink(missing_ok=True)
        raise


def set_aside(path: Path) -> Path:
    """Rename what cannot be used to NAME.rejected, or NAME.rejected.2 and so on; only the last of these is replaced.

    Returns:
        The new name.

    Raises:
        OSError: the folder cannot be written to; nothing is changed.
    """
    first = path.with_name(path.name + REJECTED)
    names = [first, *(first.with_name(f"{first.name}.{n}") for n in range(2, MOST_REJECTED + 1))]
    aside = next((p for p in names if not os.path.lexists(p)), names[-1])
    path.replace(aside)
    return aside


def read_secret(
    path: Path,
    key: str,
    what: str,
    most_bytes: int,
    make_one: str,
    mend: str,
    check: Callable[[bytes], None] = lambda secret: None,
) -> bytes:
    """What a file with a secret holds, without blanks around it, one byte more than the most at most.

    Args:
        key: of the configuration, that names the file.
        what: it should hold, such as "a token".
        make_one: how to make one, for messages.
        mend: what to do where others may read it.
        check: raises ConfigError for what cannot be one; before its mode is looked at.

    Raises:
        ConfigError: there is none, it cannot be read, or everybody may read it.
    """
    try:
        if path.exists() and not path.is_file():  # a pipe would be waited for
            raise ConfigError(f"{key}: found {path}: not a file, expected one with {what}; {make_one}")
        with path.open("rb") as f:
            secret = f.read(most_bytes + 1).strip()
            mode = os.fstat(f.fileno()).st_mode
    except OSError as e:
        raise ConfigError(f"{key}: found {path}: {e.strerror}, expected a file with {what}; {make_one}") from e
    check(secret)
    if mode & 0o007:
        raise ConfigError(f"{key}: {path} may be read by everybody, expected mode 640 or 600; {mend}")
    return secret
