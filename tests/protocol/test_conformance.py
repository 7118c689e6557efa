"""The kit on sound servers, on programs that are none, and its reports."""

from __future__ import annotations

import importlib
import json
import os
import pkgutil
import re
import shlex
import sys
import tempfile
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest
from kit import transported_rules

from protocol import conformance
from protocol.conformance.report import json_report, junit_report, text_report
from protocol.conformance.rule import AGENT_RULES, SERVER_RULES, Level, Outcome, Result, Rule, Skip
from protocol.conformance.run import conforms, run_rule, run_suite, select
from protocol.states import TRANSITIONS, Event, State

HERE = Path(__file__).parent
ROOT = HERE.parent.parent
PYTHON = shlex.join(["env", f"PYTHONPATH={ROOT}", "OPENBLAS_NUM_THREADS=1", sys.executable])
TOY = f"{PYTHON} -m protocol.conformance.toy_server"

NO_WALLS = {
    *("contact-wall", "contact-hollow", "tube-scale", "tube-axes", "tube-left"),
    *("tube-of-each-lane", "refusal-plant"),
}
"""Rules that need a plant with walls."""


def run_all(rules: Iterable[Rule], command: str, transport: str) -> list[Result]:
    """Run rules two at a time."""
    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(lambda rule: run_rule(rule, command, transport, 30.0), rules))


def ended(results: Iterable[Result], outcome: Outcome) -> dict[str, str]:
    """Rules that ended so, and what was said."""
    return {result.rule.name: result.details for result in results if result.outcome is outcome}


@pytest.mark.parametrize("level", [Level.CORE, Level.ROBUSTNESS, Level.LANES])
def test_the_toy_server_keeps_every_rule(level: Level) -> None:
    """The least of servers conforms; what it cannot do it says, and that alone is skipped."""
    results = run_all(select("server", [level]), TOY, "shm")
    assert ended(results, Outcome.FAILED) == {}
    assert set(ended(results, Outcome.SKIPPED)) <= NO_WALLS | {"gusts"}


def test_the_toy_server_keeps_the_rules_of_speed() -> None:
    """One after the other: a measurement has the machine for itself."""
    assert ended(run_suite(select("server", [Level.PERFORMANCE]), TOY, timeout=30.0), Outcome.FAILED) == {}


def test_the_toy_server_keeps_the_rules_over_files() -> None:
    """Every rule that the transport could touch holds over ordinary mapped files too."""
    assert ended(run_all(transported_rules(), TOY, "file"), Outcome.FAILED) == {}


def test_a_server_with_walls_and_gusts_keeps_what_the_toy_cannot_show() -> None:
    """The engine of this package's physics process passes the rules that are skipped on the toy."""
    rules = select("server", names=sorted(NO_WALLS | {"gusts"}))
    results = run_all(rules, f"{PYTHON} -m physics_server", "shm")
    assert [result.outcome for result in results] == [Outcome.PASSED] * len(rules), ended(
        results, Outcome.FAILED
    )


def test_the_rules_for_servers_take_every_transition_of_the_table() -> None:
    """No state and no event that a server takes part in is left out."""
    covered = {move for rule in SERVER_RULES.values() for move in rule.covers}
    table = {(state, event) for state, moves in TRANSITIONS.items() for event in moves}
    assert table - covered == {(State.ABSENT, Event.OFFER)}  # which the agent takes alone
    assert covered <= table


def test_every_module_of_rules_is_run() -> None:
    """A module that registers rules cannot be forgotten."""
    known = set(SERVER_RULES) | set(AGENT_RULES)
    for module in pkgutil.iter_modules(conformance.__path__):
        importlib.import_module(f"{conformance.__name__}.{module.name}")
    assert set(SERVER_RULES) | set(AGENT_RULES) == known


@pytest.mark.parametrize("side", ["server", "agent"])
def test_every_rule_names_a_section_of_the_specification(side: str) -> None:
    """The sections are headings of the specification, and every title is one short line."""
    text = (ROOT / "protocol" / "README.md").read_text(encoding="utf-8")
    headings = set(re.findall(r"^## (\d+)\.", text, re.MULTILINE)) | set(
        re.findall(r"^## Annex (\w):", text, re.MULTILINE)
    )
    for rule in select(side):
        assert rule.section in headings, rule.name
        assert "\n" not in rule.title
        assert len(rule.title) <= 130, rule.name


def test_rules_are_chosen_by_level_and_by_name() -> None:
    """Both together are both conditions; the order is that of levels and sections; an unknown name is an error."""
    assert {rule.level for rule in select("server", [Level.LANES])} == {Level.LANES}
    assert [rule.name for rule in select("server", names=["gusts", "header-size"])] == [
        "header-size",
        "gusts",
    ]
    assert select("server", [Level.LANES], ["gusts"]) == []
    with pytest.raises(KeyError):
        select("server", names=["no-such-rule"])


# --- programs that are no servers ---


def program(tmp_path: Path, text: str) -> str:
    """The command of a Python program."""
    path = tmp_path / "program.py"
    path.write_text(text, encoding="utf-8")
    return shlex.join([sys.executable, str(path)])


