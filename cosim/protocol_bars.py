"""What `cosim bench --protocol` knows before it measures: the names of the ways, and the project's own bars."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

EXCHANGES: Final = ("stdlib", "compiled")
ONE_CORE: Final = "_one_core"
WAYS: Final = (
    "session_stdlib",
    "session_compiled",
    "udp",
    "udp_polling",
    "pipe",
    "semaphores",
    "pyzmq",
    "grpc_unary",
    "iceoryx2",
    "pybullet_server",
    "session_csharp_stdlib",
    "session_csharp_compiled",
    "session_c_stdlib",
    "session_c_compiled",
    "session_stdlib_one_core",
    "session_compiled_one_core",
    "udp_one_core",
    "pipe_one_core",
    "semaphores_one_core",
)
"""Ways to make round trips; the session's by the language of the physics side, if not Python, and the exchange."""

OVER_UDP: Final = {
    "session_stdlib": 0.55,
    "session_compiled": 0.35,
    "session_csharp_compiled": 0.35,
    "session_stdlib_one_core": 1.0,
    "session_compiled_one_core": 1.0,
}
"""The largest p50 over that of UDP on as many cores."""
P99_OVER_P50: Final = 1.5
LANES: Final = 64
LANES_OVER_ONE: Final = 4.0
"""So many lanes cost less than this many times one, in transport."""
OBSERVER: Final = 1.10
"""The largest p50 with an observer over that without."""
OBSERVED: Final = ("20_hz", "60_hz")
"""The observer's rates to which that bar applies."""


@dataclass(frozen=True)
class Bar:
    """A ratio that was measured, and the largest that the project allows itself."""

    name: str
    found: float
    bar: float
    exclusive: bool = False
    """Whether the bar itself is missed already."""

    @property
    def reached(self) -> bool:
        """Whether it holds."""
        return self.found < self.bar or (self.found == self.bar and not self.exclusive)


def judge(figures: dict[str, Any]) -> list[Bar]:
    """The bars whose figures were measured; `figures` are those of `cosim bench --protocol`."""
    return [*_trips(figures["round_trip"]), *_lanes(figures.get("lanes", {})), *_observer(figures)]


def _trips(rows: dict[str, dict[str, float]]) -> Iterator[Bar]:
    for name, bar in OVER_UDP.items():
        if "over_udp" in rows.get(name, {}):
            yield Bar(f"{name}: p50 over UDP's", rows[name]["over_udp"], bar)
    for exchange in EXCHANGES:
        name = f"session_{exchange}"
        if name in rows:
            found = round(rows[name]["p99_us"] / rows[name]["p50_us"], 3)
            yield Bar(f"{name}: p99 over p50", found, P99_OVER_P50)


def _lanes(table: dict[str, list[dict[str, float]]]) -> Iterator[Bar]:
    for exchange, rows in table.items():
        for row in rows:
            if row["lanes"] == LANES:
                name = f"session_{exchange}: transport of {LANES} lanes over one's"
                yield Bar(name, row["transport_over_one_lane"], LANES_OVER_ONE, exclusive=True)


def _observer(figures: dict[str, Any]) -> Iterator[Bar]:
    for name in OBSERVED:
        if "observer" in figures:
            yield Bar(
                f"observer {name}: p50 over that without", figures["observer"][name]["p50_ratio"], OBSERVER
            )
