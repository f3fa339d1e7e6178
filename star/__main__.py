"""`python -m star` is the command `star`."""

import sys

from star.cli import main

if __name__ == "__main__":
    sys.exit(main())
