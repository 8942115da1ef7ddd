"""`python -m backend COMMAND ...`: see `--help`."""

import json
import sys

from .shared.errors import describe_missing_package
from .shared.signals import block_signals, ignore_signals

if __name__ == "__main__":
    block_signals()
    try:
        from .cli.main import main

        code = main()
        # The result is complete, so that signals no longer matter.
        ignore_signals()
        sys.exit(code)
    except ModuleNotFoundError as error:
        # A package that the command line itself needs is missing.
        if "--json" in sys.argv:
            print(json.dumps({"type": "error", "message": describe_missing_package(error)}))
        else:
            print(f"error: {describe_missing_package(error)}", file=sys.stderr)
        sys.exit(2)
