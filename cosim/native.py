"""What `cosim bench --protocol` compiles on the spot: the machine's floor, and the physics peers in C and C#."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import protocol
from cosim.errors import CosimError

COMPILE_S: Final = 120.0
RUN_S: Final = 60.0
_PROTOCOL: Final = Path(protocol.__file__).parent

FLOOR_SOURCE: Final = r"""
// Two processes pass a message of so many cache lines to and fro: what the machine itself takes for a round trip.
#define _GNU_SOURCE
#include <sched.h>
#include <stdatomic.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

enum { LINE = 64, BELL = 128 };
typedef struct { _Atomic int64_t *bell; char *payload; size_t bytes; int core; } side;
static int yields;

static int64_t now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * 1000000000LL + t.tv_nsec;
}

static void pin(int core)
{
    cpu_set_t set;
    CPU_ZERO(&set);
    CPU_SET(core, &set);
    sched_setaffinity(0, sizeof set, &set);
}

static int by_size(const void *a, const void *b)
{
    double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

static void ring(const side *ours, const char *message, int64_t number)
{
    memcpy(ours->payload, message, ours->bytes);
    atomic_store_explicit(ours->bell, number, memory_order_release);
}

static void await(const side *theirs, char *message, int64_t number)
{
    while (atomic_load_explicit(theirs->bell, memory_order_acquire) != number)
        if (yields) sched_yield();
    memcpy(message, theirs->payload, theirs->bytes);
}

int main(int count, char **words) // cores of both sides, lines there, lines back, round trips
{
    if (count != 6) return 2;
    size_t there = atoi(words[3]) * LINE, back = atoi(words[4]) * LINE, size = 2 * BELL + there + back;
    int trips = atoi(words[5]);
    char *memory = mmap(NULL, size, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    char *message = calloc(1, there > back ? there : back);
    double *taken = malloc(trips * sizeof *taken);
    if (memory == MAP_FAILED || !message || !taken) return 1;
    side agent = {(void *)memory, memory + BELL, there, atoi(words[1])};
    side physics = {(void *)(memory + BELL + there), memory + 2 * BELL + there, back, atoi(words[2])};
    yields = agent.core == physics.core;
    pid_t child = fork();
    if (child < 0) return 1;
    pin(child ? agent.core : physics.core);
    for (int64_t number = 1; number <= trips; number++) {
        int64_t began = now_ns();
        if (child) ring(&agent, message, number);
        await(child ? &physics : &agent, message, number);
        if (!child) ring(&physics, message, number);
        taken[number - 1] = (now_ns() - began) / 1e3;
    }
    if (!child) return 0;
    waitpid(child, NULL, 0);
    qsort(taken, trips, sizeof *taken, by_size);
    printf("{\"p50_us\": %.3f, \"p99_us\": %.3f, \"p999_us\": %.3f}\n",
           taken[trips / 2], taken[(int)(trips * 0.99)], taken[(int)(trips * 0.999)]);
    return 0;
}
"""


class MissingToolError(CosimError):
    """A compiler or a run-time is not installed; says how to get it."""


def build_floor(folder: Path) -> Path:
    """Compile the ping-pong in C.

    Raises:
        MissingToolError: there is no C compiler.
        CosimError: it does not compile.
    """
    source, program = folder / "floor.c", folder / "floor"
    source.write_text(FLOOR_SOURCE)
    _compile(["cc", "-std=gnu11", "-O2", str(source), "-o", str(program)], "gcc libc6-dev")
    return program


def run_floor(program: Path, cores: Sequence[int], lanes: int, trips: int) -> dict[str, float]:
    """Quantiles of the machine's own round trip, with as many cache lines as a step of so many lanes touches (us)."""
    there, back = 1 + lanes, 1 + 2 * lanes  # the words of request and reply, and the rows
    command = [str(program), *map(str, (cores[0], cores[-1], there, back, trips))]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=RUN_S)
    found: dict[str, float] = json.loads(done.stdout)
    return found


def build_c_server(folder: Path) -> list[str]:
    """Compile the reference server in C and return the command that starts it.

    Raises:
        MissingToolError, CosimError: as `build_floor`.
    """
    sources = sorted((_PROTOCOL / "c").glob("*.c"))
    program = folder / "c_server"
    _compile(
        ["cc", "-std=c11", "-O2", "-ffp-contract=off", *map(str, sources), "-lm", "-o", str(program)],
        "gcc libc6-dev",
    )
    return [str(program)]


def build_csharp_server(folder: Path) -> list[str]:
    """Compile the console server in C# and return the command that starts it with Mono.

    Raises:
        MissingToolError: there is no Mono.
        CosimError: it does not compile.
    """
    sources = sorted((_PROTOCOL / "csharp").glob("*.cs"))
    program, packages = folder / "ToyServer.exe", "mono-mcs mono-runtime libmono-system-core4.0-cil"
    _need("mono", packages)
    flags = ["-optimize+", "-r:System.Core", f"-out:{program}"]
    _compile(["mcs", *flags, *map(str, sources)], packages)
    # Mono's counters for tools would stay in /dev/shm when it is killed.
    return ["env", "MONO_DISABLE_SHARED_AREA=1", "mono", str(program)]


def _need(tool: str, packages: str) -> None:
    if shutil.which(tool) is None:
        raise MissingToolError(f"{tool} is not installed: apt-get install {packages}")


def _compile(command: list[str], packages: str) -> None:
    _need(command[0], packages)
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=COMPILE_S)
    if done.returncode:
        lines = (done.stderr or done.stdout).strip().splitlines()[:1]
        raise CosimError(
            f"{command[0]}: expected to compile, found an error: {lines[0] if lines else done.returncode}"
        )
