"""The C header and the C# layout: generated, up to date, and true in the eyes of the compilers."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from protocol import bindings, layout
from protocol.errors import RefusalCode
from protocol.layout import Field
from protocol.plant import PARAMETERS
from protocol.states import State

STRICT = ["-Wall", "-Wextra", "-Werror", "-pedantic", f"-I{bindings.C_HEADER.parent}"]
TABLES = {
    "command_row": layout.COMMAND_ROW,
    "pose_row": layout.POSE_ROW,
    "reset_row": layout.RESET_ROW,
    "command_segment": layout.COMMAND_SEGMENT,
    "pose_segment": layout.POSE_SEGMENT,
}
needs_cc = pytest.mark.skipif(
    shutil.which("cc") is None, reason="no C compiler: apt-get install gcc libc6-dev"
)
needs_cxx = pytest.mark.skipif(shutil.which("c++") is None, reason="no C++ compiler: apt-get install g++")

Run = Callable[[str, str], str]


@pytest.fixture
def run_c(tmp_path: Path) -> Run:
    """Compile a C program around the header and return what it prints; the second argument is its body."""

    def run(includes: str, body: str) -> str:
        source, program = tmp_path / "program.c", tmp_path / "program"
        source.write_text(f'{includes}\n#include "tube_cosim.h"\nint main(void)\n{{\n{body}\nreturn 0;\n}}\n')
        subprocess.run(["cc", "-std=c11", *STRICT, str(source), "-o", str(program)], check=True, timeout=60)
        return subprocess.run([program], check=True, timeout=10, capture_output=True, text=True).stdout

    return run


@pytest.mark.parametrize(
    ("path", "generated"),
    [
        (bindings.C_HEADER, bindings.c_header()),
        (bindings.CSHARP_LAYOUT, bindings.csharp_layout()),
    ],
)
def test_the_files_are_what_the_tables_generate(path: Path, generated: str) -> None:
    """The files in the repository are those that `python -m protocol.bindings` writes now."""
    assert path.read_text(encoding="utf-8") == generated, "run `python -m protocol.bindings`"


@needs_cc
def test_the_c_compiler_puts_every_field_where_the_table_has_it(run_c: Run) -> None:
    """Offset and size of each struct's fields, as the compiler sees them, are those of the table of bytes."""
    fields = [(name, field) for name, fields in TABLES.items() for field in fields if field.count]
    lines = [
        f'printf("%zu %zu\\n", offsetof(tube_{name}, {field.name}), sizeof(((tube_{name} *)0)->{field.name}));'
        for name, field in fields
    ]
    found = [
        tuple(map(int, line.split())) for line in run_c("#include <stdio.h>", "\n".join(lines)).splitlines()
    ]
    assert found == [(field.offset, field.size) for _, field in fields]


@needs_cc
def test_the_rows_of_c_begin_where_those_of_the_table_begin(run_c: Run) -> None:
    """The functions that find rows and sizes agree with the table for any number of lanes."""
    body = """
    static int64_t memory[8192];
    const tube_command_segment *command = (const tube_command_segment *)memory;
    const tube_pose_segment *pose = (const tube_pose_segment *)memory;
    const char *start = (const char *)memory;
    for (int64_t lanes = 1; lanes < 8; lanes += 3)
        printf("%td %td %td %lld %lld\\n", (const char *)(tube_commands(command) + lanes) - start,
               (const char *)tube_resets(command, lanes) - start, (const char *)(tube_poses(pose) + lanes) - start,
               (long long)tube_command_bytes(lanes), (long long)tube_pose_bytes(lanes));
    """
    expected = [
        [
            layout.command_rows(lanes).stop,
            layout.reset_rows(lanes).start,
            layout.pose_rows(lanes).stop,
            layout.command_bytes(lanes),
            layout.pose_bytes(lanes),
        ]
        for lanes in (1, 4, 7)
    ]
    found = run_c("#include <stdio.h>", body)
    assert [list(map(int, line.split())) for line in found.splitlines()] == expected


