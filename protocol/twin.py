"""Both sides of a session in one process: the same two halves over ordinary memory, for tests and debugging."""

from __future__ import annotations

from protocol import handshake, layout
from protocol.agent import AgentSession, SessionSettings
from protocol.physics import PhysicsSession
from protocol.plant import Plant
from protocol.waiting import farewell_error


def open_twin(plant: Plant, settings: SessionSettings) -> AgentSession:
    """Open a session with a plant in this process; the agent's wait runs the physics side inline.

    What the plant raises reaches the agent as it would from another process, with the plant's own error as its
    cause. Closing the session closes the plant.

    Raises:
        HandshakeError: the plant's description does not fit the session.
    """
    command = memoryview(bytearray(layout.command_bytes(settings.lanes)))
    pose = memoryview(bytearray(layout.pose_bytes(settings.lanes)))
    doorbell = layout.COMMAND["doorbell"].word
    words = command.cast("q")
    session = AgentSession(command, pose, settings, plant.close)
    try:
        physics = PhysicsSession(command.toreadonly(), pose, plant)
    except BaseException:
        session.close()
        raise

    def wait(old: int, step: int, phase: str) -> int:
        try:
            physics.answer(words[doorbell])
        except (KeyboardInterrupt, SystemExit) as error:
            handshake.part(pose, error)
            raise
        except Exception as error:
            handshake.part(pose, error)
            reason, text = handshake.read_farewell(pose)
            raise farewell_error("physics", reason, text, step, phase) from error
        return physics.number

    session.attached(wait)
    return session
