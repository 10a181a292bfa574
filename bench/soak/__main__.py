"""`python -m ceilvo.bench.soak`; apart from command.py, which other processes can import."""

import sys

from ceilvo.bench.soak.command import main

if __name__ == "__main__":
    sys.exit(main())
