"""The page of `cosim report` in a real browser: headless Chromium, from disk."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flights import Done
from pages import PATIENCE, Browser, copy_run, evaluation_results, missing_browser, open_browser

from cosim.recording import LOG, MANIFEST
from cosim.report import report
from cosim.runs import Run, read_run

pytestmark = pytest.mark.skipif(bool(missing_browser()), reason=missing_browser())

SHIFT = 0.125
"""How far the second run of an overlay flew beside the first (m)."""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """One browser for all pages."""
    pytest.importorskip("selenium", reason="selenium is not installed: pip install selenium")
    with open_browser(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


@pytest.fixture(scope="module")
def run(conduit_run: tuple[Done, Path]) -> Run:
    """The flight through the conduit."""
    return read_run(conduit_run[1])


@pytest.fixture(scope="module")
def page(run: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its page."""
    return report([run.folder], tmp_path_factory.mktemp("page") / "page.html")


@pytest.fixture
def opened(browser: Browser, page: Path) -> Browser:
    """The browser with the page of one run."""
    browser.open(page)
    return browser


@pytest.fixture
def drawn(browser: Browser, page: Path) -> Browser:
    """The browser with the page of one run, in whatever state others left it."""
    if browser.driver.current_url != page.resolve().as_uri():
        browser.open(page)
    return browser


def places(browser: Browser) -> np.ndarray[Any, Any]:
    """Where the drones stand in the view, (R, 3) in metres."""
    return np.array(browser.run("return report.state().positions"))


def assert_at(run: Run, record: int, place: np.ndarray[Any, Any]) -> None:
    """The drone stands where the record says, to the page's single precision."""
    np.testing.assert_allclose(place, run.records["position"][record], atol=1e-5)


def test_it_opens_from_disk_and_asks_for_nothing(opened: Browser, page: Path) -> None:
    """No error and no warning on the console, and the page itself is the only thing that is loaded."""
    assert opened.complaints() == []
    assert opened.requests() == [page.resolve().as_uri()]
    assert opened.run("return document.body.innerText.includes('Success')")


def test_the_slider_moves_the_drone(opened: Browser, run: Run) -> None:
    """Keys on the slider go step by step, and wherever it is put the drone stands where it was recorded."""
    from selenium.webdriver.common.keys import Keys

    slider = opened.driver.find_element("id", "slider")
    assert int(slider.get_attribute("max")) == len(run.records) - 1
    slider.send_keys(Keys.ARROW_RIGHT, Keys.ARROW_RIGHT, Keys.ARROW_RIGHT)
    assert opened.run("return report.state().record") == 3
    assert_at(run, 3, places(opened)[0])
    for record in (len(run.records) - 1, 200, 0):
        opened.run(
            f"const s = document.getElementById('slider'); s.value = {record}; s.dispatchEvent(new Event('input'))"
        )
        assert_at(run, record, places(opened)[0])


def test_play_and_step(opened: Browser, run: Run) -> None:
    """Space plays and pauses, which rests on a recorded step; the buttons go one step back and forth."""
    from selenium.webdriver.common.keys import Keys

    body = opened.driver.find_element("tag name", "body")
    body.send_keys(Keys.SPACE)
    deadline = time.monotonic() + PATIENCE
    while opened.run("return report.state().record") < 5:
        assert time.monotonic() < deadline
    assert opened.run("return report.state().playing")
    # Not by the driver, which waits for seconds where frames come slowly.
    opened.run("document.body.dispatchEvent(new KeyboardEvent('keydown', { key: ' ', bubbles: true }))")
    assert not opened.run("return report.state().playing")
    record = opened.run("return report.state().record")
    assert_at(run, record, places(opened)[0])
    opened.driver.find_element("id", "forward").click()
    opened.driver.find_element("id", "forward").click()
    opened.driver.find_element("id", "back").click()
    assert opened.run("return report.state().record") == record + 1
    assert_at(run, record + 1, places(opened)[0])


