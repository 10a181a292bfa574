"""`python -m ceilvo.bench.mrclam`; apart from command.py, which other processes can import."""

import sys

from ceilvo.bench.mrclam.command import main

if __name__ == "__main__":
    sys.exit(main())
