"""Checkpoints as files: a stable-baselines3 .zip that also carries `contract.json` and `actor.npz`.

`actor.npz` holds the actor's weights in the open, read without pickle and without torch:
`weight_i` (inputs, outputs) and `bias_i` (outputs,), float32, one pair a layer, the logits last.

The rest is the model as stable-baselines3 trained it, on normalised observations: whoever flies it by `PPO.load`
must normalise and mask as the contract says.
"""

from __future__ import annotations

import io
import os
import re
import tempfile
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from agent_client.contract import Contract, from_json, to_json
from agent_client.errors import PolicyError

Weights = NDArray[np.float32]

CONTRACT_FILE: Final = "contract.json"
ACTOR_FILE: Final = "actor.npz"
SB3_FILES: Final = ("data", "policy.pth")
"""What every stable-baselines3 .zip holds."""

# Entries carry this date, and the machine and its addresses are left out, so that the same policy is the same file.
_DATE: Final = (2000, 1, 1, 0, 0, 0)
_SYSTEM_INFO: Final = "system_info.txt"
_ADDRESS: Final = re.compile(rb"at 0x[0-9a-f]+")
"""In what stable-baselines3 prints of functions, for a reader's eye alone."""

_DAMAGE: Final = (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, UnicodeDecodeError)
"""What `zipfile` raises for archives that cannot be read; RuntimeError stands for encrypted entries."""


@dataclass(frozen=True)
class Layer:
    """One dense layer: out = in @ weight + bias."""

    weight: Weights  # (inputs, outputs)
    bias: Weights  # (outputs,)


@dataclass(frozen=True)
class Checkpoint:
    """What is read from a file: contract and actor, both None for a plain stable-baselines3 .zip."""

    path: Path
    contract: Contract | None
    layers: tuple[Layer, ...] | None


def read_checkpoint(path: Path) -> Checkpoint:
    """Read contract and actor of a checkpoint, without torch and without pickle.

    Raises:
        PolicyError: no such file, one that may not be read, an empty file, no .zip, a .zip that is no
            checkpoint, or a damaged one.
    """
    content = _read_bytes(path)
    if not content:
        raise PolicyError(f"{path}: expected a checkpoint (.zip), found an empty file")
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            names = set(archive.namelist())
            ours = {CONTRACT_FILE, ACTOR_FILE}
            if ours <= names:
                contract = from_json(archive.read(CONTRACT_FILE).decode("utf-8"), str(path))
                return Checkpoint(path, contract, _read_layers(archive.read(ACTOR_FILE), path))
    except _DAMAGE as error:
        raise PolicyError(
            f"{path}: expected a checkpoint (.zip), found a file that is none or is damaged ({error})"
        ) from error
    if names & ours:
        raise PolicyError(
            f"{path}: expected both {CONTRACT_FILE} and {ACTOR_FILE}, found only {names & ours}"
        )
    if not set(SB3_FILES) <= names:
        found = ", ".join(sorted(names)[:5]) or "an empty archive"
        raise PolicyError(
            f"{path}: expected a checkpoint with {CONTRACT_FILE} and {ACTOR_FILE}, or a stable-baselines3 "
            f"policy with {' and '.join(SB3_FILES)}; found a foreign .zip ({found})"
        )
    return Checkpoint(path, None, None)


def _read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        found = "no such file"
    except IsADirectoryError:
        found = "a folder"
    except OSError as error:
        found = f"what cannot be read: {error.strerror}"
    raise PolicyError(f"{path}: expected a checkpoint (.zip), found {found}")


def write_checkpoint(path: Path, sb3_zip: bytes, contract: Contract, layers: Sequence[Layer]) -> None:
    """Write a checkpoint in one piece: a reader finds the old file or the new one, never half of one.

    Args:
        path: the .zip to write.
        sb3_zip: the model as stable-baselines3 saves it.
        contract: the policy's contract.
        layers: the actor's layers, logits last.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    temporary = Path(name)
    try:
        with os.fdopen(handle, "wb") as file:
            with zipfile.ZipFile(io.BytesIO(sb3_zip)) as source, zipfile.ZipFile(file, "w") as target:
                _put(target, CONTRACT_FILE, to_json(contract).encode("utf-8"))
                _put(target, ACTOR_FILE, _layer_bytes(layers))
                for entry in source.namelist():
                    if entry != _SYSTEM_INFO:
                        content = source.read(entry)
                        _put(target, entry, _ADDRESS.sub(b"at 0x0", content) if entry == "data" else content)
            file.flush()
            os.fsync(file.fileno())
        temporary.chmod(0o644)  # mkstemp's 0600 would keep others from reading a shared checkpoint
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _put(archive: zipfile.ZipFile, name: str, content: bytes) -> None:
    archive.writestr(zipfile.ZipInfo(name, _DATE), content, compress_type=zipfile.ZIP_DEFLATED)


def _layer_bytes(layers: Sequence[Layer]) -> bytes:
    arrays: dict[str, Weights] = {}
    for i, layer in enumerate(layers):
        arrays |= {f"weight_{i}": layer.weight, f"bias_{i}": layer.bias}
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def _read_layers(content: bytes, path: Path) -> tuple[Layer, ...]:
    """Read the actor's layers; refused unless they follow each other and hold finite float32."""
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            count = len(arrays.files) // 2
            pairs = [(arrays[f"weight_{i}"], arrays[f"bias_{i}"]) for i in range(count)]
    except (KeyError, ValueError, *_DAMAGE) as error:
        raise PolicyError(f"{path}: {ACTOR_FILE} is damaged ({error}); write the checkpoint again") from error
    inputs = None
    for i, (weight, bias) in enumerate(pairs):
        right = (
            weight.dtype == bias.dtype == np.float32 and weight.ndim == 2 and bias.shape == weight.shape[1:]
        )
        if not (
            right
            and inputs in (None, weight.shape[0])
            and np.isfinite(weight).all()
            and np.isfinite(bias).all()
        ):
            raise PolicyError(
                f"{path}: {ACTOR_FILE}: layer {i}: expected finite float32 weights "
                f"({inputs or 'inputs'}, outputs) and biases (outputs,), found {weight.dtype} "
                f"{weight.shape} and {bias.dtype} {bias.shape}"
            )
        inputs = weight.shape[1]
    return tuple(Layer(np.ascontiguousarray(w), np.ascontiguousarray(b)) for w, b in pairs)