@needs_cc
def test_the_parameters_of_c_have_order_and_range_of_the_table(run_c: Run) -> None:
    """Names, ranges and places of the plant parameters are those of the specification; so are the magics."""
    body = """
    static const struct { const char *name, *range; double lowest, highest; int whole; } all[] = TUBE_PARAMETERS;
    const int64_t magics[] = {TUBE_COMMAND_MAGIC, TUBE_POSE_MAGIC};
    printf("%.16s\\n", (const char *)magics);
    for (int i = 0; i < TUBE_PARAMETER_COUNT; i++)
        printf("%s|%s|%a|%a|%d\\n", all[i].name, all[i].range, all[i].lowest, all[i].highest, all[i].whole);
    """
    magics, *rows = run_c("#include <stdio.h>", body).splitlines()
    assert magics == "TUBE.CMDTUBE.POS"
    assert len(rows) == len(PARAMETERS)
    for row, parameter in zip(rows, PARAMETERS, strict=True):
        name, text, low, high, whole = row.split("|")
        lowest, highest = float.fromhex(low), float.fromhex(high)
        assert (name, text, whole == "1") == (parameter.name, parameter.range, bool(parameter.either))
        taken = parameter.either or (lowest, highest)
        assert (lowest, highest) == (min(taken), max(taken))
        assert (lowest > 0.0) == (parameter.above_lowest and not parameter.either)
        assert lowest >= parameter.lowest
        assert highest <= parameter.highest


@needs_cxx
def test_the_header_is_cpp_too(tmp_path: Path) -> None:
    """A C++11 compiler takes the header, all of its assertions included, without a warning."""
    source = tmp_path / "program.cpp"
    source.write_text('#include "tube_cosim.h"\n')
    subprocess.run(["c++", "-std=c++11", *STRICT, "-fsyntax-only", str(source)], check=True, timeout=60)


def csharp_class(name: str) -> dict[str, int]:
    """The constants of one of the static classes within Layout."""
    text = bindings.CSHARP_LAYOUT.read_text(encoding="utf-8")
    (body,) = re.findall(rf"public static class {name}\n\s*{{\n(.*?)\n\s*}}", text, re.DOTALL)
    return {key: int(value) for key, value in re.findall(r"const int (\w+) = (-?\d+);", body)}


def pascal(name: str) -> str:
    """tube_sha256 -> TubeSha256."""
    return "".join(part.capitalize() for part in name.split("_"))


@pytest.mark.parametrize(
    ("name", "fields"),
    [(pascal(name.removesuffix("_segment")), fields) for name, fields in TABLES.items()],
)
def test_csharp_has_every_offset(name: str, fields: tuple[Field, ...]) -> None:
    """Each static class has a constant for every field of its table, and the size of every text."""
    found = csharp_class(name)
    for field in fields:
        assert found.pop(pascal(field.name)) == field.offset
        if field.kind == "bytes" and field.name != "magic":
            assert found.pop(f"{pascal(field.name)}Size") == field.size
    assert found == {}


def test_csharp_has_the_words_of_the_parameters() -> None:
    """The indices of the plant parameters are their places in the table."""
    assert csharp_class("ParameterIndex") == {pascal(p.name): i for i, p in enumerate(PARAMETERS)}


@pytest.mark.parametrize("kind", [layout.Op, layout.Status, layout.Farewell, RefusalCode, State])
def test_both_languages_have_the_codes(kind: type[layout.Op]) -> None:
    """Ops, statuses, farewells, refusal codes and states stand in both files with their numbers."""
    header, csharp = bindings.c_header(), bindings.csharp_layout()
    prefix = "REFUSAL" if kind is RefusalCode else kind.__name__.upper()
    (body,) = re.findall(rf"public enum {kind.__name__} : long\n\s*{{\n(.*?)\n\s*}}", csharp, re.DOTALL)
    for member in kind:
        assert f"    TUBE_{prefix}_{member.name} = {member.value},\n" in header
        assert f" {pascal(member.name.lower())} = {member.value}," in body
