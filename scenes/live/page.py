"""The web page: a viser server for pages of its own origin only, with a script that sends held keys and gamepads.

A browser lets every page that it shows connect to a WebSocket on this machine, and states the page's origin in
`Origin`; `Host` exposes a foreign name that resolves to this machine (DNS rebinding). viser checks neither.
"""

import gzip
import html
import http
import io
import itertools
import json
import logging
import math
import queue
from collections.abc import Sequence
from contextlib import redirect_stdout, suppress
from importlib.resources import files
from typing import Annotated, Any

import pydantic
import viser
from websockets.asyncio import server as websockets_server
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

HOST = "127.0.0.1"
"""The only address that the server binds to."""
_PATH = "/mapctl/page"  # of the script's socket
_MAX_MESSAGE = 2000  # characters
_REFUSAL = b"Only the page of mapctl live itself may do that.\n"

_Share = Annotated[float, pydantic.Field(ge=-1.5, le=1.5, allow_inf_nan=False)]


class PageState(pydantic.BaseModel, frozen=True, extra="forbid"):
    """Keys and buttons held on a page; its script sends all of them whenever one changes."""

    keys: Annotated[frozenset[str], pydantic.Field(max_length=16)] = frozenset()
    """Held keys, as KeyboardEvent.code names them."""
    stick: tuple[_Share, _Share, _Share] | None = None
    """The left stick of a gamepad or of the screen to the right and down, -1 to 1, and the right trigger, 0 to 1; None
    without one."""
    aim: tuple[_Share, _Share] | None = None
    """The right stick to the right and down, -1 to 1; None without one."""
    viewer: Annotated[int, pydantic.Field(ge=0)] | None = None
    """Number of viser's client in this page."""


class PageChannel:
    """Socket of the page's script: takes the states of pages on the server's thread for the loop's."""

    def __init__(self, keys: Sequence[str], help_rows: Sequence[tuple[str, str]]):
        """Send `keys` (KeyboardEvent.code); list `help_rows` on the page: keys and what they do."""
        self._attributes = {"data-keys": " ".join(keys), "data-help": json.dumps(help_rows)}
        self._arrived: queue.SimpleQueue[tuple[int, PageState | None]] = queue.SimpleQueue()
        self._numbers = itertools.count()

    def poll(self) -> list[tuple[int, PageState | None]]:
        """Return the states since the last call by number of the page; None for a page that is gone."""
        return [self._arrived.get() for _ in range(self._arrived.qsize())]

    async def serve(self, connection: Any) -> None:
        """Take the states of one page until it goes; messages that are none are ignored."""
        number = next(self._numbers)
        with suppress(ConnectionClosed):
            async for text in connection:
                if (state := parse_state(text)) is not None:
                    self._arrived.put((number, state))
        self._arrived.put((number, None))

    def insert_script(self, body: bytes, encoding: str | None) -> bytes:
        """Insert the script into viser's page, before viser's own."""
        page = gzip.decompress(body) if encoding == "gzip" else body
        script = files("scenes.live").joinpath("page.js").read_text("utf-8")
        attributes = " ".join(f"{name}='{html.escape(value)}'" for name, value in self._attributes.items())
        page = page.replace(b"<head>", f"<head><script {attributes}>{script}</script>".encode(), 1)
        return gzip.compress(page, 6) if encoding == "gzip" else page


def parse_state(text: object) -> PageState | None:
    """Parse a message of the script; None where it is not one."""
    if isinstance(text, str) and len(text) <= _MAX_MESSAGE:
        with suppress(pydantic.ValidationError):
            return PageState.model_validate_json(text)
    return None


def open_server(port: int, channel: PageChannel) -> viser.ViserServer:
    """Start viser's server on HOST, at `port` or the next free one; it refuses all but its own pages (status 403).

    viser passes websockets neither `origins` nor a `process_request` of ours, so `serve` is replaced while it starts.
    """
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)  # tracebacks of browsers that went away
    serve = websockets_server.serve

    def guarded(handler: Any, host: str, port: int, *, process_request: Any, **options: Any) -> Any:
        async def handle(connection: Any) -> None:
            await (channel.serve if connection.request.path == _PATH else handler)(connection)

        def answer(connection: Any, request: Request) -> Response | None:
            if not is_own_page(request.headers, port):
                about = Headers({"Content-Length": str(len(_REFUSAL)), "Content-Type": "text/plain"})
                return Response(http.HTTPStatus.FORBIDDEN, "Forbidden", about, _REFUSAL)
            response = process_request(connection, request)
            return None if response is None else _finish_page(response, request, channel)

        return serve(handle, host, port, process_request=answer, **options)

    websockets_server.serve = guarded
    try:
        with redirect_stdout(io.StringIO()):  # viser prints a banner
            server = viser.ViserServer(host=HOST, port=port, label="mapctl live", verbose=False)
    finally:
        websockets_server.serve = serve

    @server.on_client_connect
    async def _(client: viser.ClientHandle) -> None:  # gives the page's script the number of viser's client
        client.gui.add_html(f'<i hidden data-mapctl-viewer="{client.client_id}"></i>', order=-math.inf)

    return server


def is_own_page(headers: Headers, port: int) -> bool:
    """Return whether a request is from a page of this server: `Host` is this server, and so is `Origin`, which may be
    missing unless the request is for a WebSocket."""
    hosts = [f"{name}:{port}" for name in (HOST, "localhost")]
    asked, origins = headers.get_all("Host"), headers.get_all("Origin")
    if len(asked) != 1 or asked[0].lower() not in hosts:
        return False
    if not origins:
        return not headers.get_all("Upgrade")
    return len(origins) == 1 and origins[0].lower() in [f"http://{host}" for host in hosts]


def _finish_page(response: Response, request: Request, channel: PageChannel) -> Response:
    """Forbid frames around a response, and insert the script where it is the page."""
    response.headers.update({"Content-Security-Policy": "frame-ancestors 'none'", "X-Frame-Options": "DENY"})
    if response.status_code == http.HTTPStatus.OK and request.path.partition("?")[0] in ("/", "/index.html"):
        response.body = channel.insert_script(bytes(response.body), response.headers.get("Content-Encoding"))
        del response.headers["Content-Length"]
        response.headers["Content-Length"] = str(len(response.body))
    return response
