"""Does a configuration need the network? For network.sh: `python -m ceilvo.config.network FILE` ends with 0 if it does,
`... network FILE web` if `ceilvod web` does.

A file that cannot be read needs none: the daemon will not start with it, and says why.
"""

from __future__ import annotations

import sys
from pathlib import Path

from ceilvo.config.reader import load_config
from ceilvo.config.zenoh_names import needs_network, on_loopback
from ceilvo.errors import ConfigError


def answer(file: Path, program: str = "") -> int:
    try:
        config = load_config(file)
        beyond = program == "web" and not on_loopback(config.web.host)
        return 0 if beyond or needs_network(config.zenoh) else 1
    except (ConfigError, OSError):
        return 1


if __name__ == "__main__":
    sys.exit(answer(Path(sys.argv[1]), *sys.argv[2:]))