def test_something_is_drawn(opened: Browser) -> None:
    """Tube, path and drone colour a good part of the view, whose background is transparent; without a tube, less."""
    count = """
        const { view } = report, gl = view.renderer.getContext();
        const drawn = () => {
            view.renderer.render(view.scene, view.camera);
            const pixels = new Uint8Array(4 * gl.drawingBufferWidth * gl.drawingBufferHeight);
            gl.readPixels(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
            return pixels.filter((value, i) => i % 4 === 3 && value > 0).length / (pixels.length / 4);
        };
        const shares = [];
        for (const tube of ['glass', 'cut', 'whole', 'off']) { view.setTube(tube); shares.push(drawn()); }
        return shares;
    """
    glass, cut, whole, off = opened.run(count)
    assert min(glass, cut, whole) > 0.05
    assert 0.0 < off < 0.5 * glass


def test_the_camera_follows_the_drone_and_looks_out_of_it(opened: Browser, run: Run) -> None:
    """Following, it keeps its distance and looks at the drone; on board, it stands in the drone's place."""
    distance = (
        "const { view } = report; const d = view.runs[0].drone.position;"
        "return [view.camera.position.distanceTo(d), view.controls.target.distanceTo(d)]"
    )
    opened.run("report.view.setCamera('follow'); report.player.seekRecord(10)")
    before, _ = opened.run(distance)
    opened.run("report.player.seekRecord(250)")
    after, off_target = opened.run(distance)
    assert after == pytest.approx(before, rel=1e-3)
    assert off_target == pytest.approx(0.0, abs=1e-6)
    opened.run("report.view.setCamera('aboard')")
    assert_at(run, 250, np.array(opened.run("return report.view.camera.position.toArray()")))


def test_the_view_does_not_hold_a_reader_who_scrolls_by(drawn: Browser) -> None:
    """The wheel is the page's until the view is clicked and again once the mouse is gone; a finger scrolls too."""
    taken = (
        "report.view.setCamera('overview');"
        "const canvas = document.getElementById('canvas');"
        "const send = (kind) => canvas.dispatchEvent("
        "  new PointerEvent(kind, { pointerId: 1, pointerType: 'mouse', isPrimary: true, bubbles: true }));"
        "const wheel = () => !canvas.dispatchEvent(new WheelEvent('wheel', { deltaY: 100, cancelable: true }));"
        "canvas.setPointerCapture = canvas.releasePointerCapture = () => {};"
        "const found = [wheel()];"
        "send('pointerdown'); send('pointerup'); found.push(wheel());"
        "send('pointerleave'); found.push(wheel());"
        "return [found, getComputedStyle(canvas).touchAction]"
    )
    assert drawn.run(taken) == [[False, True, False], "pan-y"]


def test_scans_end_on_the_wall(opened: Browser, run: Run) -> None:
    """The ends of the drawn LiDAR rays are as far from the axis as the tube is wide, give or take its fittings."""
    opened.run("report.player.seekRecord(30)")
    ends = np.array(
        opened.run("return Array.from(report.view.senses.hits.geometry.attributes.position.array)")
    ).reshape(-1, 3)
    record = run.records[30]
    away = ends - record["axis_position"]
    away -= np.outer(away @ record["tangent"], record["tangent"])
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), record["radius"], rtol=0.15)


def test_every_chart_has_its_curves_and_the_cursor_goes_along(opened: Browser, run: Run) -> None:
    """Ten charts with at least one curve or band each; the cursor moves with the slider, a click moves the slider.

    The mouse alone reads the curves off where it is, and leaves the replay where that was.
    """
    charts = opened.run(
        "return [...document.querySelectorAll('.chart')].map((chart) => [chart.id,"
        "[...chart.querySelectorAll('path.curve')].filter((path) => path.getAttribute('d').length > 50).length"
        "+ chart.querySelectorAll('rect.regime').length])"
    )
    assert len(charts) == 10
    assert all(count > 0 for _, count in charts), charts
    at = "return +document.querySelector('#chart-clearance .cursor line').getAttribute('x1')"
    first = opened.run(at)
    opened.run("report.player.seekRecord(200)")
    assert opened.run(at) > first + 50
    chart = opened.driver.find_element("css selector", "#chart-speed svg")
    chart.click()  # in its middle
    middle = opened.run("return report.state().record / report.runs[0].count")
    assert middle == pytest.approx(0.5, abs=0.08)
    hovered = opened.run(
        "const chart = report.plots.charts[0], run = report.runs[0], box = chart.svg.getBoundingClientRect();"
        "const at = (x) => chart.svg.dispatchEvent("
        "  new PointerEvent('pointermove', { clientX: box.left + x, pointerType: 'mouse' }));"
        "at(chart.toX(run.series.time[77]));"
        "const read = [chart.values[0].value.textContent, chart.place.textContent, report.state().record];"
        "chart.svg.dispatchEvent(new PointerEvent('pointerleave'));"
        "return [...read, chart.place.textContent]"
    )
    clearance = run.records["clearance"][77]
    assert hovered == [f"{clearance:.3f}", "7.7 s", round(middle * len(run.records)), ""]


