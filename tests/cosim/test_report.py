"""`cosim report` without a browser: what stands in the page, and what is refused."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flights import Done, run_here
from pages import PageData, copy_run, evaluation_results, read_page

from cosim.errors import OutputError
from cosim.recording import LOG, MANIFEST
from cosim.report import PAGE, report
from cosim.report_axis import curvature_along
from cosim.report_run import Kept
from cosim.report_tube import outward, simplify
from cosim.runs import read_run
from cosim.scene import Surface

MEGABYTE = 10**6


@pytest.fixture(scope="module")
def page(conduit_run: tuple[Done, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of the flight through the conduit."""
    return report([conduit_run[1]], tmp_path_factory.mktemp("page") / "page.html")


@pytest.fixture(scope="module")
def content(page: Path) -> PageData:
    """The data in it."""
    return read_page(page)


def test_the_command_writes_into_the_run_and_prints_where(
    conduit_run: tuple[Done, Path], tmp_path: Path
) -> None:
    """Without --out the page is RUN/report.html, and its path is all that stdout says."""
    run = copy_run(conduit_run[1], tmp_path / "run")
    done = run_here("report", str(run))
    assert (done.status, done.stdout, done.stderr) == (0, f"{run / PAGE}\n", "")
    assert (run / PAGE).is_file()
    assert sorted(path.name for path in run.iterdir()) == [MANIFEST, PAGE, LOG]


def test_the_page_is_whole_in_itself(page: Path) -> None:
    """Nothing in it is fetched: no address in src, href, url() or import, and its own policy forbids all requests."""
    text = page.read_text()
    markup = re.sub(r"<script.*?</script>", "", text, flags=re.DOTALL)
    assert "default-src 'none'" in markup
    assert not re.search(r"""(src|href)\s*=\s*["']?(?!#|data:)""", markup)
    assert not re.search(r"url\(|@import|<link|<iframe|<object", markup)
    assert not re.search(
        r"\bfetch\(\s*[\"'`]|XMLHttpRequest\(\)\.open|\bimport\(", text.split("window.cosimReport")[-1]
    )


def test_the_page_holds_what_was_recorded(content: PageData, conduit_run: tuple[Done, Path]) -> None:
    """Every curve is its column of the log in single precision, and the figures are what the flight reported."""
    run, done = read_run(conduit_run[1]), conduit_run[0]
    (shown,) = content.data["runs"]
    series = {name: content.array(number) for name, number in shown["series"].items()}
    made = {"speed", "velocity", "curvature", "S_F", "S_R", "step_time", "lidar", "time"}
    for name in series.keys() - made:
        recorded = run.records[name].astype(series[name].dtype)
        np.testing.assert_array_equal(series[name], recorded, err_msg=name)
    assert np.array_equal(series["time"], run.records["sim_time"].astype(np.float32))
    speed = np.linalg.norm(run.records["linear_velocity"], axis=1)
    np.testing.assert_allclose(series["speed"], speed, atol=1e-6)
    np.testing.assert_allclose(series["step_time"], 1e-9 * run.records["phases"].sum(axis=1), rtol=1e-6)
    reach = shown["lidar"]["reach"]
    np.testing.assert_allclose(
        series["lidar"] * reach / 255.0, run.records["lidar"], atol=0.5 * reach / 255.0 + 1e-9
    )
    assert (shown["outcome"], shown["steps"]) == (done.report["outcome"], done.report["steps"])
    for name in ("trajectory_hash", "contacts", "progress", "quality", "steps_per_second"):
        assert shown[name] == done.report[name], name
    assert shown["gap"] == pytest.approx(done.report["min_clearance_m"], abs=1e-12)
    assert shown["manifest"]["mesh"]["sha256"] == run.manifest["mesh"]["sha256"]


def test_symmetry_is_that_of_the_recorded_scans(content: PageData, conduit_run: tuple[Done, Path]) -> None:
    """S_F as plotted is one minus half the asymmetries of the front ring's four sectors, computed anew."""
    run = read_run(conduit_run[1])
    records = run.records
    rays = records["lidar"].shape[1] // 2
    angle = 2.0 * np.pi * np.arange(rays) / rays
    front = records["lidar"][:, :rays] / content.data["runs"][0]["lidar"]["reach"]
    # Sectors of 90 degrees around right, top, left, bottom; a ray on a border counts to the next one.
    sector = np.floor((angle + np.pi / 4.0) / (np.pi / 2.0) + 1e-9).astype(int) % 4
    right, top, left, bottom = (front[:, sector == k].mean(axis=1) for k in range(4))
    expected = 1.0 - 0.5 * (np.abs(right - left) + np.abs(top - bottom))
    plotted = content.array(content.data["runs"][0]["series"]["S_F"])
    np.testing.assert_allclose(plotted, expected, atol=1e-6)
    labels = next(column.labels for column in run.columns if column.name == "observation")
    shown = records["observation"][:, labels.index("s_f")]
    np.testing.assert_allclose(2.0 * plotted - 1.0, shown, atol=1e-6, err_msg="as the policy was shown it")


