"""`python -m ceilvo.bench.fuzz`; apart from command.py, which other processes can import."""

import sys

from ceilvo.bench.fuzz.command import main

if __name__ == "__main__":
    sys.exit(main())
