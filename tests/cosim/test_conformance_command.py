"""The command `cosim conformance`: exit statuses, options, and what is left of it after Ctrl-C."""

from __future__ import annotations

import json
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path
from xml.etree import ElementTree

import pytest
from flights import DEADLINE, ROOT, command, environment, run_cosim, run_here

BROKEN = shlex.join([sys.executable, str(ROOT / "tests" / "protocol" / "broken_server.py")])
TOY = shlex.join(["env", f"PYTHONPATH={ROOT}", sys.executable, "-m", "protocol.conformance.toy_server"])


def test_a_sound_server_gives_status_0_and_a_report(tmp_path: Path) -> None:
    """One line a rule with its section; the JUnit file is there."""
    junit = tmp_path / "conformance.xml"
    done = run_cosim(
        *("conformance", "--server", TOY, "--transport", "file"),
        *("--rule", "header-size", "--rule", "gusts", "--junit", str(junit)),
        cwd=tmp_path,
    )
    assert (done.status, done.stderr) == (0, "")
    assert "  passed   §3       header-size: " in done.stdout
    assert "  skipped  annex A  gusts: " in done.stdout
    assert re.fullmatch(
        r"of the rules that were run \(2 of \d+\): 1 passed, 1 skipped", done.stdout.splitlines()[-1]
    )
    assert [case.get("name") for case in ElementTree.parse(junit).iter("testcase")] == [
        "header-size",
        "gusts",
    ]


def test_a_broken_server_gives_status_1_and_names_the_rule(tmp_path: Path) -> None:
    """JSON alone on stdout; the rule that failed says what was expected and found."""
    done = run_cosim(
        "conformance", "--server", f"{BROKEN} header-size", "--rule", "header-size", "--json", cwd=tmp_path
    )
    assert done.status == 1
    assert len(done.stdout.splitlines()) == 1
    (rule,) = done.report["rules"]
    assert (done.report["conforms"], rule["name"], rule["outcome"]) == (False, "header-size", "failed")
    assert "expected 3648, found 8192" in rule["details"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((), "--server COMMAND"),
        (("--server", "a", "--agent", "b"), "--server COMMAND"),
        (("--server", "no-such-program"), "'no-such-program' on PATH"),
        (("--server", "./no-such-program"), f"no such file: './no-such-program' in {Path.cwd()}"),
        (("--server", __file__), "not executable"),
        (("--server", ""), "an empty string"),
        (("--server", "true", "--level", "core,speed"), "speed"),
        (("--server", "true", "--rule", "no-such-rule"), "no-such-rule"),
        (("--server", "true", "--rule", "gusts", "--level", "lanes"), "no rule"),
        (("--server", "true", "--junit", "/no/such/folder/x.xml"), "/no/such/folder"),
        (("--agent", "true", "--rule", "gusts"), "gusts"),
        (("--server", "true", "--timeout", "nan"), "finite"),
        (("--list", "--rule", "no-such-rule"), "no-such-rule"),
    ],
)
def test_what_cannot_be_meant_is_bad_usage(arguments: tuple[str, ...], said: str) -> None:
    """Status 2 and a sentence, before anything is started."""
    done = run_here("conformance", *arguments)
    assert done.status == 2
    assert said in done.stderr


def test_the_list_names_every_rule_of_both_sides() -> None:
    """A line a rule with side, level and section; nothing is started."""
    done = run_here("conformance", "--list")
    assert done.status == 0
    lines = done.stdout.splitlines()
    assert {line.split()[0] for line in lines} == {"server", "agent"}
    assert any(line.startswith("server  core          3  header-size: ") for line in lines)
    assert run_here("conformance", "--list", "--server", "x", "--level", "lanes").stdout.count("\n") < len(
        lines
    )


def test_the_list_is_had_as_json_and_by_name() -> None:
    """A rule of one side is no error of the other."""
    done = run_here("conformance", "--list", "--json", "--rule", "gusts")
    assert done.status == 0
    (rule,) = json.loads(done.stdout)["rules"]
    assert (rule["side"], rule["name"], rule["section"]) == ("server", "gusts", "A")


def test_ctrl_c_leaves_nothing(tmp_path: Path) -> None:
    """No segment, no scratch folder, no process, and the status of an interrupt."""
    process = subprocess.Popen(
        command("conformance", "--server", TOY),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        cwd=tmp_path,
        env={**environment(), "TMPDIR": str(tmp_path)},
    )
    try:
        patience = time.monotonic() + DEADLINE
        while not (served := _served(process.pid)):
            assert time.monotonic() < patience
            time.sleep(0.002)
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=DEADLINE)
    finally:
        process.kill()
    assert process.returncode == 130
    assert _served(process.pid) == []
    assert list(tmp_path.iterdir()) == []
    assert not any(name in path.read_bytes() for name in served for path in _command_lines())


def _served(pid: int) -> list[bytes]:
    """Names of the sessions that a kit has open."""
    return [path.stem.encode() for path in Path("/dev/shm").glob(f"conformance-{pid}-*.cmd")]


def _command_lines() -> list[Path]:
    return [path for path in Path("/proc").glob("[0-9]*/cmdline") if path.exists()]
