"""`python -m ceilvo.bench.starved`; apart from command.py, which other processes can import."""

import sys

from ceilvo.bench.starved.command import main

if __name__ == "__main__":
    sys.exit(main())
