"""`cosim inspect`: what it says, writes and refuses; the measures themselves are tested with the meshes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from flights import run_here

from meshes.centreline import parse_centreline

SIDES, LENGTH, RADIUS = 24, 10.0, 0.5


@pytest.fixture
def pipe(tmp_path: Path) -> Path:
    """A straight open pipe along x, without a centreline."""
    angles = 2.0 * np.pi * np.arange(SIDES) / SIDES
    lines = [
        f"v {x:.9g} {RADIUS * np.cos(a):.9g} {RADIUS * np.sin(a):.9g}"
        for x in np.linspace(0.0, LENGTH, 21)
        for a in angles
    ]
    for ring in range(20):
        for side in range(SIDES):
            a, b = ring * SIDES + side + 1, ring * SIDES + (side + 1) % SIDES + 1
            lines.append(f"f {a} {b} {b + SIDES} {a + SIDES}")
    path = tmp_path / "pipe.obj"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_pipe_is_measured_and_its_centreline_written(pipe: Path, tmp_path: Path) -> None:
    """JSON on stdout; pictures and the found centreline in --out, which runs along the pipe's axis."""
    out = tmp_path / "out"
    done = run_here("inspect", str(pipe), "--json", "--out", str(out))
    assert done.status == 0, done.stderr
    assert json.loads(done.stdout)
    assert list(out.glob("*.png"))
    (centreline,) = out.glob("*centerline.obj")
    points = parse_centreline(centreline.read_bytes(), centreline)
    assert np.abs(points[:, 1:]).max() < 0.05 * RADIUS
    assert np.ptp(points[:, 0]) == pytest.approx(LENGTH, abs=0.1)


def test_what_is_no_tube_is_refused_with_one_sentence(tmp_path: Path) -> None:
    """A plane has nothing inside: status 2 and the reason."""
    plane = tmp_path / "plane.obj"
    plane.write_text("v 0 0 0\nv 9 0 0\nv 9 9 0\nv 0 9 0\nf 1 2 3 4\n")
    done = run_here("inspect", str(plane))
    assert done.status == 2
    assert "plane.obj" in done.stderr
