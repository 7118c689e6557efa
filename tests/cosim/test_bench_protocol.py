"""The benchmark of the protocol measures, says what it cannot, and draws; how fast anything is, is not asserted."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from cosim import native
from cosim.bench_protocol import LANES, LOOK, Effort, _entries, _lanes, measure_protocol
from cosim.cli import cosim
from cosim.errors import CosimError
from cosim.idle import idle_percent
from cosim.observer_cost import RATES
from cosim.protocol_bars import WAYS, judge
from cosim.protocol_table import protocol_table
from cosim.requirements import install_command
from cosim.round_trip import LEAST, time_exchanges, two_cores

BRIEF = Effort(samples=80, seconds=0.05, repeats=1, idle_s=0.1)

needs_cc = pytest.mark.skipif(
    native.shutil.which("cc") is None, reason="no C compiler: apt-get install gcc libc6-dev"
)
needs_two_cores = pytest.mark.skipif(len(two_cores()) < 2, reason="this machine has one core")


def silent(_text: str) -> None:
    """Say nothing."""


@needs_two_cores
def test_the_command_prints_one_json_object_of_the_documented_fields(tmp_path: Path) -> None:
    """With --json stdout is the figures; each way has quantiles in order and its ratio over UDP."""
    picture = tmp_path / "trips.png"
    arguments = [
        "bench",
        "--protocol",
        "--quick",
        "--json",
        "--only",
        "session_stdlib, udp",
        "--png",
        str(picture),
    ]
    done = CliRunner().invoke(cosim, arguments)
    assert done.exit_code == 0, done.output
    figures = json.loads(done.stdout)
    assert set(figures) == {"machine", "effort", "round_trip", "bars", "skipped", "png"}
    assert set(figures["round_trip"]) == {"session_stdlib", "udp"}
    for row in figures["round_trip"].values():
        assert 0 < row["p50_us"] <= row["p99_us"] <= row["p999_us"]
    trips = figures["round_trip"]
    expected = trips["session_stdlib"]["p50_us"] / trips["udp"]["p50_us"]
    assert trips["session_stdlib"]["over_udp"] == pytest.approx(expected, abs=1e-3)
    assert picture.read_bytes().startswith(b"\x89PNG")
    over_udp, spread = figures["bars"]
    assert (over_udp["found"], over_udp["bar"]) == (trips["session_stdlib"]["over_udp"], 0.55)
    assert spread["found"] == pytest.approx(
        trips["session_stdlib"]["p99_us"] / trips["session_stdlib"]["p50_us"], abs=1e-3
    )
    for row in figures["bars"]:
        assert row["reached"] == (row["found"] <= row["bar"])
        assert ("reached" if row["reached"] else "missed") in protocol_table(figures)


def test_a_bar_is_judged_where_its_figure_was_measured() -> None:
    """Each bar of the project stands beside its figure; on the bar is reached, but lanes have to be below it."""
    lanes = [{"lanes": 1, "transport_over_one_lane": 1.0}, {"lanes": 64, "transport_over_one_lane": 4.0}]
    found = judge(
        {
            "round_trip": {
                "session_csharp_compiled": {"p50_us": 2.0, "p99_us": 9.0, "over_udp": 0.35},
                "session_compiled": {"p50_us": 2.0, "p99_us": 3.1, "over_udp": 0.36},
                "udp": {"p50_us": 5.0, "p99_us": 9.0, "over_udp": 1.0},
            },
            "lanes": {"stdlib": lanes},
            "observer": {name: {"p50_ratio": 1.1} for name in RATES},
        }
    )
    assert [(bar.name.split(":")[0], bar.found, bar.bar, bar.reached) for bar in found] == [
        ("session_compiled", 0.36, 0.35, False),
        ("session_csharp_compiled", 0.35, 0.35, True),
        ("session_compiled", 1.55, 1.5, False),
        ("session_stdlib", 4.0, 4.0, False),
        ("observer 20_hz", 1.1, 1.1, True),
        ("observer 60_hz", 1.1, 1.1, True),
    ]
    assert judge({"round_trip": {}}) == []


def test_the_help_names_every_way_and_nothing_else(tmp_path: Path) -> None:
    """--only offers the ways that are there."""
    skipped: dict[str, str] = {}
    entries = _entries(tmp_path, (), skipped)
    assert set(entries) | set(skipped) == set(WAYS)
    done = CliRunner().invoke(cosim, ["bench", "--help-all"])
    assert all(name in done.output for name in WAYS)


def test_slow_round_trips_are_still_enough_for_a_median() -> None:
    """However little time there is, a repeat has as many as a median needs."""
    assert len(time_exchanges(lambda: None, 1000, seconds=0.0)) == LEAST
    assert len(time_exchanges(lambda: None, 3, seconds=0.0)) == 3


def test_options_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    """An unknown way, a figure in no folder, and options without --protocol are one sentence each."""
    with pytest.raises(CosimError, match=r"--only: expected some of session_stdlib, .*found 'smoke_signals'"):
        measure_protocol(LOOK, ("smoke_signals",), silent)
    missing = str(tmp_path / "nowhere" / "x.png")
    for arguments in (
        ["--only", "udp"], ["--png", "x.png"], ["--protocol", "--training"], ["--protocol", "--png", missing],
    ):  # fmt: skip
        done = CliRunner().invoke(cosim, ["bench", *arguments])
        assert done.exit_code == 2, done.output


def test_a_library_that_is_missing_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    """A way whose library is not installed is left out, with what to install."""
    for name in ("zmq", "iceoryx2", "grpc"):
        monkeypatch.setitem(sys.modules, name, None)
    figures, samples = measure_protocol(BRIEF, ("pyzmq", "iceoryx2", "grpc_unary"), silent)
    assert set(figures["skipped"]) == {"pyzmq", "iceoryx2", "grpc_unary"}
    assert all(install_command("bench") in why for why in figures["skipped"].values())
    assert samples == {}
    assert "not measured:" in protocol_table(figures)


@needs_two_cores
def test_every_way_of_the_standard_library_and_of_pybullet_makes_round_trips(
    capfd: pytest.CaptureFixture[str],
) -> None:
    """They measure what they are asked to, leave no process behind, and print nothing from C."""
    names = ("pipe", "semaphores", "udp_polling", "pybullet_server")
    figures, samples = measure_protocol(BRIEF, names, silent)
    assert figures["skipped"] == {}
    assert capfd.readouterr() == ("", "")
    assert set(samples) == set(names)
    assert all((rows > 0).all() and len(rows) for rows in samples.values())


@needs_cc
@needs_two_cores
def test_peers_and_floor_in_c_are_compiled_on_the_spot(tmp_path: Path) -> None:
    """The C server is measured through the whole session, and the floor is below it."""
    figures, _ = measure_protocol(BRIEF, ("session_c_stdlib",), silent)
    floor = native.run_floor(native.build_floor(tmp_path), two_cores(), 1, 500)
    assert 0 < floor["p50_us"] < figures["round_trip"]["session_c_stdlib"]["p50_us"]


def test_a_missing_compiler_is_said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Without compilers the peers in C and C# are left out, with what to install."""
    monkeypatch.setattr(native.shutil, "which", lambda _tool: None)
    figures, _ = measure_protocol(BRIEF, ("session_c_stdlib", "session_csharp_stdlib"), silent)
    assert "apt-get install gcc" in figures["skipped"]["session_c_stdlib"]
    assert "apt-get install mono-mcs" in figures["skipped"]["session_csharp_stdlib"]
    with pytest.raises(native.MissingToolError, match="cc is not installed"):
        native.build_floor(tmp_path)


@needs_two_cores
def test_lanes_are_measured_from_1_to_256() -> None:
    """Each number of lanes has its time of a step and, as part of it, of transport; one lane is its own measure."""
    table = _lanes(BRIEF, {"session_compiled": "to be quick"})
    assert list(table) == ["stdlib"]
    assert [row["lanes"] for row in table["stdlib"]] == list(LANES)
    assert table["stdlib"][0]["transport_over_one_lane"] == 1.0
    for row in table["stdlib"]:
        assert row["transport_us"] < row["step_us"]
        assert row["transport_us_per_lane"] == pytest.approx(row["transport_us"] / row["lanes"], abs=1e-3)


def test_a_waiting_pair_hardly_takes_a_core() -> None:
    """Both sides of a session sleep while nothing happens."""
    skipped: dict[str, str] = {}
    idle = idle_percent(0.3, skipped)
    if skipped:
        pytest.skip(skipped["idle_percent"])
    assert set(idle) == {"physics", "agent"}
    assert all(np.isfinite(share) and 0.0 <= share < 50.0 for share in idle.values())
