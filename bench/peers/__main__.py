"""`python -m bench.peers`."""

import sys

if __name__ == "__main__":
    from bench.peers.command import main

    sys.exit(main())
