"""Addresses of ``--engine dask://`` at which no scheduler answers, or another server does."""

import logging
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from projections.adapters.fleet import engines
from projections.adapters.fleet.engines import ClusterError, DaskCluster
from tests.support.event_loops import run_apart

FRAME = (17).to_bytes(8, "little") + (1).to_bytes(8, "little") + (1).to_bytes(8, "little")
OTHERS = {
    "HTTP, as of Dask's dashboard": b"HTTP/1.1 400 Bad Request\r\nContent-Length: 0\r\n\r\n",
    "SSH": b"SSH-2.0-OpenSSH_9.2\r\n",
    "zeros": bytes(64),
    "a frame with a number": FRAME + b"\x05",
    "a frame that is no MessagePack": FRAME + b"\xc1",
}


@contextmanager
def answering(answer: bytes) -> Iterator[str]:
    """Address of a server that sends ``answer`` to each client, and nothing else."""
    clients = []

    def serve() -> None:
        while True:
            try:
                client, _ = listener.accept()
            except OSError:  # closed at the end
                return
            clients.append(client)
            client.sendall(answer)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield f"127.0.0.1:{listener.getsockname()[1]}"
        finally:
            listener.shutdown(socket.SHUT_RDWR)
            thread.join()
            for client in clients:
                client.close()


@pytest.mark.parametrize("answer", OTHERS.values(), ids=OTHERS.keys())
def test_another_server_is_an_error_that_says_how_to_start_a_scheduler(
    answer: bytes, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    with (
        answering(answer) as address,
        caplog.at_level(logging.DEBUG),
        pytest.raises(ClusterError) as failed,
    ):
        DaskCluster(address)
    said = str(failed.value)
    assert said.startswith(f"--engine dask://{address}: no scheduler answers there: the answer is")
    assert "start one with `dask scheduler`" in said
    assert "\n" not in said
    assert capfd.readouterr() == ("", "")


def test_no_logger_of_dask_writes_to_stderr() -> None:
    """Not even a client that has given up an ended scheduler."""
    with answering(bytes(64)) as address, pytest.raises(ClusterError):
        DaskCluster(address)
    names = [name for name in logging.root.manager.loggerDict if name.startswith("distributed")]
    assert "distributed.client" in names
    assert not [each for each in names if logging.getLogger(each).isEnabledFor(logging.CRITICAL)]


def test_a_server_that_says_nothing_is_an_error_after_a_while(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(engines, "_ANSWER_S", 0.5)
    with answering(b"") as address, pytest.raises(ClusterError, match=r"no answer within 0\.5 s"):
        DaskCluster(address)


def test_a_port_that_nobody_listens_at_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engines, "_CONNECT_S", 0.5)
    with socket.socket() as bound:  # and not listening, so that no other program takes the port
        bound.bind(("127.0.0.1", 0))
        with pytest.raises(ClusterError, match=r"no scheduler answers there: Timed out trying to"):
            DaskCluster(f"127.0.0.1:{bound.getsockname()[1]}")


def test_a_caller_that_runs_an_event_loop_gets_the_same_error() -> None:
    async def ask(address: str) -> None:
        with pytest.raises(ClusterError, match="the answer is not Dask's"):
            DaskCluster(address)

    with answering(bytes(64)) as address:
        run_apart(ask(address))


@pytest.mark.parametrize(
    ("address", "reason"), [("127.0.0.1", "missing port number"), ("::1:3", "ipv6 needs brackets")]
)
def test_what_is_no_address_is_named(address: str, reason: str) -> None:
    with pytest.raises(ClusterError, match=reason):
        DaskCluster(address)
