"""The records that compiled code works on."""

from __future__ import annotations

import ast
from pathlib import Path

import agent_client.perception
from agent_client.episodes import _COMPILED, constants, episode_dtype
from agent_client.reward import TERMS
from agent_client.settings import Settings


def test_every_compiled_neighbour_of_perception_is_in_the_digest() -> None:
    """A change in a file that perception compiles in must change the layout, or a stale cache would run on."""
    path = Path(str(agent_client.perception.__file__))
    imported = {
        f"{node.module.split('.')[1]}.py"
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("agent_client.")
    }
    assert set(_COMPILED) == imported - {"episodes.py"}
    record = constants(Settings(), 0.1, clearance_contact=True, on_contact="end")
    assert [name for name in record.dtype.names or () if name.startswith("sources_")]


def test_records_hold_a_term_of_the_reward_for_each_name() -> None:
    """The width of `reward_terms` is the number of TERMS; LiDAR readings are two rings."""
    dtype = episode_dtype(36)
    assert dtype["reward_terms"].shape == (len(TERMS),)
    assert dtype["lidar"].shape == (72,)
    assert dtype.isalignedstruct


def test_compiled_code_calls_none_of_other_files_unseen() -> None:
    """But for perception, whose records carry the digest, no compiled function calls one of another file."""
    folder = Path(str(agent_client.perception.__file__)).parent
    compiled = {
        node.name: path.name
        for path in folder.glob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef) and any("njit" in ast.unparse(d) for d in node.decorator_list)
    }
    for path in folder.glob("*.py"):
        if path.name in (*_COMPILED, "perception.py"):
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef) and compiled.get(node.name) == path.name:
                called = {n.id for n in ast.walk(node) if isinstance(n, ast.Name)} & set(compiled)
                assert all(compiled[name] == path.name for name in called), (path.name, node.name)