def test_strips_show_what_was_recorded_however_many_records_a_pixel_has(drawn: Browser) -> None:
    """One bad record among thousands colours its own pixel and no more; one lost sight leaves a gap as wide."""
    found = drawn.run(
        "const count = 20000, chart = report.plots.charts.find((one) => one.definition.strip);"
        "const run = report.runs[0], old = { ...run.series }, counted = run.count;"
        "run.count = count;"
        "run.series.time = Float32Array.from({ length: count }, (_, i) => 0.1 * i);"
        "for (const name of ['regime', 'target_visible', 'memory_available', 'contact'])"
        "  run.series[name] = new Uint8Array(count).fill(name === 'contact' ? 0 : 1);"
        "run.series.regime[1005] = 2; run.series.target_visible[15000] = 0;"
        "chart.draw();"
        "const widths = (kind) => [...chart.svg.querySelectorAll(kind)].map((band) => +band.getAttribute('width'));"
        "const found = [widths('.regime.v2'), widths('.target_visible')];"
        "run.count = counted; Object.assign(run.series, old); chart.draw();"
        "return found"
    )
    (memory,), seen = found
    assert memory < 3.0
    assert len(seen) == 2


def test_the_headline_is_what_the_flight_reported(
    drawn: Browser, conduit_run: tuple[Done, Path], run: Run
) -> None:
    """Figures at the top are those of `cosim launch --json`, rounded; the smallest gap leads to its own record."""
    told = conduit_run[0].report
    figures = dict(
        drawn.run(
            "return [...document.querySelectorAll('.figures > div')]"
            ".map((one) => [...one.children].map((e) => e.innerText))"
        )
    )
    assert figures == {
        "progress": f"{100 * told['progress']:.1f} %",
        "quality Q": f"{told['quality']:.3f}",
        "smallest gap": f"{told['min_clearance_m']:.3f} m",
        "steps with contact": str(told["contacts"]),
        "loop": f"{round(told['steps_per_second']):,} /s",
        "seed": str(run.manifest["options"]["seed"]),
    }
    drawn.driver.find_element("css selector", ".figures button").click()
    assert drawn.run("return report.state().record") == int(run.records["clearance"].argmin())


