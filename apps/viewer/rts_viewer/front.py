"""The server that browsers reach: it hands their connections on to viser's, but for those that other sites' pages open.

viser takes any connection. A page of another site could therefore look at the scene, and press the buttons: a page may
open websockets to any address (`Origin` names its site), and its site's name may be led to this machine once the page
is loaded, which is called DNS rebinding (`Host` is that name). Neither can be checked by viser's public means.
"""

from __future__ import annotations

import asyncio
import http.client
import io
import ipaddress
import random
import socket
import threading
from concurrent.futures import Future
from contextlib import suppress
from urllib.parse import urlsplit

LOCAL = ("localhost", "127.0.0.1", "::1")
ALL = ("0.0.0.0", "::")
HEAD = 1 << 16
"""The most bytes of a request's head."""
PATIENCE = 10.0
"""Seconds within which a request's head must have come."""
REFUSED = (
    b"HTTP/1.1 403 Forbidden\r\nContent-Type: text/plain; charset=utf-8\r\nConnection: close\r\n\r\n"
    b"This page is not shown under this name, nor to pages of other sites. Open the address that the program printed;\n"
    b"to have it shown under another name of the machine, start it with --host NAME.\n"
)


def hidden_address() -> tuple[str, int]:
    """An address and a port for a server that no page finds: the address is one of 16 million of this machine alone.

    Where the system has only one such address, the port alone is hidden.
    """
    drawn = ipaddress.IPv4Address("127.0.0.0") + random.SystemRandom().randrange(256, 2**24 - 1)
    for address in (str(drawn), "127.0.0.1"):
        with socket.socket() as tried, suppress(OSError):
            tried.bind((address, 0))
            return tried.getsockname()
    raise OSError("this machine has no free port")


class Front:
    """A server that hands connections on to another, and refuses (403) those with a foreign `Host` or `Origin`.

    Names of localhost pass, and the host that the server listens at. Where it listens at all addresses, so do addresses
    in numbers, of which rebinding has none, and the machine's own name. An `Origin` passes if it is the `Host`, too.
    Programs other than browsers send none.

    Args:
        host: the address that the server listens at; "0.0.0.0" and "::" are all.
        port: its port.
        behind: address and port of the other server.

    Raises:
        OSError: the address cannot be had.
    """

    def __init__(self, host: str, port: int, behind: tuple[str, int]):
        self._all, self._behind = host in ALL, behind
        own = socket.gethostname().lower()
        self._names = {*LOCAL, _plain(host), *((own, f"{own}.local") if self._all else ())}
        started: Future[None] = Future()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve(host, port, started)), daemon=True)
        self._thread.start()
        started.result()

    def close(self) -> None:
        """End the server and its connections."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._over.set)
            self._thread.join(timeout=5)

    def passes(self, head: bytes) -> bool:
        """True if the head of a request names this page as its host, and as the site that it comes from."""
        try:
            headers = http.client.parse_headers(io.BytesIO(head.partition(b"\n")[2]))
            (host,) = (urlsplit(f"//{value}").hostname for value in headers.get_all("Host", []))
            origins = [urlsplit(value).hostname for value in headers.get_all("Origin", [])]
        except (ValueError, http.client.HTTPException):
            return False
        if host is None or not (_plain(host) in self._names or (self._all and _is_number(host))):
            return False
        return all(origin is not None and (origin == host or _plain(origin) in self._names) for origin in origins)

    async def _serve(self, host: str, port: int, started: Future[None]) -> None:
        self._loop, self._over = asyncio.get_running_loop(), asyncio.Event()
        self._open: set[asyncio.StreamWriter] = set()
        self._tasks: set[asyncio.Task[None]] = set()
        try:
            server = await asyncio.start_server(self._accepted, host, port, limit=HEAD)
        except OSError as error:
            started.set_exception(error)
            return
        started.set_result(None)
        await self._over.wait()
        for listening in server.sockets:
            self._loop.remove_reader(listening.fileno())
        for _ in range(10):  # Connections just accepted must be open before they can be closed, and `close` would fail.
            for writer in self._open:
                writer.transport.abort()
            if not (tasks := asyncio.all_tasks() - {asyncio.current_task()}):
                break
            await asyncio.wait(tasks, timeout=0.1)
        server.close()

    def _accepted(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._open.add(writer)
        task = asyncio.create_task(self._connected(reader, writer))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Look at the head of the only request of a connection: viser's server, too, takes one for each."""
        with suppress(OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError, asyncio.CancelledError):
            try:
                head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), PATIENCE)
                if self.passes(head):
                    await self._hand_on(head, reader, writer)
                else:
                    writer.write(REFUSED)
                    await writer.drain()
            finally:
                writer.close()
                await writer.wait_closed()
                self._open.discard(writer)

    async def _hand_on(self, head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        answers, requests = await asyncio.open_connection(*self._behind)
        self._open.add(requests)
        requests.write(head)
        upwards = asyncio.create_task(_pump(reader, requests))
        try:
            await _pump(answers, writer)
        finally:
            upwards.cancel()
            requests.close()
            self._open.discard(requests)


async def _pump(source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
    """Copy bytes until they end, or either side is gone."""
    with suppress(OSError):
        while data := await source.read(HEAD):
            sink.write(data)
            await sink.drain()
        if sink.can_write_eof():
            sink.write_eof()


def _is_number(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def _plain(host: str) -> str:
    """A host as browsers write it."""
    return str(ipaddress.ip_address(host)) if _is_number(host) else host.lower()