def test_phases_add_up(content: PageData) -> None:
    """The phases' shares sum to the whole step, and each histogram counts every control step once."""
    (shown,) = content.data["runs"]
    rows = {row["name"]: row for row in shown["phases"]["rows"]}
    phases = [row for name, row in rows.items() if name not in ("step", "recording")]
    assert sum(row["share"] for row in phases) == pytest.approx(1.0)
    for row in rows.values():
        assert sum(row["counts"]) == shown["steps"]
        assert row["p50"] <= row["p99"] <= row["max"]


def test_curvature_of_a_helix_is_the_closed_form() -> None:
    """Radius a and slope b give curvature a / (a^2 + b^2) wherever the drone came, in whatever order."""
    a, b = 2.0, 0.7
    arc = np.random.default_rng(1).permutation(np.linspace(3.0, 40.0, 600))
    phase = arc / np.hypot(a, b)
    tangents = np.stack([-a * np.sin(phase), a * np.cos(phase), np.full_like(phase, b)], axis=1) / np.hypot(
        a, b
    )
    np.testing.assert_allclose(curvature_along(arc, arc, tangents, 0.5), a / (a * a + b * b), rtol=5e-3)
    short = np.argsort(arc)[:8]  # less than a step of the axis
    found = curvature_along(arc[:3], arc[short], tangents[short], 0.5)
    np.testing.assert_allclose(found, a / (a * a + b * b), rtol=5e-2)
    assert np.isnan(curvature_along(arc[:3], arc[:1], tangents[:1], 0.5)).all()


def test_outward_is_radial_where_the_axis_is_and_zero_beyond() -> None:
    """On a straight tube outward is the unit vector from the axis; the part that was not flown has none."""
    along, around = np.meshgrid(np.linspace(0.0, 20.0, 81), np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False))
    ring = np.stack([np.zeros(along.size), np.cos(around.ravel()), np.sin(around.ravel())], axis=1)
    vertices = ring + along.ravel()[:, None] * [1.0, 0.0, 0.0]
    axis = np.linspace([5.0, 0.1, 0.0], [12.0, 0.1, 0.0], 50)
    found = outward(vertices, axis) / 127.0
    flown = (vertices[:, 0] > 4.5) & (vertices[:, 0] < 12.5)
    expected = vertices[flown] * [0.0, 1.0, 1.0] - [0.0, 0.1, 0.0]
    np.testing.assert_allclose(found[flown], expected / np.linalg.norm(expected, axis=1)[:, None], atol=0.02)
    assert not found[(vertices[:, 0] < 3.8) | (vertices[:, 0] > 13.2)].any()


def test_a_large_mesh_keeps_its_shape_with_fewer_triangles() -> None:
    """A tube of 40,000 triangles is a tube of the same radius with 4,000, to a hundredth."""
    pytest.importorskip("fast_simplification", reason="fast-simplification is not installed")
    rings, sides = 201, 100
    around = 2.0 * np.pi * np.arange(sides) / sides
    x = np.repeat(np.linspace(0.0, 30.0, rings), sides)
    vertices = np.stack([x, np.tile(np.cos(around), rings), np.tile(np.sin(around), rings)], axis=1)
    corner = np.arange((rings - 1) * sides)
    beside = corner - corner % sides + (corner + 1) % sides
    faces = np.concatenate(
        [
            np.stack([corner, beside, corner + sides], axis=1),
            np.stack([beside, beside + sides, corner + sides], axis=1),
        ]
    ).astype(np.int32)
    thin = simplify(Surface(vertices, faces), 4000)
    assert 0 < len(thin.faces) <= 4000
    middles = thin.vertices[thin.faces].mean(axis=1)
    np.testing.assert_allclose(np.linalg.norm(middles[:, 1:], axis=1), 1.0, atol=0.01)


def test_a_run_that_was_cut_short_and_lost_its_mesh_is_shown(
    conduit_run: tuple[Done, Path], tmp_path: Path
) -> None:
    """The page ends with the last whole record, says that the run was cut short and that its tube was rebuilt."""
    run = copy_run(conduit_run[1], tmp_path / "run", records=40)
    manifest = json.loads((run / MANIFEST).read_text())
    manifest["mesh"]["path"] = "/nowhere/gone.obj"
    manifest["status"] = "running"
    for name in ("outcome", "trajectory_hash", "records"):
        del manifest[name]
    (run / MANIFEST).write_text(json.dumps(manifest))
    (shown,) = read_page(report([run])).data["runs"]
    assert (shown["outcome"], shown["records"], shown["steps"]) == ("cut short", 40, 39)
    assert shown["trajectory_hash"] == read_run(run).records[-1]["chain"].tobytes().hex()
    assert "cut short" in shown["notes"][0]
    assert "rebuilt" in shown["notes"][1]


