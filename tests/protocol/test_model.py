"""The model of the protocol in Promela: searched through by spin, tied to the table of states, and able to fail."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from protocol.states import TRANSITIONS, Event, State

MODEL = Path(__file__).resolve().parents[2] / "protocol" / "model"
CONFIGURATIONS = ("OBSERVED", "EVERY_REQUEST", "TAKEOVER", "RESTART", "WAITING", "ROGUE")
LIVENESS = "WAITING"
BY_HAND = "CROWD"
"""A configuration that takes more memory than a test may."""
DEADLINE_S = 240.0

VIOLATION = r"assertion violated \(0\|\|\(what!=\d+\)\)"
FAULTS = {
    # a torn message taken for a whole one
    "BEGIN_LAST": ("OBSERVED", r"assertion violated \(\(begin!=end_\)\|\|"),
    # one correct side sees a violation by the other
    "DOORBELL_FIRST": ("OBSERVED", VIOLATION),
    # a reply lost with its writer
    "NO_LAST_LOOK": ("OBSERVED", r"assertion violated .*\.bell[!=]=number\)"),
    # nobody moves any more
    "NO_LIVENESS": ("EVERY_REQUEST", "invalid end state"),
    # two that serve one session
    "NO_LOCK": ("TAKEOVER", r"assertion violated +!\(pose\[mine\]\.magic\)"),
    "SERVED_TWICE": ("TAKEOVER", VIOLATION),
    # a stale .pose stands alone
    "COMMAND_REMOVED_FIRST": ("RESTART", r"assertion violated \(pose_name==15\)"),
    # a header that is not whole
    "MAGIC_FIRST": ("RESTART", r"assertion violated \(cmd\[at\]\.session==at\)"),
    # one's .cmd, another's .pose
    "NO_NAME_CHECK": ("RESTART", r"assertion violated \(pose\[me\]\.session==me\)"),
    # segments outlive everybody
    "NO_REMOVAL": ("RESTART", r"assertion violated .*killed_last\[pose_name\]"),
    # two agents believe to have the name
    "NO_SECOND_LOOK": ("RESTART", r"assertion violated \(pose_name==15\)"),
    # a newer session's name goes
    "REMOVED_UNLOCKED": ("RESTART", r"assertion violated .*(\.lock!=|_name==15\))"),
    # a newer session's name goes, too
    "UNLINK_BLIND": ("RESTART", r"assertion violated .*(\.lock!=|_name==15\))"),
    # a lie is answered
    "NO_STEP_CHECK": ("ROGUE", r"assertion violated \(\(lie==0\)\|\|"),
}
"""Each fault that may be seeded, the configuration that finds it, and what spin says then."""

pytestmark = [
    pytest.mark.skipif(
        shutil.which(tool) is None, reason=f"{tool} is not installed: apt-get install spin gcc"
    )
    for tool in ("spin", "gcc")
]


@dataclass(frozen=True)
class Search:
    """One verification: what spin's verifier said, and the model's statements by process and number."""

    report: str
    statements: dict[tuple[str, int], tuple[str, str]]
    """(process, state) -> (file:line, statement)."""

    @property
    def unreached(self) -> set[tuple[str, int]]:
        """The statements that the search never came to."""
        found, process = set(), ""
        for line in self.report.splitlines():
            if match := re.match(r"unreached in (?:proctype )?(\w+)", line):
                process = match[1]
            elif match := re.match(r"\t\S+:\d+, state (\d+), ", line):
                found.add((process, int(match[1])))
        return found

    @property
    def reached(self) -> set[tuple[str, str]]:
        """Place and text of every statement that was carried out."""
        unreached = self.unreached
        return {place for number, place in self.statements.items() if number not in unreached}


def search(folder: Path, configuration: str, fault: str = "") -> Search:
    """Make the verifier of a configuration, with a fault if one is named, and run it."""

    def run(*command: str) -> str:
        done = subprocess.run(
            command, check=False, capture_output=True, text=True, cwd=folder, timeout=DEADLINE_S
        )
        assert done.returncode == 0, f"{command}: {done.stdout}{done.stderr}"
        return done.stdout

    flags = [f"-D{configuration}", *([f"-DFAULT_{fault}"] if fault else [])]
    run("spin", "-a", *flags, str(MODEL / "session.pml"))
    kind, how = ("-DNFAIR=3", ["-a", "-f"]) if configuration == LIVENESS else ("-DSAFETY", [])
    run("gcc", "-w", kind, "-DMEMLIM=1000", "-o", "pan", "pan.c")
    statements = {}
    process = ""
    for line in run("./pan", "-d").splitlines():
        if match := re.match(r"(?:proctype|init|claim) ?(\w*)", line):
            process = match[1] or "init"
        elif match := re.match(r"\tstate +(\d+) -\(.*\)-> .* \S*?([\w.]+:\d+) => (.*)$", line):
            statements[process, int(match[1])] = (match[2], match[3])
    return Search(run("./pan", *how), statements)


@pytest.fixture(scope="module")
def searched(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Search]:
    """Return the search through a configuration, which is made once."""
    done: dict[str, Search] = {}

    def get(configuration: str) -> Search:
        if configuration not in done:
            done[configuration] = search(tmp_path_factory.mktemp(configuration), configuration)
        return done[configuration]

    return get


def moves() -> dict[int, tuple[State, Event, State]]:
    """The transitions that the model's table makes, by line."""
    lines = enumerate((MODEL / "states.pml").read_text().splitlines(), 1)
    found = {number: re.fullmatch(r" +MOVE\((\w+), (\w+), (\w+)\)", line) for number, line in lines}
    return {n: (State[m[1]], Event[m[2]], State[m[3]]) for n, m in found.items() if m is not None}


