"""The address of the page: refused before the server starts, which would else take another port, or wait for ever."""

from __future__ import annotations

import errno
import socket
from typing import Any

import rts
from rts.plugin_api.checks import is_count, quoted


def check_address(host: Any, port: Any) -> None:
    """Refuse addresses at which no server can be started now.

    Args:
        host: the name or number of an address of this machine, such as "127.0.0.1"; "0.0.0.0" is all of them.
        port: an integer from 1 to 65535.

    Raises:
        InputError: the host is unknown or another machine's; the port is in use, reserved, or no number of a port.
    """
    if not is_count(port) or port > 65535:
        raise rts.InputError(f"port is {quoted(port)}; expected an integer from 1 to 65535")
    if not isinstance(host, str) or not host.strip():
        raise rts.InputError(f'host is {quoted(host)}; expected an address of this machine, such as "127.0.0.1"')
    try:
        places = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except (OSError, UnicodeError):
        raise rts.InputError(
            f'host {quoted(host)} is unknown; expected an address of this machine, such as "127.0.0.1"'
        ) from None
    for family, kind, protocol, _, place in places:
        with socket.socket(family, kind, protocol) as tried:
            tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                tried.bind(place)
            except OSError as error:
                raise _refused(host, port, error) from None


def _refused(host: str, port: int, error: OSError) -> rts.InputError:
    if error.errno == errno.EADDRINUSE:
        return rts.InputError(
            f"port {port} of {host} is in use, perhaps by another viewer; end that one, or give another port "
            f"(--port {port + 1 if port < 65535 else 8080})"
        )
    if error.errno == errno.EACCES:
        return rts.InputError(f"port {port} is reserved for the system; give one above 1023 (--port 8080)")
    return rts.InputError(
        f'host {quoted(host)} is no address of this machine; expected one, such as "127.0.0.1", or "0.0.0.0" for all'
    )


def url(host: str, port: int) -> str:
    """The address to open in a browser on this machine."""
    shown = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(host, f"[{host}]" if ":" in host else host)
    return f"http://{shown}:{port}"
