"""python -m ceilvo.bench.fleet"""

import sys

from ceilvo.bench.fleet.command import main

if __name__ == "__main__":
    sys.exit(main())
