"""Runs rules, each on a fresh start of the peer under test."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable

import numpy as np

from protocol.conformance.rig import Rig
from protocol.conformance.rule import Failure, Outcome, Result, Rule, Skip


def run_rule(rule: Rule, command: str, transport: str = "shm", timeout: float = 10.0) -> Result:
    """Start `COMMAND RENDEZVOUS` for one rule, run its check, and clear everything away.

    Args:
        rule: what is to hold.
        command: the peer under test, as one would type it, without the rendezvous.
        transport: "shm" or "file".
        timeout: how long the peer may take to start, or to answer (s).
    """
    began = time.perf_counter()
    outcome, details, last_words = Outcome.PASSED, "", ""
    with np.errstate(all="ignore"), Rig(command, transport, timeout) as rig:  # a peer may answer anything
        try:
            details = rule.check(rig) or ""
        except Skip as skip:
            outcome, details = Outcome.SKIPPED, str(skip)
        except Failure as failure:
            outcome, details, last_words = Outcome.FAILED, str(failure), rig.last_words()
    return Result(rule, outcome, details, last_words, time.perf_counter() - began)


def run_suite(
    rules: Iterable[Rule],
    command: str,
    transport: str = "shm",
    timeout: float = 10.0,
    on_start: Callable[[Rule], None] | None = None,
    on_result: Callable[[Result], None] | None = None,
) -> list[Result]:
    """Run rules one after the other; `on_start` and `on_result` hear of each as it goes."""
    results: list[Result] = []
    for rule in rules:
        if on_start is not None:
            on_start(rule)
        results.append(run_rule(rule, command, transport, timeout))
        if on_result is not None:
            on_result(results[-1])
    return results


def conforms(results: Iterable[Result]) -> bool:
    """Whether no required rule failed."""
    return not any(result.outcome is Outcome.FAILED and result.rule.required for result in results)
