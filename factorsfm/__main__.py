"""``python -m factorsfm`` is the command line."""

import sys

from factorsfm.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
