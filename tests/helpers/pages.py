"""Pages of `cosim report`, read as a browser reads them and driven in a real one."""

from __future__ import annotations

import base64
import json
import re
import shutil
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.recording import LOG, MANIFEST

FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-dev-shm-usage",
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
)  # fmt: skip
"""No display, no GPU, and nothing that Chromium asks the network for by itself."""

PATIENCE = 60.0
"""Seconds after which a page that does not answer is given up."""


@dataclass(frozen=True)
class PageData:
    """The data that stands in a page."""

    data: dict[str, Any]
    block: bytes

    def array(self, number: int) -> NDArray[Any]:
        """The array of this number."""
        entry = self.data["arrays"][number]
        count = int(np.prod(entry["shape"]))
        return np.frombuffer(self.block, f"<{entry['type']}", count, entry["at"]).reshape(entry["shape"])


def read_page(path: Path) -> PageData:
    """The data of a page, without running it."""
    text = path.read_text()

    def script(name: str) -> str:
        found = re.search(rf'<script type="[a-z/]+" id="{name}">(.*?)</script>', text, re.DOTALL)
        assert found is not None, name
        return found[1]

    return PageData(json.loads(script("data")), zlib.decompress(base64.b64decode(script("arrays"))))


def copy_run(run: Path, folder: Path, records: int | None = None) -> Path:
    """A copy of a run's manifest and log, of its first records alone where that is asked for."""
    folder.mkdir()
    shutil.copy(run / MANIFEST, folder)
    size = json.loads((run / MANIFEST).read_text())["record_bytes"]
    log = (run / LOG).read_bytes()
    (folder / LOG).write_bytes(log if records is None else log[: records * size + size // 2])
    return folder


def evaluation_results(**changed: Any) -> dict[str, Any]:
    """Results of an evaluation of one pilot and two episodes."""
    row = {
        "policy": "lidar-rule", "level": 2, "episodes": 2, "success": 0.5, "exit": 0.0, "collision": 0.5,
        "timeout": 0.0, "quality": 0.9, "mean_steps": 60.0, "length_ratio": 1.1, "success_ci95": [0.09, 0.91],
        "sees": "LiDAR",
    }  # fmt: skip
    episode = {
        "policy": "lidar-rule", "level": 2, "seed": 7, "steps": 30, "progress": 0.3, "min_clearance_m": 0.01,
        "conditions": {}, "launch": "cosim launch --tube level=2,seed=7", "launch_repeats": True,
    }  # fmt: skip
    return {
        "episodes": 2, "seed": 0, "engine": "bullet", "settings": [], "hard": False, "left_out": {}, "paper": [],
        "rows": [row], "flown": [episode | {"outcome": "success"}, episode | {"outcome": "collision"}],
    } | changed  # fmt: skip


def missing_browser() -> str:
    """What keeps a page from being opened here; empty where nothing does."""
    for program in ("chromium", "chromedriver"):
        if shutil.which(program) is None:
            return f"{program} is not installed: apt-get install chromium chromium-driver"
    return ""


class Browser:
    """A headless Chromium with pages from disk."""

    def __init__(self, driver: Any) -> None:
        self.driver = driver

    def open(self, page: Path, *, width: int = 1000, height: int = 600, dark: bool = False) -> None:
        """Open a page in a window of this size and wait until it is drawn."""
        self.driver.execute_cdp_cmd(
            "Emulation.setDeviceMetricsOverride",
            {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 500},
        )
        scheme = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": scheme})
        self.driver.get_log("browser")
        self.driver.get_log("performance")
        self.driver.get(page.resolve().as_uri())
        self.run("const report = await cosimReport; await new Promise(requestAnimationFrame)")

    def run(self, script: str) -> Any:
        """What an asynchronous piece of script returns, which may use `report`, the handle of the page."""
        answer = self.driver.execute_async_script(
            "const done = arguments[0];"
            "(async () => {"
            + ("" if "const report" in script else "const report = await cosimReport;")
            + script
            + "})()"
            ".then((value) => done([value ?? null, null]), (error) => done([null, String(error?.stack ?? error)]))"
        )
        assert answer[1] is None, answer[1]
        return answer[0]

    def complaints(self) -> list[str]:
        """Errors and warnings on the console since the page was opened, but of drawing without a GPU."""
        entries = self.driver.get_log("browser")
        return [
            entry["message"] for entry in entries if "GPU stall due to ReadPixels" not in entry["message"]
        ]

    def requests(self) -> list[str]:
        """Addresses that the page asked for since it was opened."""
        events = [json.loads(entry["message"])["message"] for entry in self.driver.get_log("performance")]
        return [e["params"]["request"]["url"] for e in events if e["method"] == "Network.requestWillBeSent"]


@contextmanager
def open_browser(profile: Path) -> Iterator[Browser]:
    """A fresh headless Chromium whose profile is in an empty folder; needs selenium and `missing_browser() == ""`."""
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = str(shutil.which("chromium"))
    for flag in (*FLAGS, f"--user-data-dir={profile}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    service = webdriver.ChromeService(str(shutil.which("chromedriver")))
    driver = webdriver.Chrome(options=options, service=service)
    try:
        driver.set_page_load_timeout(PATIENCE)
        driver.set_script_timeout(PATIENCE)
        yield Browser(driver)
    finally:
        driver.quit()