def test_a_command_that_does_not_exist_fails_by_its_name() -> None:
    """The failure says which program cannot be run."""
    result = run_rule(SERVER_RULES["header-size"], "no-such-program --fast")
    assert result.outcome is Outcome.FAILED
    assert "no-such-program" in result.details


def test_a_server_that_crashes_shows_its_last_words(tmp_path: Path) -> None:
    """Exit code and what it printed are in the result, at once."""
    result = run_rule(SERVER_RULES["header-size"], program(tmp_path, "raise SystemExit('no engine here')"))
    assert "exit code 1" in result.details
    assert "no engine here" in result.last_words


def test_a_server_that_never_attaches_is_waited_for_once(tmp_path: Path) -> None:
    """With a whole suite before it, one time-out tells everything, and the process is gone."""
    command = program(tmp_path, "import time\nprint('thinking', flush=True)\ntime.sleep(600)")
    rules = select("server", [Level.CORE])
    results = run_suite(rules, command, timeout=1.0)
    assert [result.outcome for result in results] == [Outcome.FAILED] * len(rules)
    assert {result.seconds for result in results} == {0.0}
    assert "a header within 1 s" in results[0].details
    assert results[0].last_words == "thinking"


def test_garbage_that_a_server_prints_breaks_no_report(tmp_path: Path) -> None:
    """Bytes that are neither text nor XML."""
    command = program(tmp_path, "import os\nos.write(1, bytes(range(256)) * 100)\nos._exit(1)")
    results = [run_rule(SERVER_RULES["header-size"], command)]
    junit = junit_report(results, "server", "shm")
    assert ElementTree.fromstring(junit).find(".//system-out") is not None
    assert json.loads(json.dumps(json_report(results, "server", command, "shm")))["failed"] == 1
    assert "header-size" in text_report(results, "a heading")


def _runs(pid: str) -> bool:
    """Whether a process is there and no zombie."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text(encoding="ascii")
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state.rpartition(")")[2].split()[0] != "Z"


def test_whatever_a_server_has_started_ends_with_the_rule(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A server that is deaf to signals and its child are both gone, and so are segments and scratch folders."""
    note = tmp_path / "pids"
    text = (
        "import os, signal, subprocess, sys, time\n"
        "signal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
        "child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)'])\n"
        f"open({str(note)!r}, 'w').write(f'{{os.getpid()}} {{child.pid}}')\n"
        "time.sleep(600)\n"
    )
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    run_rule(SERVER_RULES["header-size"], program(tmp_path, text), timeout=2.0)
    until = time.monotonic() + 20.0  # whoever was killed may take a moment to die on a busy machine
    while alive := [pid for pid in note.read_text().split() if _runs(pid)]:
        assert time.monotonic() < until, alive
        time.sleep(0.01)
    assert not list(Path("/dev/shm").glob(f"conformance-{os.getpid()}-*"))
    assert not list(tmp_path.glob("conformance-*"))


# --- reports ---


def _nothing(rig: object) -> None:
    raise Skip("a rule of a test is never run")


RULES = (
    Rule("first-rule", Level.CORE, "4", "the first thing holds", _nothing),
    Rule("second-rule", Level.CORE, "A", "the second thing holds", _nothing),
    Rule("third-rule", Level.LANES, "6", "the third thing holds", _nothing),
    Rule("fourth-rule", Level.PERFORMANCE, "10", "how fast it is", _nothing, required=False),
)
ROBUST = Rule("fifth-rule", Level.ROBUSTNESS, "10", "a fault is noticed", _nothing)
RESULTS = (
    Result(RULES[0], Outcome.PASSED, "", "", 0.25),
    Result(RULES[1], Outcome.FAILED, "height: expected 1, found 2 < 3", "oh\x00 dear", 0.5),
    Result(RULES[2], Outcome.SKIPPED, "the plant has no walls", "", 0.125),
    Result(RULES[3], Outcome.FAILED, "speed: expected more, found less", "", 0.0),
)


def test_the_text_has_one_line_a_rule_under_its_level() -> None:
    """With section and title; what failed is followed by expected, found and the peer's last words."""
    assert text_report(RESULTS, "server 'x'").splitlines() == [
        "server 'x'",
        "",
        "core",
        "  passed   §4       first-rule: the first thing holds",
        "  failed   annex A  second-rule: the second thing holds",
        "             height: expected 1, found 2 < 3",
        "             the peer printed:",
        "             | oh\x00 dear",
        "",
        "lanes",
        "  skipped  §6       third-rule: the third thing holds",
        "             the plant has no walls",
        "",
        "performance",
        "  failed   §10      fourth-rule: how fast it is (not required)",
        "             speed: expected more, found less",
        "",
        "core: 1 passed, 1 failed",
        "lanes: 1 skipped",
        "performance: 1 failed",
        "does not conform: 1 passed, 2 failed, 1 skipped",
    ]


