"""`python -m ceilvo.bench.fusion`; apart from command.py, which other processes can import."""

import sys

from ceilvo.bench.fusion.command import main

if __name__ == "__main__":
    sys.exit(main())
