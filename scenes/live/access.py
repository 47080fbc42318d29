"""Access to the live viewer's server, and reports of what browsers send that cannot be understood.

A browser lets every page that it shows, from anywhere, connect to a WebSocket on this machine; it only says where that
page came from, in `Origin`. So the server has to look. `Host` tells a page of another name that was made to resolve to
this machine (DNS rebinding), and a refusal to be framed keeps others from laying this page under their own.
"""

import asyncio
import http
import logging
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from typing import Any

from websockets.asyncio import server as websockets_server
from websockets.datastructures import Headers
from websockets.exceptions import WebSocketException
from websockets.http11 import Request, Response

from scenes.live.page.channel import PageChannel

_NAMES = ("127.0.0.1", "localhost")
_LOGGER = "websockets.server"  # of the library, which viser leaves as it is
_NOT_FRAMED = {"Content-Security-Policy": "frame-ancestors 'none'", "X-Frame-Options": "DENY"}
_REFUSAL = b"Only the page of mapctl live itself may do that.\n"

_ConnectionHandler = Callable[[Any], Awaitable[None]]
_RequestHandler = Callable[[Any, Request], Response | None]


def is_own_page(headers: Headers, port: int) -> bool:
    """Return whether a request is from a page of this server.

    It names this server as its host; it says no other origin; and it says this one if it wants a WebSocket, which
    browsers always do.
    """
    hosts = [f"{name}:{port}" for name in _NAMES]
    asked, came = headers.get_all("Host"), headers.get_all("Origin")
    if len(asked) != 1 or asked[0].lower() not in hosts:
        return False
    if not came:
        return not headers.get_all("Upgrade")
    return len(came) == 1 and came[0].lower() in [f"http://{host}" for host in hosts]


@contextmanager
def restrict_to_own_pages(channel: PageChannel | None = None) -> Iterator[None]:
    """Make a viser server that is started within refuse all but its own pages, with status 403.

    Its page gets the script of `channel`, which also takes that script's connections.

    viser has no option for it: it gives websockets neither `origins` nor a `process_request` of ours. What it calls
    is therefore replaced for as long as its server starts.
    """
    serve = websockets_server.serve

    def guarded(handler: Any, host: str, port: int, *, process_request: _RequestHandler, **options: Any) -> Any:
        taken = handler if channel is None else _share_connections(handler, channel)
        return serve(taken, host, port, process_request=_guard_request(process_request, port, channel), **options)

    websockets_server.serve = guarded
    try:
        yield
    finally:
        websockets_server.serve = serve


def _share_connections(handler: _ConnectionHandler, channel: PageChannel) -> _ConnectionHandler:
    async def handled(connection: Any) -> None:
        own = channel.is_own(connection.request.path)
        await (channel.serve(connection) if own else handler(connection))

    return handled


def _guard_request(answer: _RequestHandler, port: int, channel: PageChannel | None) -> _RequestHandler:
    written: dict[str | None, bytes] = {}  # viser's page with the script, by encoding

    def answered(connection: Any, request: Request) -> Response | None:
        if not is_own_page(request.headers, port) or not (channel is None or channel.admits(request.path)):
            about = Headers({"Content-Length": str(len(_REFUSAL)), "Content-Type": "text/plain"})
            return Response(http.HTTPStatus.FORBIDDEN, "Forbidden", about, _REFUSAL)
        response = answer(connection, request)
        if response is not None:
            response.headers.update(_NOT_FRAMED)
            if channel is not None and response.status_code == http.HTTPStatus.OK and _is_page(request.path):
                encoding = response.headers.get("Content-Encoding")
                if encoding not in written:
                    written[encoding] = channel.insert_script(bytes(response.body), encoding)
                response.body = written[encoding]
                del response.headers["Content-Length"]
                response.headers["Content-Length"] = str(len(response.body))
        return response

    return answered


def _is_page(path: str) -> bool:
    return path.partition("?")[0] in ("/", "/index.html")


class ServerErrorReporter:
    """Reports one line for each error within the server, over what a browser sent or while it went away.

    asyncio and websockets would print tracebacks. Each message is a task and each browser a connection of its own, so
    nothing else ends with it.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, tell: Callable[[str], None]):
        self._tell = tell
        self._logger = logging.getLogger(_LOGGER)
        self._logger.addFilter(self._filter_record)
        loop.call_soon_threadsafe(loop.set_exception_handler, self._handle)

    def close(self) -> None:
        """Leave the library's log as it was."""
        self._logger.removeFilter(self._filter_record)

    def _handle(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        error = context.get("exception")
        if not isinstance(error, WebSocketException | asyncio.CancelledError):  # who goes away is no fault
            self._tell(f"a browser sent what cannot be understood: {format_error(error or context.get('message', ''))}")

    def _filter_record(self, record: logging.LogRecord) -> bool:
        if record.exc_info is None:
            return True
        error = record.exc_info[1]
        if error is not None and not isinstance(error, WebSocketException | OSError | EOFError):
            self._tell(f"a browser's connection ended: {format_error(error)}")
        return False


def format_error(error: object) -> str:
    """Format an exception's kind and text without line ends; 200 characters at most."""
    kind = f"{type(error).__name__}: " if isinstance(error, BaseException) else ""
    return f"{kind}{' '.join(str(error).split())}"[:200].rstrip(": ")
