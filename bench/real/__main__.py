"""`python -m ceilvo.bench.real`; apart from command.py, which other processes can import."""

import sys

from ceilvo.bench.real.command import main

if __name__ == "__main__":
    sys.exit(main())
