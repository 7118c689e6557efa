"""`python tests/soak steps|kills`: what takes too long for every run of the suite, which does the same shorter.

steps   so many control steps over either transport, every word of which is checked on both sides
kills   so many random kills of either side, each of which must be noticed in time and leave nothing

Exit status 0 if all is well.
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
from typing import Any

from kills import BOUND_S, run_kills
from steps import run_steps

TRANSPORTS = ("shm", "file")


def main() -> int:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(prog="python tests/soak", description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("steps", "kills"))
    parser.add_argument("--count", type=int, required=True)
    parser.add_argument("--seed", type=int, default=0, help="of the kills")
    parser.add_argument(
        "--json", action="store_true", help="one JSON object on stdout and no verdict on times"
    )
    asked = parser.parse_args()
    logging.disable(logging.WARNING)  # an agent whose server was killed at the goodbye says so
    report, well = _steps(asked.count) if asked.what == "steps" else _kills(asked.count, asked.seed)
    sys.stdout.write(json.dumps(report) + "\n" if asked.json else _text(report))
    return 0 if well else 1


def _steps(count: int) -> tuple[dict[str, Any], bool]:
    runs = [run_steps(count, transport) for transport in TRANSPORTS]
    return {run["transport"]: run for run in runs}, True


def _kills(count: int, seed: int) -> tuple[dict[str, Any], bool]:
    report = run_kills(count, seed)
    in_time = report["noticed_ms"]["max"] <= 1000 * BOUND_S
    return report | {"within_bound": in_time}, in_time and not report["faults"]


def _text(report: dict[str, Any]) -> str:
    lines = []
    for name, value in report.items():
        if name == "steps":
            value = f"from {value[0]} to {value[-1]}, median {value[len(value) // 2]}"
        shown = ", ".join(f"{k} {v}" for k, v in value.items()) if isinstance(value, dict) else value
        lines.append(f"{name:22} {shown}")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
