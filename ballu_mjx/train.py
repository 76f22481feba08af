"""`python -m ballu_mjx.train`: the same as `ballu_mjx train`."""

import sys

from ballu_mjx.cli.train import main

if __name__ == "__main__":
    sys.exit(main())
