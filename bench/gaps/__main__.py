"""`python -m ceilvo.bench.gaps`; apart from command.py, which other processes can import."""

import sys

from ceilvo.bench.gaps.command import main

if __name__ == "__main__":
    sys.exit(main())
