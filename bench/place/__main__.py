"""`python -m ceilvo.bench.place`; apart from command.py, which other processes can import."""

import sys

from ceilvo.bench.place.command import main

if __name__ == "__main__":
    sys.exit(main())
