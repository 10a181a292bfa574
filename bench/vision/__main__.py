"""`python -m ceilvo.bench.vision`; apart from command.py, which other processes can import."""

import sys

from ceilvo.bench.vision.command import main

if __name__ == "__main__":
    sys.exit(main())
