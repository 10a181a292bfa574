"""Does a configuration need the network? For install.sh: `python -m ceilvo.config.network FILE` ends with 0 if it does.

A file that cannot be read needs none: the daemon will not start with it, and says why.
"""

from __future__ import annotations

import sys
from pathlib import Path

from ceilvo.config.reader import load_config
from ceilvo.config.zenoh_names import needs_network
from ceilvo.errors import ConfigError


def answer(file: Path) -> int:
    try:
        return 0 if needs_network(load_config(file).zenoh) else 1
    except (ConfigError, OSError):
        return 1


if __name__ == "__main__":
    sys.exit(answer(Path(sys.argv[1])))
