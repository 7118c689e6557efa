"""The program `python -m protocol.conformance.toy_server RENDEZVOUS`: the toy plant, served, and nothing else.

The least that keeps every rule: it needs numpy alone. Exit status 0 after a goodbye, 3 otherwise.
"""

from __future__ import annotations

import sys

from protocol.errors import ProtocolError
from protocol.physics import serve
from protocol.toy import ToyPlant


def main() -> int:
    """Serve one session and return the exit status."""
    try:
        serve(sys.argv[-1], ToyPlant())
    except ProtocolError as error:
        sys.stderr.write(f"toy_server: {error}\n")
        return 3
    return 0


if __name__ == "__main__":
    sys.exit(main())
