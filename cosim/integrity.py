"""Whether a run folder still holds what was recorded: its manifest, every record, the chain of hashes."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np

from cosim.recording import (
    COMMAND_BYTES,
    DIGEST,
    LOG,
    MANIFEST,
    POSE_BYTES,
    Column,
    manifest_digest,
    manifest_text,
    next_link,
)
from cosim.runs import Run, chunks, element_names

PAYLOAD_BYTES: Final = COMMAND_BYTES + POSE_BYTES


@dataclass(frozen=True)
class Finding:
    """Something about a run that is not as it was recorded."""

    what: str
    """The thing's name: a file, or the quantity of a record."""
    expected: str
    found: str
    step: int | None = None
    """Control step of the record, None where no single record is meant."""

    def __str__(self) -> str:
        at = "" if self.step is None else f"step {self.step}: "
        return f"{at}{self.what}: expected {self.expected}, found {self.found}"


def check_data(run: Run, done: Callable[[float], None] = lambda _: None) -> Iterator[Finding]:
    """Everything in a run folder that was changed after it was recorded, in the order of the log.

    A single flipped bit is located and named; of larger damage the record is named.

    Args:
        run: as it was read.
        done: is told how many records more were checked.
    """
    yield from _check_manifest(run)
    chain = b""
    damaged = False
    first, size = 0, run.records.dtype.itemsize
    for stored in chunks(run):
        # As bytes: a copy by fields leaves out what lies between them.
        rows = bytearray(stored.tobytes())
        np.frombuffer(rows, stored.dtype)["check"] = 0
        view = memoryview(rows)
        for i, check in enumerate(stored["check"].tolist()):
            record = view[i * size : (i + 1) * size]
            link = stored["chain"][i].tobytes()
            whole = zlib.crc32(record) == check
            if not whole:
                yield _damage(run, first + i, bytes(record), check)
            elif next_link(chain, bytes(record[:PAYLOAD_BYTES])) != link and not damaged:
                yield Finding("hash chain", "the hash of all commands and poses so far", "another", first + i)
            # After damage the chain goes on from what stands, so that one fault is not named at every step.
            chain, damaged = link, not whole
        first += len(stored)
        done(len(stored))
    yield from _check_end(run, chain)


def _check_manifest(run: Run) -> Iterator[Finding]:
    expected, found = run.manifest.get(DIGEST), manifest_digest(run.manifest)
    if expected != found:
        stated = f"the SHA-256 that it states ({str(expected)[:16]}…)"
        yield Finding(MANIFEST, stated, f"{found[:16]}…: it was changed")
    elif (run.folder / MANIFEST).read_text() != manifest_text(run.manifest):
        yield Finding(MANIFEST, "the text that was recorded", "another of the same values")


def _check_end(run: Run, chain: bytes) -> Iterator[Finding]:
    """Compare the length of the log and its last link with what the manifest says of them."""
    manifest, count = run.manifest, len(run.records)
    if "records" not in manifest:
        return  # the run was cut short: nobody knows how long it would have become
    rest = (run.folder / manifest["log"]).stat().st_size % run.records.dtype.itemsize
    if manifest["records"] != count or rest:
        more = f" and {rest} bytes" if rest else ""
        yield Finding(LOG, f"{manifest['records']} records", f"{count}{more}")
    elif (stated := str(manifest.get("trajectory_hash"))) != chain.hex():
        yield Finding("trajectory_hash", f"{stated[:16]}… of the manifest", f"{chain.hex()[:16]}…")


def _damage(run: Run, index: int, record: bytes, check: int) -> Finding:
    """Name what is damaged in a record (its check sum zero) whose check sum should be `check`."""
    if (zlib.crc32(record) ^ check).bit_count() == 1:
        return Finding("check", f"{zlib.crc32(record):08x} (one bit is flipped)", f"{check:08x}", index)
    located = _flipped_bit(record, check)
    if located is None:
        return Finding(
            "record", f"CRC-32 {check:08x}", f"{zlib.crc32(record):08x}: several bits differ", index
        )
    byte, bit = located
    mended = bytearray(record)
    mended[byte] ^= 1 << bit
    for column in run.columns:
        item = np.dtype(column.type).itemsize
        element = (byte - column.offset) // item
        names = element_names(column)
        if 0 <= byte - column.offset < item * len(names):
            expected, found = (_value(raw, column, element) for raw in (bytes(mended), record))
            return Finding(names[element], f"{expected} (bit {bit} of byte {byte} is flipped)", found, index)
    return Finding(f"byte {byte} of the record", f"bit {bit} not flipped", "flipped", index)


def _flipped_bit(record: bytes, check: int) -> tuple[int, int] | None:
    """Byte and bit whose flipping gives a record its check sum; None where no single one does."""
    return _bits_by_effect(len(record)).get(zlib.crc32(record) ^ check)


@cache
def _bits_by_effect(size: int) -> dict[int, tuple[int, int]]:
    """Every bit of a record of `size` bytes by what its flipping does to the CRC-32, whatever else stands there."""
    raw = bytearray(size)
    nothing, bits = zlib.crc32(raw), {}
    for byte in range(size):
        for bit in range(8):
            raw[byte] = 1 << bit
            bits[zlib.crc32(raw) ^ nothing] = byte, bit
        raw[byte] = 0
    return bits


def _value(record: bytes, column: Column, element: int) -> str:
    dtype = np.dtype(column.type)
    return repr(np.frombuffer(record, dtype, 1, column.offset + element * dtype.itemsize)[0].item())
