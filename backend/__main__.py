"""`python -m backend COMMAND ...`: see `--help`."""

import json
import sys

from . import lacking

if __name__ == "__main__":
    try:
        from .arguments import main

        sys.exit(main())
    except ModuleNotFoundError as error:
        # What the reporters themselves need is not there.
        if "--json" in sys.argv:
            print(json.dumps({"type": "error", "message": lacking(error)}))
        else:
            print(f"error: {lacking(error)}", file=sys.stderr)
        sys.exit(2)
