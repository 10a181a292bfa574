"""`python -m ceilvo.bench.cross_checks`; apart from command.py, which other processes can import."""

import sys

from ceilvo.bench.cross_checks.command import main

if __name__ == "__main__":
    sys.exit(main())
