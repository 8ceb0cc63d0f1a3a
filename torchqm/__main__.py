"""``python -m torchqm``: the command line without its script."""

import sys

from torchqm.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
