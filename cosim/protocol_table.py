"""The figures of `cosim bench --protocol` as text."""

from __future__ import annotations

from typing import Any


def protocol_table(figures: dict[str, Any]) -> str:
    """Write the figures for people; a way per line, then what was left out and why."""
    machine, effort = figures["machine"], figures["effort"]
    lines = [
        f"{machine['system']}, {machine['processor']}, Python {machine['python']}, {machine['cores']} cores, "
        f"load {machine['load_average']}; medians of {effort['repeats']} interleaved repeats, "
        f"each of at most {effort['samples']} round trips",
        "",
        f"{'round trip of a command and a pose (us)':<40}{'p50':>9}{'p99':>10}{'p99.9':>11}"
        f"{'over UDP':>10}{'over fastest UDP':>18}",
    ]
    for name, row in figures["round_trip"].items():
        lines.append(
            f"  {name:<38}{row['p50_us']:9.2f}{row['p99_us']:10.2f}{row['p999_us']:11.2f}"
            f"{_ratio(row.get('over_udp')):>10}{_ratio(row.get('over_fastest_udp')):>18}"
        )
    for name, row in figures.get("floor", {}).items():
        lines.append(
            f"  {'floor_' + name:<38}{row['p50_us']:9.2f}{row['p99_us']:10.2f}{row['p999_us']:11.2f}"
        )
    if "lanes" in figures:
        lines += ["", *_lane_lines(figures["lanes"])]
    if figures.get("idle_percent"):
        idle = figures["idle_percent"]
        lines += [
            "",
            f"a waiting pair: physics takes {idle['physics']:.2f} % of a core, the agent {idle['agent']:.2f} %",
        ]
    if "observer" in figures:
        lines += ["", *_observer_lines(figures["observer"])]
    if figures["bars"]:
        width = max(len(row["name"]) for row in figures["bars"])
        lines += ["", "the project's own bars"]
        for row in figures["bars"]:
            verdict = "reached" if row["reached"] else "missed"
            lines.append(f"  {row['name']:<{width}}{row['found']:9.2f}  of {row['bar']:.2f}  {verdict}")
    if figures["skipped"]:
        lines += ["", "not measured:", *(f"  {name}: {why}" for name, why in figures["skipped"].items())]
    return "\n".join(lines)


def _lane_lines(lanes: dict[str, list[dict[str, float]]]) -> list[str]:
    lines = [
        f"{'a step of many lanes (us)':<40}{'lanes':>9}{'step':>10}{'transport':>11}{'a lane':>10}"
        f"{'over one lane':>18}{'steps/s a lane':>16}"
    ]
    for exchange, rows in lanes.items():
        for row in rows:
            lines.append(
                f"  {'session_' + exchange:<38}{row['lanes']:9.0f}{row['step_us']:10.2f}"
                f"{row['transport_us']:11.2f}{row['transport_us_per_lane']:10.3f}"
                f"{row['transport_over_one_lane']:18.2f}{row['steps_per_second_per_lane']:16.0f}"
            )
    return lines


def _observer_lines(rates: dict[str, dict[str, float]]) -> list[str]:
    lines = [
        f"{'one lane, and who looks on (us)':<40}{'p50':>9}{'p99':>10}{'looks/s':>11}{'p50 over none':>18}"
    ]
    for name, row in rates.items():
        lines.append(
            f"  {name:<38}{row['p50_us']:9.2f}{row['p99_us']:10.2f}{row['looks_per_s']:11.0f}"
            f"{row['p50_ratio']:18.2f}"
        )
    return lines


def _ratio(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"
