"""Other ways between two processes, for `cosim bench --protocol`: each as its makers' examples have it, and no more.

Every one carries the payload of `cosim.round_trip`. Those that poll keep a core busy, as the protocol does while it
is used; the others sleep in the system. A way whose library is not installed raises ImportError when it is entered.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import socket
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from importlib import import_module
from multiprocessing.connection import Connection
from typing import Any, Final

from cosim.round_trip import COMMAND, PATIENCE_S, POSE, ROW, ZEROS, Exchange, child, udp_sockets
from physics_server import bullet_world

_LEAVE: Final = b""
_READY: Final = b"!"


@contextmanager
def udp_polling(cores: list[int]) -> Iterator[Exchange]:
    """UDP sockets that never block, each side polling on a core of its own: the best that sockets can do."""
    with udp_sockets() as (ours, theirs), child(_udp_polling_peer, theirs, cores[-1]):
        ours.send(_READY)
        ours.recv(1)
        ours.setblocking(False)
        before = os.sched_getaffinity(0)
        os.sched_setaffinity(0, cores[:1])

        def exchange() -> object:
            ours.send(COMMAND.pack(*ROW))
            return POSE.unpack(_poll(ours))

        try:
            yield exchange
        finally:
            os.sched_setaffinity(0, before)
            ours.send(_LEAVE)


def _udp_polling_peer(ours: socket.socket, core: int) -> None:
    os.sched_setaffinity(0, {core})
    with ours:
        ours.send(ours.recv(1))
        ours.setblocking(False)
        while len(datagram := _poll(ours)) == COMMAND.size:
            ours.send(POSE.pack(*COMMAND.unpack(datagram), *ZEROS))


def _poll(end: socket.socket) -> bytes:
    receive = end.recv
    while True:
        try:
            return receive(POSE.size)
        except BlockingIOError:
            pass


@contextmanager
def semaphores() -> Iterator[Exchange]:
    """Shared memory of `multiprocessing` and two of its semaphores, one for each direction."""
    context = multiprocessing.get_context("spawn")
    memory = context.RawArray("d", 64)
    asked, answered = context.Semaphore(0), context.Semaphore(0)
    octets = memoryview(memory).cast("B")
    with child(_semaphores_peer, memory, asked, answered, patience=PATIENCE_S):

        def exchange() -> object:
            COMMAND.pack_into(octets, 0, *ROW)
            asked.release()
            answered.acquire()
            return POSE.unpack_from(octets, 256)

        exchange()
        yield exchange
        octets[:8] = b"\xff" * 8  # a NaN: leave
        asked.release()


def _semaphores_peer(memory: Any, asked: Any, answered: Any) -> None:
    octets = memoryview(memory).cast("B")
    while True:
        asked.acquire()
        command = COMMAND.unpack_from(octets)
        if command[0] != ROW[0]:
            return
        POSE.pack_into(octets, 256, *command, *ZEROS)
        answered.release()


@contextmanager
def pyzmq() -> Iterator[Exchange]:
    """ZeroMQ, a pair of PAIR sockets over ipc."""
    zmq: Any = import_module("zmq")

    with tempfile.TemporaryDirectory() as folder, zmq.Context() as context, context.socket(zmq.PAIR) as ours:
        address = f"ipc://{folder}/pair"
        ours.bind(address)
        with child(_pyzmq_peer, address, patience=PATIENCE_S):

            def exchange() -> object:
                ours.send(COMMAND.pack(*ROW))
                return POSE.unpack(ours.recv())

            exchange()
            yield exchange
            ours.send(_LEAVE)


def _pyzmq_peer(address: str) -> None:
    zmq: Any = import_module("zmq")

    with zmq.Context() as context, context.socket(zmq.PAIR) as ours:
        ours.connect(address)
        while message := ours.recv():
            ours.send(POSE.pack(*COMMAND.unpack(message), *ZEROS))


@contextmanager
def grpc_unary() -> Iterator[Exchange]:
    """gRPC, unary calls over a Unix socket with the payload as bytes."""
    grpc: Any = import_module("grpc")

    ours, theirs = multiprocessing.get_context("spawn").Pipe()
    with (
        tempfile.TemporaryDirectory() as folder,
        child(_grpc_peer, f"unix:{folder}/grpc", theirs, patience=PATIENCE_S),
        ours,
    ):
        theirs.close()
        ours.recv_bytes()
        with grpc.insecure_channel(f"unix:{folder}/grpc") as channel:
            call = channel.unary_unary("/bench/Exchange")

            def exchange() -> object:
                return POSE.unpack(call(COMMAND.pack(*ROW)))

            exchange()
            yield exchange


def _grpc_peer(address: str, connection: Connection) -> None:
    grpc: Any = import_module("grpc")

    def answer(request: bytes, _context: Any) -> bytes:
        return POSE.pack(*COMMAND.unpack(request), *ZEROS)

    server = grpc.server(ThreadPoolExecutor(1))
    handler = grpc.unary_unary_rpc_method_handler(answer)
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler("bench", {"Exchange": handler}),))
    server.add_insecure_port(address)
    server.start()
    connection.send_bytes(_READY)
    _until_closed(connection)
    server.stop(None).wait()


class _Command(ctypes.Structure):
    _fields_ = (("words", ctypes.c_double * (COMMAND.size // 8)),)


class _Pose(ctypes.Structure):
    _fields_ = (("words", ctypes.c_double * (POSE.size // 8)),)


@contextmanager
def iceoryx2() -> Iterator[Exchange]:
    """iceoryx2, a publish-subscribe service for each direction, both sides polling."""
    name = f"cosim-bench-{os.getpid()}-{time.monotonic_ns()}"
    ours, theirs = multiprocessing.get_context("spawn").Pipe()
    _node, publisher, subscriber = _iceoryx_ports(name, _Command, _Pose)
    with child(_iceoryx_peer, name, theirs, patience=PATIENCE_S), ours:
        theirs.close()
        ours.recv_bytes()
        command = _Command()

        def exchange() -> object:
            COMMAND.pack_into(command, 0, *ROW)
            publisher.send_copy(command)
            sample = _receive(subscriber)
            pose = POSE.unpack_from(sample.payload().contents)
            sample.delete()
            return pose

        yield exchange
        COMMAND.pack_into(command, 0, *(0.0,) * len(ROW))
        publisher.send_copy(command)


def _iceoryx_peer(name: str, connection: Connection) -> None:
    _node, publisher, subscriber = _iceoryx_ports(name, _Pose, _Command)
    connection.send_bytes(_READY)
    pose = _Pose()
    while True:
        sample = _receive(subscriber)
        command = COMMAND.unpack_from(sample.payload().contents)
        sample.delete()
        if command[0] != ROW[0]:
            return
        POSE.pack_into(pose, 0, *command, *ZEROS)
        publisher.send_copy(pose)


def _iceoryx_ports(name: str, sent: type[Any], received: type[Any]) -> tuple[Any, Any, Any]:
    """A node with a publisher of one kind of message and a subscriber of the other; the node keeps both alive."""
    iox2: Any = import_module("iceoryx2")

    iox2.set_log_level(iox2.LogLevel.Fatal)
    node = iox2.NodeBuilder.new().create(iox2.ServiceType.Ipc)

    def service(kind: type[Any]) -> Any:
        title = iox2.ServiceName.new(f"{name}/{kind.__name__}")
        return node.service_builder(title).publish_subscribe(kind).open_or_create()

    publisher = service(sent).publisher_builder().create()
    return node, publisher, service(received).subscriber_builder().create()


def _receive(subscriber: Any) -> Any:
    receive = subscriber.receive
    while (sample := receive()) is None:
        pass
    return sample


@contextmanager
def pybullet_server() -> Iterator[Exchange]:
    """PyBullet's own SHARED_MEMORY server: force, one step, pose and velocity of one free body, four calls."""
    p: Any = bullet_world.pybullet  # type: ignore[attr-defined]  # its one importer
    ours, theirs = multiprocessing.get_context("spawn").Pipe()
    key = 0x7C000000 + os.getpid() % 0xFFFFFF
    with _without_stdout(), child(_pybullet_peer, key, theirs, patience=PATIENCE_S), ours:
        theirs.close()
        ours.recv_bytes()
        client = p.connect(p.SHARED_MEMORY, key=key)
        try:
            p.setPhysicsEngineParameter(fixedTimeStep=1.0 / 240.0, physicsClientId=client)
            sphere = p.createCollisionShape(p.GEOM_SPHERE, radius=0.15, physicsClientId=client)
            body = p.createMultiBody(1.0, sphere, physicsClientId=client)

            def exchange() -> object:
                p.applyExternalForce(body, -1, ROW[:3], ROW[5:], p.LINK_FRAME, physicsClientId=client)
                p.stepSimulation(physicsClientId=client)
                pose = p.getBasePositionAndOrientation(body, physicsClientId=client)
                return pose, p.getBaseVelocity(body, physicsClientId=client)

            yield exchange
        finally:
            p.disconnect(client)


def _pybullet_peer(key: int, connection: Connection) -> None:
    """Serve until the other end of the connection is closed; an orderly end alone removes its shared memory."""
    p: Any = bullet_world.pybullet  # type: ignore[attr-defined]
    server = p.connect(p.SHARED_MEMORY_SERVER, key=key)
    connection.send_bytes(_READY)
    _until_closed(connection)
    p.disconnect(server)


def _until_closed(connection: Connection) -> None:
    """Wait until the other end is closed, or its process is gone."""
    with connection:
        try:
            connection.recv_bytes()
        except EOFError:
            return


@contextmanager
def _without_stdout() -> Iterator[None]:
    """Throw away what an engine prints from C, here and in processes that are started meanwhile."""
    sys.stdout.flush()
    kept = os.dup(1)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.close(nowhere)
    try:
        yield
    finally:
        ctypes.CDLL(None).fflush(None)  # C keeps what it prints until later, where nobody reads along
        os.dup2(kept, 1)
        os.close(kept)
