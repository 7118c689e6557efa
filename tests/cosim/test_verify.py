"""Proof of a run: replayed poses are the recorded ones bit for bit, and whatever was changed is found and named."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from flights import Done, manifest_of, run_cosim, run_here

from cosim.errors import RunError
from cosim.integrity import Finding, check_data
from cosim.pilots import SHIPPED_CHECKPOINT, choose_pilot, read_pilot
from cosim.recording import manifest_digest, manifest_text
from cosim.runs import read_run


@pytest.fixture
def copied(conduit_run: tuple[Done, Path], tmp_path: Path) -> Path:
    """A copy of the recorded flight, to be damaged."""
    shutil.copytree(conduit_run[1], tmp_path / "copy")
    return tmp_path / "copy"


def flip(folder: Path, step: int, byte: int, bit: int) -> None:
    """Flip one bit of one record."""
    size = read_run(folder).records.dtype.itemsize
    log = bytearray((folder / "steps.bin").read_bytes())
    log[step * size + byte] ^= 1 << bit
    (folder / "steps.bin").write_bytes(log)


def rewrite(folder: Path, change: Callable[[dict], None], renew: bool = False) -> None:
    """Change the manifest, with its digest renewed or not."""
    path = folder / "manifest.json"
    manifest = json.loads(path.read_text())
    change(manifest)
    if renew:
        manifest["manifest_sha256"] = manifest_digest(manifest)
    path.write_text(manifest_text(manifest))


def test_a_run_verifies_and_says_how_long_physics_took(conduit_run: tuple[Done, Path]) -> None:
    """A fresh physics process makes every recorded pose again, bit for bit."""
    done = run_cosim("verify", str(conduit_run[1]), "--json", cwd=conduit_run[1])
    assert done.status == 0, done.stderr
    report = done.report
    assert report["verified"]
    assert (report["damage"], report["changed_files"], report["changed_versions"]) == ([], [], [])
    assert report["replay"]["steps"] == conduit_run[0].report["steps"]
    assert report["replay"]["first_difference"] is None


def test_an_undamaged_run_has_no_finding(conduit_run: tuple[Done, Path]) -> None:
    """Nothing is found in a folder that nobody touched."""
    assert list(check_data(read_run(conduit_run[1]))) == []


@pytest.mark.parametrize("seed", range(12))
def test_one_flipped_bit_anywhere_is_found_by_step_and_quantity(copied: Path, seed: int) -> None:
    """Whichever bit of the log is flipped, the step and the name of the quantity are those of that bit."""
    run = read_run(copied)
    rng = np.random.default_rng(seed)
    column = run.columns[rng.integers(len(run.columns))]
    width = np.dtype((column.type, column.shape)).itemsize
    step = int(rng.integers(len(run.records)))
    flip(copied, step, column.offset + int(rng.integers(width)), int(rng.integers(8)))
    (finding,) = check_data(read_run(copied))
    assert finding.step == step
    assert finding.what == column.name or finding.what.startswith(f"{column.name}_")


def test_larger_damage_is_found_by_its_step(copied: Path) -> None:
    """Where several bits differ, the record is named and no quantity is invented."""
    for byte, bit in ((70, 1), (200, 3), (201, 5)):
        flip(copied, 7, byte, bit)
    (finding,) = check_data(read_run(copied))
    assert (finding.step, finding.what) == (7, "record")


def test_a_log_that_was_cut_or_reordered_is_found(copied: Path) -> None:
    """A missing end, and a record that was taken out, do not pass although every record is whole."""
    size = read_run(copied).records.dtype.itemsize
    whole = (copied / "steps.bin").read_bytes()
    (copied / "steps.bin").write_bytes(whole[: -2 * size - 5])
    assert [finding.what for finding in check_data(read_run(copied))] == ["steps.bin"]
    (copied / "steps.bin").write_bytes(whole[: 50 * size] + whole[51 * size :])
    findings = list(check_data(read_run(copied)))
    assert Finding("hash chain", "the hash of all commands and poses so far", "another", 50) in findings


def test_a_changed_manifest_is_found(copied: Path) -> None:
    """Any value of the manifest that was edited shows."""
    rewrite(copied, lambda manifest: manifest["outcome"].update(quality=0.999))
    (finding,) = check_data(read_run(copied))
    assert finding.what == "manifest.json"


def test_a_bit_of_the_manifest_that_changes_no_value_is_found(copied: Path) -> None:
    """An exponent of another case, a digit beyond a number's precision: the text is not what was recorded."""
    path = copied / "manifest.json"
    path.write_text(path.read_text().replace("e-", "E-", 1))
    (finding,) = check_data(read_run(copied))
    assert (finding.what, finding.found) == ("manifest.json", "another of the same values")


@pytest.mark.parametrize(
    "change",
    [
        lambda manifest: manifest.pop("mesh"),
        lambda manifest: manifest["options"].pop("transport"),
        lambda manifest: manifest["mesh"].update(axes="zuq"),
        lambda manifest: manifest.update(versions="1"),
        lambda manifest: manifest["reset"].update(seed="?"),
    ],
    ids=["no mesh", "no transport", "unknown axes", "no versions", "no seed"],
)
def test_a_manifest_that_makes_no_sense_any_more_is_named(
    copied: Path, change: Callable[[dict], None]
) -> None:
    """Whatever is missing or of another kind, the manifest is what was changed, and no fault of cosim itself."""
    rewrite(copied, change)
    done = run_here("verify", str(copied), "--json")
    assert done.status == 1, done.stderr
    assert [finding["what"] for finding in done.report["damage"]] == ["manifest.json"]
    assert "the manifest, which was changed" in done.report["not_replayed"]


