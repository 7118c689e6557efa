"""Recordings: the hash chain, and other formats read back by readers that are not ours."""

from __future__ import annotations

import csv
import errno
import hashlib
import json
import os
from pathlib import Path

import numpy as np
import pytest
from flights import Done, run_here

from cosim.errors import OutputError, RunError
from cosim.export import export
from cosim.runs import Run, read_run


@pytest.fixture
def run(conduit_run: tuple[Done, Path]) -> Run:
    """The recorded flight through the conduit."""
    return read_run(conduit_run[1])


def test_the_log_holds_every_step(run: Run, conduit_run: tuple[Done, Path]) -> None:
    """One record for the reset pose and one a control step, in order, evenly spaced in simulated time."""
    assert len(run.records) == conduit_run[0].report["steps"] + 1
    assert np.array_equal(run.records["step"], np.arange(len(run.records)))
    np.testing.assert_allclose(np.diff(run.records["sim_time"]), 0.1, rtol=1e-9)


def test_the_hash_is_that_of_the_recorded_payloads(run: Run, conduit_run: tuple[Done, Path]) -> None:
    """Anyone can recompute trajectory_hash from the first 192 bytes of every record."""
    chain = b""
    for record in run.records:
        chain = hashlib.sha256(chain + record.tobytes()[:192]).digest()
        assert record["chain"].tobytes() == chain
    assert chain.hex() == conduit_run[0].report["trajectory_hash"]


def test_reward_terms_sum_to_the_reward(run: Run) -> None:
    """The recorded terms explain the recorded reward."""
    np.testing.assert_allclose(run.records["reward_terms"].sum(axis=1), run.records["reward"], atol=1e-12)


def test_csv_is_read_back_by_the_csv_module(run: Run, tmp_path: Path) -> None:
    """Every number of the log stands in the CSV, exactly."""
    path, _ = export(run.folder, "csv", tmp_path / "run.csv")
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(run.records)
    assert [float(row["position_z"]) for row in rows] == run.records["position"][:, 2].tolist()
    assert [float(row["quaternion_w"]) for row in rows] == run.records["quaternion"][:, 3].tolist()
    assert rows[-1]["chain"] == run.manifest["trajectory_hash"]
    assert [int(row["action"]) for row in rows] == run.records["action"].tolist()


def test_npz_is_read_back_by_numpy_without_pickle(run: Run, tmp_path: Path) -> None:
    """Fields keep name, shape and type; the manifest travels along."""
    path, _ = export(run.folder, "npz", tmp_path / "run.npz")
    with np.load(path, allow_pickle=False) as archive:
        assert np.array_equal(archive["linear_velocity"], run.records["linear_velocity"])
        assert json.loads(str(archive["manifest"]))["outcome"]["outcome"] == "success"


def test_parquet_is_read_back_by_pyarrow_with_units(run: Run, tmp_path: Path) -> None:
    """Columns keep their values, units and frames."""
    pq = pytest.importorskip("pyarrow.parquet", reason="the extra 'export' is not installed")
    table = pq.read_table(export(run.folder, "parquet", tmp_path / "run.parquet")[0])
    assert table["position_x"].to_pylist() == run.records["position"][:, 0].tolist()
    assert table.schema.field("position_x").metadata == {b"unit": b"m", b"frame": b"world"}
    assert json.loads(table.schema.metadata[b"cosim.manifest"])["format"] == 2
    assert table["chain"][-1].as_py() == run.manifest["trajectory_hash"]
    described = json.loads(table.schema.metadata[b"cosim.columns"])
    assert set(described) == set(table.column_names)
    assert described["angular_velocity_z"] == {"unit": "rad/s", "frame": "world"}


def test_an_export_never_replaces_the_run_itself(run: Run) -> None:
    """The log and the manifest are refused as targets, and stay as they are."""
    before = (run.folder / "steps.bin").read_bytes()
    for own in ("steps.bin", "manifest.json"):
        with pytest.raises(OutputError, match="run's own"):
            export(run.folder, "csv", run.folder / own)
    assert (run.folder / "steps.bin").read_bytes() == before


def test_a_log_cut_short_ends_with_its_last_whole_record(run: Run, tmp_path: Path) -> None:
    """Half a record at the end, as a crash leaves it, is not read."""
    (tmp_path / "manifest.json").write_bytes((run.folder / "manifest.json").read_bytes())
    size = run.records.dtype.itemsize
    (tmp_path / "steps.bin").write_bytes((run.folder / "steps.bin").read_bytes()[: 7 * size + size // 2])
    assert len(read_run(tmp_path).records) == 7


def test_a_full_disk_ends_a_flight_that_is_saved_so_far(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The log is put on the disk itself once a second; where that fails the flight ends, and what stands is read."""
    fsync, calls = os.fsync, []

    def full(handle: int) -> None:
        calls.append(handle)
        if len(calls) == 4:  # the manifest, its folder, the reset pose; then the log a second later
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fsync(handle)

    monkeypatch.setattr("os.fsync", full)
    monkeypatch.setattr("cosim.recording.SYNC_NS", 0)
    done = run_here("launch", "--max-steps", "5", "--out", str(tmp_path / "run"))
    assert done.status == 2
    assert "steps.bin cannot be written: No space left on device; 2 records stand" in done.stderr
    run = read_run(tmp_path / "run")
    assert (run.manifest["status"], len(run.records)) == ("failed", 2)


def test_a_folder_without_a_run_is_refused(tmp_path: Path) -> None:
    """The error names the manifest that is missing or damaged."""
    with pytest.raises(RunError, match=r"manifest\.json"):
        read_run(tmp_path)
    (tmp_path / "manifest.json").write_text("{")
    with pytest.raises(RunError, match="JSON"):
        read_run(tmp_path)
    (tmp_path / "manifest.json").write_text('{"format": 99}')
    with pytest.raises(RunError, match="expected 2, found 99"):
        read_run(tmp_path)
