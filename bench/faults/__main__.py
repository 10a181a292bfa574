"""`python -m ceilvo.bench.faults`; apart from command.py, which other processes can import."""

import sys

from ceilvo.bench.faults.command import main

if __name__ == "__main__":
    sys.exit(main())