def test_a_damaged_description_of_a_record_is_refused(copied: Path) -> None:
    """A field of another name, and a type that numpy does not know, name the manifest."""
    for change in ({"name": "chaio"}, {"type": "<f8,"}):
        rewrite(copied, lambda manifest, change=change: manifest["record"][11].update(change))
        with pytest.raises(RunError, match=r"manifest\.json: .*record"):
            read_run(copied)


def test_a_policy_is_recorded_where_it_is_from_any_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A checkpoint that was named relative to the working folder is found from another one."""
    (tmp_path / "mine.zip").write_bytes(SHIPPED_CHECKPOINT.read_bytes())
    monkeypatch.chdir(tmp_path)
    assert read_pilot(choose_pilot("mine.zip")).description["path"] == str(tmp_path / "mine.zip")


def test_files_that_were_moved_are_named_with_what_to_say(copied: Path, tmp_path: Path) -> None:
    """A mesh that is gone is named with the option that says where it is; with it, and the policy's, all is found."""
    described = manifest_of(copied)

    def change(manifest: dict) -> None:
        manifest["mesh"]["path"] = manifest["policy"]["path"] = str(tmp_path / "gone")

    rewrite(copied, change, renew=True)
    gone = run_here("verify", str(copied))
    assert gone.status == 1
    assert "if it was moved, say where it is: --mesh" in gone.stdout
    places = ("--mesh", described["mesh"]["path"], "--policy", described["policy"]["path"])
    found = run_here("verify", str(copied), *places)
    assert found.status == 0, found.stdout


def test_a_changed_command_is_named_where_physics_first_differs(copied: Path) -> None:
    """Of a flipped bit of a command, the record is named, and the step at which poses part."""
    offset = next(c.offset for c in read_run(copied).columns if c.name == "commanded_speed")
    flip(copied, 100, offset + 6, 2)
    done = run_cosim("verify", str(copied), "--json", cwd=copied)
    assert done.status == 1
    (damage,) = done.report["damage"]
    assert (damage["step"], damage["what"]) == (100, "commanded_speed")
    difference = done.report["replay"]["first_difference"]
    assert difference["step"] == 100
    assert done.report["replay"]["steps"] == 100


def test_another_physics_process_is_named_by_its_first_difference(copied: Path) -> None:
    """An engine that moves nothing gives other poses from the start or the first step on."""
    server = f"{sys.executable} -m physics_server --engine null"
    done = run_cosim("verify", str(copied), "--server", server, "--json", cwd=copied)
    assert done.status == 1
    assert done.report["damage"] == []
    assert done.report["replay"]["first_difference"]["step"] <= 1


def test_a_changed_mesh_is_found_and_not_flown(copied: Path, tmp_path: Path) -> None:
    """Files that are not the recorded ones are named with both hashes; another mesh is not replayed."""
    manifest = json.loads((copied / "manifest.json").read_text())
    mesh = tmp_path / "moved.obj"
    mesh.write_bytes(Path(manifest["mesh"]["path"]).read_bytes() + b"\n")
    done = run_here("verify", str(copied), "--mesh", str(mesh))
    assert done.status == 1
    assert f"mesh {mesh}: expected SHA-256 {manifest['mesh']['sha256'][:16]}" in done.stdout
    assert "not replayed" in done.stdout


def test_a_changed_policy_and_version_are_named(copied: Path, tmp_path: Path) -> None:
    """A policy file with another hash fails; a version that differs is a note, since the poses tell."""
    other = tmp_path / "other.zip"
    other.write_bytes(b"another policy")

    def change(manifest: dict) -> None:
        manifest["policy"]["path"] = str(other)
        manifest["versions"]["numpy"] = "1.0"
        manifest["plant"]["engine"] = "bullet 2.0"

    rewrite(copied, change, renew=True)
    done = run_cosim("verify", str(copied), cwd=copied)
    assert done.status == 1
    assert f"policy {other}: expected SHA-256" in done.stdout
    assert "note: version of numpy: expected 1.0" in done.stdout
    assert "note: engine of physics: expected bullet 2.0" in done.stdout
    assert "bit for bit" in done.stdout


def test_a_run_that_was_cut_short_verifies_as_far_as_it_goes(copied: Path) -> None:
    """A crash leaves a manifest that says running and half a record: the whole ones are checked and replayed."""

    def change(manifest: dict) -> None:
        manifest["status"] = "running"
        for key in ("records", "trajectory_hash", "outcome"):
            del manifest[key]

    rewrite(copied, change, renew=True)
    size = read_run(copied).records.dtype.itemsize
    (copied / "steps.bin").write_bytes((copied / "steps.bin").read_bytes()[: 60 * size + size // 2])
    done = run_cosim("verify", str(copied), "--json", cwd=copied)
    assert done.status == 0, done.stdout
    assert (done.report["status"], done.report["replay"]["steps"]) == ("running", 59)
