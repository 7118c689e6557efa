"""Runs rules, each on a fresh start of the peer under test."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final

import numpy as np

# The modules of rules register them when they are imported.
from protocol.conformance import (  # noqa: F401
    agent_faults,
    agent_violations,
    agents,
    core_exchange,
    core_handshake,
    core_law,
    core_refusals,
    core_requests,
    lanes,
    occupancy,
    performance,
    robustness,
    violations,
)
from protocol.conformance.rig import Rig
from protocol.conformance.rule import (
    AGENT_RULES,
    SERVER_RULES,
    Failure,
    Level,
    Outcome,
    Result,
    Rule,
    Silence,
    Skip,
)
from protocol.handshake import magic

RULES: Final[dict[str, dict[str, Rule]]] = {"server": SERVER_RULES, "agent": AGENT_RULES}
"""All rules by the side that has to keep them, then by name."""

PATIENCE: Final = 3
"""How many rules in a row may end in silence before the rest is not tried."""
TIMEOUT_S: Final = 10.0
"""How long a peer may take to start, or to answer, if nobody says otherwise."""


def select(side: str, levels: Iterable[Level] = (), names: Iterable[str] = ()) -> list[Rule]:
    """Return the rules for a side by level and section: all of them, or those of some levels and some names.

    Args:
        side: "server" or "agent".
        levels: these alone; none means all.
        names: these alone; none means all.

    Raises:
        KeyError: there is no rule of such a name.
    """
    rules, wanted = RULES[side], list(levels)
    chosen = [rules[name] for name in names] or list(rules.values())
    return sorted((rule for rule in chosen if not wanted or rule.level in wanted), key=_place)


def _place(rule: Rule) -> tuple[int, int]:
    """Sort by level, then by section, the annexes last."""
    section = int(rule.section) if rule.section.isdigit() else ord(rule.section)
    return list(Level).index(rule.level), section


def run_rule(rule: Rule, command: str, transport: str = "shm", timeout: float = TIMEOUT_S) -> Result:
    """Start `COMMAND RENDEZVOUS` for one rule, run its check, and clear everything away.

    Args:
        rule: what is to hold.
        command: the peer under test, as one would type it, without the rendezvous.
        transport: "shm" or "file".
        timeout: how long the peer may take to start, or to answer (s).
    """
    began = time.perf_counter()
    outcome, details, last_words, silent = Outcome.PASSED, "", "", False
    with np.errstate(all="ignore"), Rig(command, transport, timeout) as rig:  # a peer may answer anything
        try:
            details = rule.check(rig) or ""
        except Skip as skip:
            outcome, details = Outcome.SKIPPED, str(skip)
        except Failure as failure:
            outcome, details, last_words = Outcome.FAILED, str(failure), rig.last_words()
            silent = isinstance(failure, Silence)
        except Exception as error:  # noqa: BLE001  whatever the peer did, the other rules are still to be run
            details = f"a fault of the kit, not of the peer (please report it): {_in_words(error)}"
            outcome, last_words = Outcome.FAILED, rig.last_words()
    return Result(rule, outcome, details, last_words, time.perf_counter() - began, silent)


def _in_words(error: Exception) -> str:
    """Put an exception that nobody expected into one line: its type and text, and where it came from."""
    frames = traceback.extract_tb(error.__traceback__)
    where = f", in {Path(frames[-1].filename).name}, line {frames[-1].lineno}" if frames else ""
    return f"{type(error).__name__}: {error}{where}"


def run_suite(
    rules: Iterable[Rule],
    command: str,
    transport: str = "shm",
    timeout: float = TIMEOUT_S,
    on_start: Callable[[Rule], None] | None = None,
    on_end: Callable[[Result], None] | None = None,
) -> list[Result]:
    """Run rules one after the other; `on_start` hears of each before it runs, `on_end` of how it ended.

    The arguments are those of `run_rule`. Where nothing ever attaches, the rules fail without being tried: each
    would wait for as long as the first. So do those behind `PATIENCE` in a row whose peer, which ran, said nothing.
    """
    rules = list(rules)
    worth_it = len(rules) > 1 and rules[0] in SERVER_RULES.values()
    silence = _silence(command, transport, timeout) if worth_it else None
    results: list[Result] = []
    for rule in rules:
        if on_start is not None:
            on_start(rule)
        if silence is not None:
            result = Result(rule, Outcome.FAILED, *silence, seconds=0.0)
        else:
            result = run_rule(rule, command, transport, timeout)
        results.append(result)
        if on_end is not None:
            on_end(result)
        tried = [each.silent for each in results if each.outcome is not Outcome.SKIPPED][-PATIENCE:]
        if silence is None and tried == [True] * PATIENCE:
            silence = f"not tried, after {PATIENCE} rules in a row without an answer: {result.details}", ""
    return results


def _silence(command: str, transport: str, timeout: float) -> tuple[str, str] | None:
    """Say what was found where a server runs but says nothing to a sound offer, and what it printed; else None."""
    with Rig(command, transport, timeout) as rig:
        agent = rig.agent()
        agent.offer()
        process = rig.start()
        agent.attend(process)
        try:
            agent.await_header()
        except Failure as failure:
            if any(magic(agent.pose)) or agent.farewell()[0] or process.watch() is not None:
                return None  # it says something, or ends: the rules tell more, and soon
            return f"not tried: {failure}", rig.last_words()
    return None


def conforms(results: Iterable[Result]) -> bool:
    """Whether no required rule failed."""
    return not any(result.outcome is Outcome.FAILED and result.rule.required for result in results)
