"""`python tests/soak steps|kills|pauses`: at length what every run of the suite does in seconds.

steps    so many control steps over either transport, by every way to exchange them, all words checked on both sides
kills    so many random kills of either side, each of which must be noticed in time and leave nothing
pauses   so many rounds of one flight, frozen, slowed, on other cores, by other ways to wait: always the same bytes

Exit status 0 if all is well.
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
from typing import Any

from kills import BOUND_S, run_kills
from pair import exchanges
from pauses import run_pauses
from steps import run_steps

TRANSPORTS = ("shm", "file")


def main() -> int:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(prog="python tests/soak", description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("steps", "kills", "pauses"))
    parser.add_argument("--count", type=_count, required=True)
    parser.add_argument("--seed", type=int, default=0, help="of the random moments")
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    asked = parser.parse_args()
    logging.disable(logging.WARNING)  # an agent whose server was killed at the goodbye says so
    run = {"steps": _steps, "kills": _kills, "pauses": _pauses}[asked.what]
    report, well = run(asked.count, asked.seed)
    sys.stdout.write(json.dumps(report) + "\n" if asked.json else _text(report))
    return 0 if well else 1


def _count(text: str) -> int:
    """Parse how many there are to be: one at least."""
    if (count := int(text)) < 1:
        raise argparse.ArgumentTypeError(f"expected 1 or more, found {count}")
    return count


def _steps(count: int, _seed: int) -> tuple[dict[str, Any], bool]:
    ways = exchanges()
    return {f"{place}, {way}": run_steps(count, place, way) for place in TRANSPORTS for way in ways}, True


def _kills(count: int, seed: int) -> tuple[dict[str, Any], bool]:
    report = run_kills(count, seed)
    in_time = report["noticed_ms"].get("max", 0.0) <= 1000 * BOUND_S  # none where every kill ended in a fault
    return report | {"within_bound": in_time}, in_time and not report["faults"]


def _pauses(count: int, seed: int) -> tuple[dict[str, Any], bool]:
    rounds = [run_pauses(seed + number) for number in range(count)]
    flights = {
        name: {
            "hash": ", ".join(sorted({flown[name]["hash"] for flown in rounds})),
            "freezes": sum(flown[name]["freezes"] for flown in rounds),
        }
        for name in rounds[0]
    }
    return flights, len({flight["hash"] for flight in flights.values()}) == 1


def _text(report: dict[str, Any]) -> str:
    lines, width = [], max(map(len, report))
    for name, value in report.items():
        if name == "steps" and value:
            value = f"from {value[0]} to {value[-1]}, median {value[len(value) // 2]}"
        shown = ", ".join(f"{k} {v}" for k, v in value.items()) if isinstance(value, dict) else value
        lines.append(f"{name:{width}}  {shown}")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