@pytest.mark.parametrize("configuration", CONFIGURATIONS)
def test_the_protocol_keeps_its_promises(configuration: str, searched: Callable[[str], Search]) -> None:
    """No interleaving breaks an assertion, ends in a deadlock or waits for ever, and the search was complete."""
    report = searched(configuration).report
    assert "errors: 0" in report, report
    for sign in ("Search not completed", "search depth too small", "MEMLIM", "error:"):
        assert sign not in report
    assert ("acceptance   cycles \t+ (fairness enabled)" in report) == (configuration == LIVENESS)
    assert ("invalid end states\t+" in report) == (configuration != LIVENESS)


def test_the_models_transitions_are_those_of_the_table() -> None:
    """Each transition of the code's table stands in the model once, and no other does."""
    table = [(state, event, after) for state, each in TRANSITIONS.items() for event, after in each.items()]
    assert sorted(moves().values()) == sorted(table)


def test_every_transition_happens_and_every_statement_is_reached(searched: Callable[[str], Search]) -> None:
    """No transition and no statement of the model is dead text, but for what the assertions exclude."""
    every = [searched(configuration) for configuration in CONFIGURATIONS]
    reached = {place for each in every for place in each.reached}
    taken = {int(place.split(":")[1]) for place, text in reached if re.fullmatch(r"state = [A-Z]+", text)}
    assert taken == set(moves())
    lines = {place for place, _ in reached}
    dead = {at for each in every for at in each.statements.values() if at[0] not in lines}
    assert {text for _, text in dead} <= {"assert(0)"}, sorted(dead)


@pytest.mark.parametrize("fault", FAULTS)
def test_a_seeded_fault_is_found(fault: str, tmp_path: Path) -> None:
    """The model with a fault in it breaks the property that the fault is about."""
    configuration, finding = FAULTS[fault]
    report = search(tmp_path, configuration, fault).report
    assert "errors: 1" in report
    assert re.match(rf"pan:1: {finding}", report), report.splitlines()[0]


def test_a_wait_without_an_eye_on_the_process_may_last_for_ever(tmp_path: Path) -> None:
    """Bounded waiting is a property of its own: with the look at the process left out, a fair run waits on."""
    report = search(tmp_path, LIVENESS, "NO_LIVENESS").report
    assert report.startswith("pan:1: acceptance cycle")


def test_every_fault_and_configuration_of_the_model_is_searched() -> None:
    """What the model offers is what these tests run, and what the page about it tells."""
    text = "".join(path.read_text() for path in sorted(MODEL.glob("*.pml")))
    assert set(re.findall(r"\bFAULT_([A-Z_]+)", text)) == set(FAULTS)
    configurations = re.findall(r"^#(?:el)?if defined\((\w+)\)", text, re.MULTILINE)
    assert configurations == [*CONFIGURATIONS, BY_HAND]
    page = (MODEL / "README.md").read_text()
    for name in (*FAULTS, *configurations):
        assert f"`{name}`" in page
