"""`python -m bench.peers`."""

import os
import sys

if __name__ == "__main__":
    # Before numpy is loaded: process time includes the threads of linear algebra, which only wait at this size.
    for library in ("OPENBLAS", "OMP", "MKL"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    from bench.peers.command import main

    sys.exit(main())
