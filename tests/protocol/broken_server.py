"""A physics side with one deliberate fault: `broken_server.py FAULT RENDEZVOUS`.

A fault is named after the rule that must catch it; `faults/` holds them, and `--list` names them.
"""

from __future__ import annotations

import importlib
import os
import sys
import traceback
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE / "faults"), str(HERE.parents[1])]
os.environ["OPENBLAS_NUM_THREADS"] = "1"  # numpy starts in half the time
os.environ["PROTOCOL_EXCHANGE"] = "stdlib"  # faults are pieces of Python put in place of others


def main() -> int:
    """Serve one session with the fault that the command line names."""
    from fault import FAULTS, Deliberate

    from protocol import physics
    from protocol.errors import ProtocolError

    for path in sorted((HERE / "faults").glob("*_faults.py")):
        importlib.import_module(path.stem)
    if sys.argv[1] == "--list":
        sys.stdout.write("\n".join(FAULTS) + "\n")
        return 0
    try:
        physics.serve(sys.argv[2], FAULTS[sys.argv[1]]())
    except (ProtocolError, Deliberate) as error:
        sys.stderr.write(f"{type(error).__name__}: {error}\n")
        return 3
    except Exception:  # noqa: BLE001  whatever else it is, the fault is broken and not the server
        traceback.print_exc()
        sys.stderr.write("NOT MEANT\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