def test_what_is_sensed_is_drawn_without_the_view(drawn: Browser, run: Run) -> None:
    """The section seen from behind has the scan's corners at the recorded distances, and the decision of the step."""
    drawn.run("report.player.seekRecord(30)")
    scale = drawn.run("return report.dial.scale")
    ring = drawn.run("return report.dial.marks.front.getAttribute('d')")
    corners = np.array([[float(x) for x in pair.split()] for pair in ring.strip("MZ").split("L")])
    rays = len(corners)
    np.testing.assert_allclose(
        np.linalg.norm(corners, axis=1) / scale, run.records["lidar"][30][:rays], atol=0.01
    )
    right, above = corners[0], corners[rays // 4]
    assert right[0] > 0.0 > above[1]
    assert drawn.run("return report.dial.marks.decided.getAttribute('visibility')") == "visible"


def test_curves_are_drawn_by_arc_length_and_over_a_span_too(opened: Browser) -> None:
    """Both change what the charts show; the arc length's axis ends with metres."""
    shape = "return document.querySelector('#chart-clearance path.curve').getAttribute('d')"
    by_time = opened.run(shape)
    opened.driver.find_element("css selector", "#abscissa button[value=arc_length]").click()
    by_arc = opened.run(shape)
    assert by_arc != by_time
    assert opened.run(
        "return [...document.querySelectorAll('#chart-clearance .tick.x')].pop().textContent"
    ).endswith("m")
    opened.run("report.plots.span = 5; report.player.seekRecord(200)")
    assert opened.run(shape) not in (by_time, by_arc)
    assert opened.complaints() == []


@pytest.fixture(scope="module")
def overlay(run: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page of the run, and of one that flew beside it and collided; the one failure of an evaluation."""
    folder = tmp_path_factory.mktemp("overlay")
    beside = copy_run(run.folder, folder / "beside", records=60)
    records = np.frombuffer(
        bytearray((beside / LOG).read_bytes())[: 60 * run.records.itemsize], run.records.dtype
    )
    records["position"] += [0.0, 0.0, SHIFT]
    records["outcome"][-1] = 3
    (beside / LOG).write_bytes(records.tobytes())
    manifest = json.loads((beside / MANIFEST).read_text())
    manifest["tube"] = {"level": 2, "seed": 7}
    manifest["policy"]["name"] = "lidar-rule"
    (beside / MANIFEST).write_text(json.dumps(manifest))
    results = evaluation_results()
    results["flown"][1]["steps"] = 59
    (folder / "results.json").write_text(json.dumps(results))
    return report([folder / "results.json", run.folder, beside], folder / "page.html")


def test_several_runs_are_overlaid(browser: Browser, overlay: Path, run: Run) -> None:
    """Both drones stand where they were at the same time, both have a curve, and a tick hides one of them."""
    browser.open(overlay)
    browser.run("report.player.seekRecord(40)")
    first, second = places(browser)
    assert_at(run, 40, first)
    np.testing.assert_allclose(second - first, [0.0, 0.0, SHIFT], atol=1e-5)
    curves = "return document.querySelectorAll('#chart-curvature path.curve').length"
    assert browser.run(curves) == 2
    browser.driver.find_elements("css selector", "#runs input")[1].click()
    assert browser.run(curves) == 1
    assert browser.run("return report.view.runs.map((view) => view.group.visible)") == [True, False]
    assert browser.complaints() == []


def test_a_failure_is_linked_to_its_replay(browser: Browser, overlay: Path, run: Run) -> None:
    """The failure's row has the command that flies it again, and a link that goes to the end of its run."""
    browser.open(overlay)
    row = browser.driver.find_element("css selector", "#evaluations table:last-of-type a").find_element(
        "xpath", "ancestor::tr"
    )
    assert "cosim launch --tube level=2,seed=7" in row.text
    row.find_element("tag name", "a").click()
    state = browser.run("return report.state()")
    assert (state["focus"], state["record"]) == (1, 59)
    np.testing.assert_allclose(
        state["positions"][1], run.records["position"][59] + [0.0, 0.0, SHIFT], atol=1e-5
    )


def test_a_flight_that_met_a_wall_opens_at_that_moment(browser: Browser, run: Run, tmp_path: Path) -> None:
    """The page rests on the record of the first contact, with the place marked in view and what was seen before."""
    crashed = copy_run(run.folder, tmp_path / "run", records=60)
    records = np.frombuffer(
        bytearray((crashed / LOG).read_bytes())[: 60 * run.records.itemsize], run.records.dtype
    )
    records["outcome"][-1], records["contact"][53:] = 3, True
    (crashed / LOG).write_bytes(records.tobytes())
    browser.open(report([crashed]))
    assert browser.run("return report.state().record") == 53
    assert_at(run, 53, places(browser)[0])
    mark = browser.run("return report.view.endings[0].spot.position.toArray()")
    gap = np.linalg.norm(np.array(mark) - run.records["position"][53])
    assert gap == pytest.approx(run.records["clearance"][53], rel=0.02)
    pin = browser.run(
        "const pin = document.querySelector('.pin').getBoundingClientRect();"
        "const view = document.getElementById('view').getBoundingClientRect();"
        "return pin.left > view.left && pin.right < view.right && pin.top > view.top && pin.bottom < view.bottom"
    )
    assert pin
    assert "It touched the wall in step 53" in browser.run(
        "return document.getElementById('ending').innerText"
    )
    browser.driver.find_elements("css selector", "#ending button")[1].click()
    assert browser.run("return report.state().record") == 52
    assert browser.complaints() == []


@pytest.mark.parametrize("which", ["page", "overlay"])
def test_it_fits_a_phone(browser: Browser, which: str, request: pytest.FixtureRequest) -> None:
    """In a window of 390 pixels nothing is wider than the window, and slider and play can be reached."""
    browser.open(request.getfixturevalue(which), width=390, height=844)
    assert browser.run("return document.documentElement.scrollWidth") == 390
    for name in ("slider", "play"):
        box = browser.run(f"return document.getElementById('{name}').getBoundingClientRect().toJSON()")
        assert box["left"] >= 0
        assert box["right"] <= 390
        assert box["width"] >= 34


def test_the_whole_tube_is_seen_in_a_window_of_any_shape(drawn: Browser) -> None:
    """However the window is turned, the overview holds every corner of the tube, which it fills."""
    farthest = (
        "await new Promise((done) => setTimeout(done, 200));"
        "const { camera } = report.view, tube = report.data.tubes[0].vertices;"
        "const place = new camera.position.constructor(); let far = 0;"
        "camera.updateMatrixWorld();"
        "for (let i = 0; i < tube.length; i += 3) {"
        "  place.fromArray(tube, i).project(camera);"
        "  far = Math.max(far, Math.abs(place.x), Math.abs(place.y)); }"
        "return far"
    )
    drawn.run("report.view.setCamera('overview')")
    for width, height in ((390, 844), (844, 390), (1000, 600)):
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        drawn.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        assert 0.6 < drawn.run(farthest) < 1.0


def test_dark_mode_changes_page_and_view(browser: Browser, page: Path) -> None:
    """Dark ground and light text where the system is dark, in the 3-D view as well; also while it is open."""
    colours = (
        "await new Promise(requestAnimationFrame); await new Promise(requestAnimationFrame);"
        "const brightness = (text) => text.match(/[\\d.]+/g).slice(0, 3).reduce((a, b) => a + +b, 0) / 3;"
        "const style = getComputedStyle(document.documentElement), ink = report.view.tubes[0].uniforms.ink.value;"
        "return [brightness(style.backgroundColor), brightness(style.color), ink.r + ink.g + ink.b]"
    )
    browser.open(page)
    ground, text, ink = browser.run(colours)
    assert ground > 200 > 100 > text
    scheme = [{"name": "prefers-color-scheme", "value": "dark"}]
    browser.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": scheme})
    dark_ground, dark_text, dark_ink = browser.run(colours)
    assert dark_ground < 60 < 200 < dark_text
    assert dark_ink > ink
    browser.open(page, dark=True)
    assert browser.run(colours) == [dark_ground, dark_text, dark_ink]


def test_a_run_of_one_record_is_shown(browser: Browser, run: Run, tmp_path: Path) -> None:
    """A flight that was cut short before its first step still has a page, without an error."""
    short = copy_run(run.folder, tmp_path / "run", records=1)
    browser.open(report([short]))
    assert browser.complaints() == []
    assert_at(run, 0, places(browser)[0])
    assert "Cut short" in browser.run("return document.getElementById('headline').innerText")


def test_it_does_without_webgl(browser: Browser, page: Path, tmp_path: Path) -> None:
    """Where the browser has no WebGL the page says so and shows the flight from the side; all else works as ever."""
    blind = tmp_path / "blind.html"
    blind.write_text(
        page.read_text().replace(
            '<script type="module">',
            '<script type="module">HTMLCanvasElement.prototype.getContext = () => null;',
            1,
        )
    )
    browser.open(blind)
    assert "no WebGL" in browser.run("return document.getElementById('no-view').textContent")
    before = browser.run("return +document.querySelector('.plan circle').getAttribute('cx')")
    browser.run("report.player.seekRecord(100)")
    assert browser.run("return document.querySelectorAll('path.curve').length") > 10
    assert abs(browser.run("return +document.querySelector('.plan circle').getAttribute('cx')") - before) > 50
    assert browser.complaints() == []
