"""`python -m ceilvo.bench.faults`; apart from command.py, for what is in a __main__ cannot be sent to other processes."""

import sys

from ceilvo.bench.faults.command import main

if __name__ == "__main__":
    sys.exit(main())
