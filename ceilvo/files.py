"""Writing files so that a reader never meets half of one, and setting aside those that cannot be read."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

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