def test_a_long_run_stays_under_ten_megabytes(conduit_run: tuple[Done, Path], tmp_path: Path) -> None:
    """10,000 steps whose numbers no compression makes smaller give a page under 10 MB, with every step in it."""
    run = copy_run(conduit_run[1], tmp_path / "run")
    log = (run / LOG).read_bytes()
    records = np.frombuffer(
        bytearray(log * (1 + 10_001 // len(read_run(run).records))), read_run(run).records.dtype
    )[:10_001]
    random = np.random.default_rng(0)
    for name in records.dtype.names or ():
        field = records[name]
        if field.dtype.kind == "f":
            field *= random.uniform(0.99, 1.0, field.shape)
    records["step"] = np.arange(len(records))
    records["sim_time"] = 0.1 * np.arange(len(records))
    (run / LOG).write_bytes(records.tobytes())
    path = report([run])
    assert path.stat().st_size < 10 * MEGABYTE
    assert read_page(path).data["runs"][0]["stride"] == 1


def test_of_very_many_records_some_are_kept_and_the_last_always() -> None:
    """Every third record, then the last, in order and none twice."""
    assert Kept.of(8, 3).index.tolist() == [0, 3, 6, 7]
    assert Kept.of(7, 3).index.tolist() == [0, 3, 6]
    assert Kept.of(1, 3).index.tolist() == [0]


def test_runs_in_the_same_tube_share_it(conduit_run: tuple[Done, Path], tmp_path: Path) -> None:
    """Two runs through one mesh have one tube in the page; both keep their names."""
    other = copy_run(conduit_run[1], tmp_path / "other", records=20)
    data = read_page(report([conduit_run[1], other], tmp_path / "both.html")).data
    assert [run["tube"] for run in data["runs"]] == [0, 0]
    assert [run["name"] for run in data["runs"]] == [conduit_run[1].name, "other"]
    assert len(data["tubes"]) == 1


def test_an_evaluation_has_its_table_and_its_failures(tmp_path: Path) -> None:
    """results.json alone, or its folder, gives a page with the rows and what failed, with the command of each."""
    (tmp_path / "results.json").write_text(json.dumps(evaluation_results()))
    for source in (tmp_path, tmp_path / "results.json"):
        data = read_page(report([source])).data
        (evaluation,) = data["evaluations"]
        assert [row["success"] for row in evaluation["rows"]] == [0.5]
        assert [(f["seed"], f["launch"], f["run"]) for f in evaluation["failures"]] == [
            (7, "cosim launch --tube level=2,seed=7", None)
        ]


def test_text_of_the_data_is_never_markup(tmp_path: Path) -> None:
    """A name that looks like the end of a script stays a name."""
    results = evaluation_results()
    results["rows"][0]["policy"] = name = "</script><img src=x>"
    (tmp_path / "results.json").write_text(json.dumps(results))
    page = report([tmp_path])
    assert name not in page.read_text()
    assert read_page(page).data["evaluations"][0]["rows"][0]["policy"] == name


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (lambda folder: None, "expected the manifest of a run"),
        (lambda folder: (folder / "results.json").write_text("[1"), "expected JSON"),
        (lambda folder: (folder / "results.json").write_text('{"rows": []}'), "expected rows and episodes"),
        (
            lambda folder: (folder / "results.json").write_text('{"rows": [], "trained_under": {}}'),
            "found those of `cosim ablate`",
        ),
        (
            lambda folder: (folder / "results.json").write_text(json.dumps(evaluation_results(flown=[{}]))),
            "results of another version",
        ),
    ],
)
def test_what_is_no_run_is_refused(make: Any, complaint: str, tmp_path: Path) -> None:
    """A folder with neither run nor results, and results of another kind: exit status 2 and what was expected."""
    make(tmp_path)
    done = run_here("report", str(tmp_path))
    assert done.status == 2
    assert complaint in done.stderr
    assert not (tmp_path / PAGE).exists()


def test_a_run_without_a_record_is_refused(conduit_run: tuple[Done, Path], tmp_path: Path) -> None:
    """A log that ends before its first record has nothing to show."""
    run = copy_run(conduit_run[1], tmp_path / "run", records=0)
    done = run_here("report", str(run))
    assert (done.status, "no whole record" in done.stderr) == (2, True)


def test_the_page_never_replaces_the_data(conduit_run: tuple[Done, Path], tmp_path: Path) -> None:
    """--out with the name of a log, a manifest or results is refused; a folder that is not there is named."""
    run = copy_run(conduit_run[1], tmp_path / "run")
    before = (run / LOG).read_bytes()
    for name in (LOG, MANIFEST, "results.json"):
        assert run_here("report", str(run), "--out", str(run / name)).status == 2
    assert (run / LOG).read_bytes() == before
    done = run_here("report", str(run), "--out", str(tmp_path / "none" / "page.html"))
    assert done.status == 2
    assert f"expected a folder {tmp_path / 'none'} to write it to, found none" in done.stderr
    with pytest.raises(OutputError, match="cannot be written: No such file or directory"):
        report([run], tmp_path / "none" / "page.html")
