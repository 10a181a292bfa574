"""`python -m ceilvo.bench.place`; apart from command.py, which other processes can import."""

import resource
import sys

from ceilvo.bench.place.command import main

MOST_BYTES = 6 * 2**30
"""Of address space, here and in processes that are started; chosen: a search that takes more than a small computer has
is a failed run, and must not take the bench's computer with it."""

if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES, resource.getrlimit(resource.RLIMIT_AS)[1]))
    sys.exit(main())
