"""`cosim launch`: one flight, from the user's options to a run folder and a summary."""

from __future__ import annotations

import json
import platform
import sys
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any, Final

import click

from agent_client.flight import FlightResult, FlightStep, fly
from cosim import __version__
from cosim.inputs import Inputs, read_inputs
from cosim.options import FlightOptions
from cosim.progress import Progress
from cosim.recording import Recorder
from cosim.sessions import physics_session, rendezvous_of
from protocol.agent import AgentSession, SessionSettings
from protocol.plant import PARAMETERS, TubeReference

TUBE: Final = 0
"""Index under which the flight's tube is registered."""
