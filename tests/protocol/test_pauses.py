"""Time is not part of a flight: freezes, slow sides, cores, ways to wait and transports change no bit of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

Soak = Callable[..., dict[str, Any]]


def test_whatever_only_takes_time_changes_no_bit(soak: Soak) -> None:
    """One flight whose commands follow from its poses: the same hash of all of them however it is disturbed."""
    flights = soak("pauses", "--count", "1")
    assert {name: flown["hash"] for name, flown in flights.items()} == dict.fromkeys(
        flights, flights["twin"]["hash"]
    )
    assert all((flown["freezes"] > 0) == ("frozen" in name) for name, flown in flights.items())


def test_no_step_of_a_long_run_is_lost_doubled_or_torn(soak: Soak) -> None:
    """20,000 steps over either transport, with and without machine code: each side checks every word of each."""
    runs = soak("steps", "--count", "20000")
    assert {"shm, stdlib", "file, stdlib"} <= set(runs)
    for name, run in runs.items():
        assert run["exchange"].startswith(name.split(", ")[1])
        assert (run["steps"], run["integrated"], run["refused"]) == (20_000, 20_000, 20_000 // 997)
