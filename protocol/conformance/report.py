"""What came out, for people, for programs (JSON) and for continuous integration (JUnit XML)."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, Final
from xml.etree import ElementTree

from protocol.conformance.rule import Level, Outcome, Result
from protocol.conformance.run import conforms
from protocol.layout import VERSION_MAJOR, VERSION_MINOR

SCHEMA: Final = 1
"""Version of the JSON's form; it changes when a reader of the old one would misunderstand."""

Paint = Callable[[str, Outcome], str]
"""Gives a word the colour of an outcome, or not."""

_NOT_XML: Final = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that no XML may hold, though a peer may print them."""
_CHANGING: Final = re.compile(r"conformance-\d+-[0-9a-f]+|\d+")
"""What differs between two runs that end alike: rendezvous, process ids, times."""


def plain(text: str, outcome: Outcome) -> str:
    """Paint nothing."""
    return text


def text_report(
    results: Sequence[Result],
    heading: str,
    paint: Paint = plain,
    *,
    failed_only: bool = False,
    whole: int = 0,
) -> str:
    """Write the whole text at once; the arguments are those of `TextReport`, `whole` that of `json_report`."""
    text = TextReport(heading, paint, failed_only=failed_only)
    lines = [line for result in results for line in text.add(result)]
    return "\n".join([*text.heading, *lines, *text.sums(whole)])


class TextReport:
    """The text for people, which grows as rules end: one line a rule under its level, with what was found below it.

    What a peer printed more than once, but for numbers in it, is shown where it first was.

    Args:
        heading: the first line: what is judged.
        paint: colours the word of an outcome.
        failed_only: leave out the rules that passed.
    """

    def __init__(self, heading: str, paint: Paint = plain, *, failed_only: bool = False) -> None:
        self.heading = [heading]
        self._paint, self._failed_only = paint, failed_only
        self._results: list[Result] = []
        self._levels: list[Level] = []
        self._said = ""
        self._printed: dict[str, str] = {}

    def add(self, result: Result) -> list[str]:
        """Take a result, in the order of levels, and return its lines."""
        self._results.append(result)
        if self._failed_only and result.outcome is Outcome.PASSED:
            return []
        lines, level = [], result.rule.level
        if level not in self._levels:
            self._levels.append(level)
            lines = ["", level.value]
        remark = _remark(result, self._printed)
        told = ["as above"] if remark and remark == self._said else remark.splitlines()
        self._said = remark
        return [*lines, _line(result, self._paint), *(f"{_INDENT}{line}" for line in told)]

    def sums(self, whole: int = 0) -> list[str]:
        """Return the sum of each level that was shown, then the verdict."""
        by_level = {level: [r for r in self._results if r.rule.level is level] for level in self._levels}
        lines = ["", *(f"{level.value}: {_sum(results)}" for level, results in by_level.items())]
        return [
            *lines,
            f"{_verdict(self._results, whole, self._paint)}: {_sum(self._results) or 'none ended'}",
        ]


def _verdict(results: Sequence[Result], whole: int, paint: Paint) -> str:
    """Say whether the peer conforms, or what is known of it where not all rules were run."""
    part = "" if len(results) >= whole else f"of the rules that were run ({len(results)} of {whole})"
    if not conforms(results):
        return ", ".join(filter(None, (paint("does not conform", Outcome.FAILED), part)))
    return part or paint("conforms", Outcome.PASSED)


_INDENT: Final = " " * 13


def _line(result: Result, paint: Paint) -> str:
    rule = result.rule
    word = paint(f"{result.outcome.value:<7}", result.outcome)
    optional = "" if rule.required else " (not required)"
    section = f"annex {rule.section}" if rule.section.isalpha() else f"§{rule.section}"
    return f"  {word}  {section:<7}  {rule.name}: {rule.title}{optional}"


def _remark(result: Result, printed: dict[str, str]) -> str:
    """What was found; `printed` maps last words, their numbers aside, to the rule under which they are shown."""
    if result.outcome is not Outcome.FAILED or not result.last_words.strip():
        return result.details
    first = printed.setdefault(_CHANGING.sub("#", result.last_words), result.rule.name)
    if first != result.rule.name:
        return f"{result.details}\nthe peer printed the same as under {first}"
    words = "".join(f"\n| {line}" for line in result.last_words.splitlines())
    return f"{result.details}\nthe peer printed:{words}"


def _sum(results: Sequence[Result]) -> str:
    counts = Counter(result.outcome for result in results)
    return ", ".join(f"{counts[outcome]} {outcome.value}" for outcome in Outcome if counts[outcome])


def json_report(
    results: Sequence[Result], side: str, command: str, transport: str, whole: int = 0
) -> dict[str, Any]:
    """Return the report as what `json.dumps` takes; `whole` is how many rules there are, for a run of fewer."""
    counts = Counter(result.outcome for result in results)
    return {
        "schema": SCHEMA,
        "protocol": f"{VERSION_MAJOR}.{VERSION_MINOR}",
        "side": side,
        "command": command,
        "transport": transport,
        "conforms": conforms(results),
        "complete": len(results) >= whole,
        **{outcome.value: counts[outcome] for outcome in Outcome},
        "rules": [
            {
                "name": result.rule.name,
                "level": result.rule.level.value,
                "section": result.rule.section,
                "title": result.rule.title,
                "required": result.rule.required,
                "outcome": result.outcome.value,
                "details": result.details,
                "last_words": result.last_words,
                "seconds": round(result.seconds, 3),
            }
            for result in results
        ],
    }


def junit_report(results: Sequence[Result], side: str, transport: str, whole: int = 0) -> str:
    """Write JUnit XML: a suite a level, a case a rule; a rule that is not required never fails there."""
    part = "" if len(results) >= whole else f", of the rules that were run ({len(results)} of {whole})"
    name = f"conformance of the {side} over {transport}{part}"
    root = ElementTree.Element("testsuites", {"name": name, **_totals(results)})
    for level in Level:
        of_level = [result for result in results if result.rule.level is level]
        if of_level:
            suite = ElementTree.SubElement(
                root, "testsuite", {"name": f"{side}.{level.value}", **_totals(of_level)}
            )
            for result in of_level:
                _case(suite, result, f"{side}.{transport}.{level.value}")
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _case(suite: ElementTree.Element, result: Result, group: str) -> None:
    case = ElementTree.SubElement(
        suite, "testcase", classname=group, name=result.rule.name, time=f"{result.seconds:.3f}"
    )
    told = _xml(result.details)
    if _fails(result):
        failure = ElementTree.SubElement(case, "failure", message=told, type="Failure")
        failure.text = f"section {result.rule.section}: {result.rule.title}\n{told}"
    elif result.outcome is not Outcome.PASSED:
        ElementTree.SubElement(case, "skipped", message=told)
    printed = result.last_words if result.outcome is Outcome.FAILED else ""
    if printed or (told and result.outcome is Outcome.PASSED):
        ElementTree.SubElement(case, "system-out").text = _xml(printed) or told


def _fails(result: Result) -> bool:
    return result.outcome is Outcome.FAILED and result.rule.required


def _totals(results: Sequence[Result]) -> dict[str, str]:
    failures = sum(map(_fails, results))
    passed = sum(result.outcome is Outcome.PASSED for result in results)
    return {
        "tests": str(len(results)),
        "failures": str(failures),
        "errors": "0",
        "skipped": str(len(results) - failures - passed),
        "time": f"{sum(result.seconds for result in results):.3f}",
    }


def _xml(text: str) -> str:
    return _NOT_XML.sub("?", text)
