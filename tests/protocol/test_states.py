"""The table of states, looped over."""

from __future__ import annotations

import itertools

import pytest

from protocol.errors import SessionError
from protocol.states import TRANSITIONS, TURN, Event, Side, State, follow

REQUESTS = [Event.STEP, Event.RESET, Event.REGISTER_TUBE, Event.RELEASE_TUBE, Event.GOODBYE]
ENDS = {State.CLOSED, State.BROKEN}


@pytest.mark.parametrize(("state", "event"), list(itertools.product(State, Event)))
def test_an_event_does_what_the_table_says_or_is_refused(state: State, event: Event) -> None:
    """Every pair of state and event leads where the table says, else it is an error that names both."""
    if event in TRANSITIONS[state]:
        assert follow(state, event) is TRANSITIONS[state][event]
    else:
        with pytest.raises(SessionError, match=f"{state.name}: expected .*, found {event.name}"):
            follow(state, event)


def test_every_state_can_be_reached() -> None:
    """No state of the table is dead text."""
    reached = {State.ABSENT}
    for _ in State:
        reached |= {after for state in reached for after in TRANSITIONS[state].values()}
    assert reached == set(State)


@pytest.mark.parametrize("state", State)
def test_requests_are_made_in_ready_alone(state: State) -> None:
    """Requests lead from READY and from nowhere else, each into a state of its own."""
    found = [event for event in REQUESTS if event in TRANSITIONS[state]]
    assert found == (REQUESTS if state is State.READY else [])
    assert len({TRANSITIONS[State.READY][event] for event in REQUESTS}) == len(REQUESTS)


@pytest.mark.parametrize("state", sorted(set(State) - ENDS - {State.ABSENT}))
def test_every_open_session_can_break(state: State) -> None:
    """Wherever a session stands, a farewell, a violation and a loss end it."""
    assert {TRANSITIONS[state][e] for e in (Event.FAREWELL, Event.VIOLATION, Event.LOSS)} == {State.BROKEN}


@pytest.mark.parametrize("state", sorted(ENDS))
def test_nothing_follows_the_end(state: State) -> None:
    """A closed or broken session stays so, and nobody writes."""
    assert TRANSITIONS[state] == {}
    assert TURN[state] is Side.NOBODY


def test_turns_alternate() -> None:
    """A request hands the turn to physics, a reply hands it back, and a goodbye's reply to nobody."""
    for event in REQUESTS:
        asked = TRANSITIONS[State.READY][event]
        assert (TURN[State.READY], TURN[asked]) == (Side.AGENT, Side.PHYSICS)
        done = TRANSITIONS[asked][Event.DONE]
        assert TURN[done] is (Side.NOBODY if event is Event.GOODBYE else Side.AGENT)
