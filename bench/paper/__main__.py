"""`python -m ceilvo.bench.paper`; apart from command.py, which other processes can import."""

import sys

from ceilvo.bench.paper.command import main

if __name__ == "__main__":
    sys.exit(main())