def test_the_text_may_leave_out_what_passed() -> None:
    """Failures, skips and the sums stay; a level of which every rule passed is left out."""
    lines = text_report(
        (*RESULTS, replace(RESULTS[0], rule=ROBUST)), "server 'x'", failed_only=True
    ).splitlines()
    assert not [line for line in lines if line.startswith("  passed") or line.startswith("robustness")]
    assert [line.split()[0] for line in lines if line.startswith("  ") and "-rule:" in line] == [
        *("failed", "skipped", "failed")
    ]
    assert "core: 1 passed, 1 failed" in lines
    assert lines[-1] == "does not conform: 2 passed, 2 failed, 1 skipped"


def test_the_text_shows_the_same_last_words_once() -> None:
    """Process ids and rendezvous aside; others are shown in full."""
    words = "lost agent (pid {}) at shm:conformance-{}-{}"
    results = [
        Result(rule, Outcome.FAILED, f"found {number}", last_words, 0.1)
        for number, (rule, last_words) in enumerate(
            zip(
                (*RULES[:3], ROBUST),
                (words.format(1, 2, "0a"), words.format(3, 4, "ff1"), "no engine", words.format(5, 6, "b")),
                strict=True,
            )
        )
    ]
    lines = [line.strip() for line in text_report(results, "server 'x'").splitlines()]
    assert [line for line in lines if line.startswith("|")] == [
        "| " + words.format(1, 2, "0a"),
        "| no engine",
    ]
    assert lines.count("the peer printed the same as under first-rule") == 2


def test_a_run_of_some_rules_says_that_it_is_no_more() -> None:
    """In text, JSON and JUnit, whether or not one failed."""
    part = "of the rules that were run (1 of 133)"
    assert text_report(RESULTS[:1], "x", whole=133).splitlines()[-1] == f"{part}: 1 passed"
    assert text_report(RESULTS[1:2], "x", whole=133).splitlines()[-1] == f"does not conform, {part}: 1 failed"
    assert [json_report(RESULTS, "server", "x", "shm", whole)["complete"] for whole in (4, 133)] == [
        True,
        False,
    ]
    assert part in junit_report(RESULTS[:1], "server", "shm", 133)


def test_a_server_that_hangs_at_its_first_request_costs_three_rules(tmp_path: Path) -> None:
    """Then the rest is not tried, and says so; each result is told as it comes."""
    text = (
        f"import sys, time\nsys.path.insert(0, {str(ROOT)!r})\n"
        "from protocol import physics\nfrom protocol.toy import ToyPlant\n"
        "class Hangs(ToyPlant):\n    def reset(self, resets, poses):\n        time.sleep(600)\n"
        "physics.serve(sys.argv[1], Hangs())\n"
    )
    heard: list[Result] = []
    results = run_suite(
        select("server", [Level.LANES]), program(tmp_path, text), timeout=3.0, on_end=heard.append
    )
    assert heard == results
    assert [result.silent for result in results[:3]] == [True] * 3
    assert all("not tried, after 3 rules" in result.details for result in results[3:])


def test_a_fault_of_the_kit_is_a_failed_rule_that_says_so() -> None:
    """The other rules are still run."""

    def check(rig: object) -> None:
        raise ZeroDivisionError("nobody expected this")

    result = run_rule(replace(RULES[0], check=check), "true")
    assert result.outcome is Outcome.FAILED
    assert "a fault of the kit" in result.details
    assert "ZeroDivisionError: nobody expected this" in result.details


def test_a_rule_that_is_not_required_does_not_decide() -> None:
    """It is information, in the verdict and in JUnit."""
    assert conforms([RESULTS[0], RESULTS[2], RESULTS[3]])
    assert not conforms(RESULTS)
    suite = ElementTree.fromstring(junit_report(RESULTS, "server", "shm")).find(
        "testsuite[@name='server.performance']"
    )
    assert suite is not None
    assert (suite.get("failures"), suite.get("skipped")) == ("0", "1")


def test_the_json_names_its_schema_and_every_rule() -> None:
    """A reader finds version, verdict, counts and one object a rule."""
    report = json_report(RESULTS, "server", "x", "file")
    assert (report["schema"], report["conforms"], report["passed"], report["failed"]) == (1, False, 1, 2)
    assert report["rules"][1] == {
        "name": "second-rule",
        "level": "core",
        "section": "A",
        "title": "the second thing holds",
        "required": True,
        "outcome": "failed",
        "details": "height: expected 1, found 2 < 3",
        "last_words": "oh\x00 dear",
        "seconds": 0.5,
    }


def test_the_junit_counts_add_up() -> None:
    """A suite a level, a case a rule; the sums of the suites are the root's; forbidden characters are replaced."""
    root = ElementTree.fromstring(junit_report(RESULTS, "server", "shm"))
    assert root.tag == "testsuites"
    for name in ("tests", "failures", "errors", "skipped"):
        assert sum(int(suite.get(name, "")) for suite in root) == int(root.get(name, ""))
    assert [case.get("name") for case in root.iter("testcase")] == [rule.name for rule in RULES]
    failure = root.find(".//failure")
    assert failure is not None
    assert failure.get("message") == "height: expected 1, found 2 < 3"
    assert root.findtext(".//system-out") == "oh? dear"
