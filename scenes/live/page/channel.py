"""The socket of the page's own script, and the script within viser's page."""

import asyncio
import gzip
import itertools
import json
import queue
import secrets
from collections.abc import Callable
from contextlib import suppress
from importlib.resources import files
from typing import Any
from urllib.parse import parse_qs, urlsplit

from websockets.exceptions import ConnectionClosed

from mapctl.errors import RequestError
from scenes.live.page.keys import KEYS
from scenes.live.page.messages import PageMessage, parse_message

PATH = "/mapctl/page"
"""Where the script connects."""
_SAY_SECONDS = 60.0
_HEAD = b"<head>"


class PageChannel:
    """Takes what pages send, from the server's thread, and keeps it for the show's own."""

    def __init__(self):
        self._token = secrets.token_urlsafe(18)
        self._arrived: queue.SimpleQueue[tuple[int, PageMessage | None]] = queue.SimpleQueue()
        self._numbers = itertools.count()
        self._sockets: dict[int, tuple[Any, asyncio.AbstractEventLoop]] = {}
        self._greeting = json.dumps({"help": [], "dark": False})
        self.dropped = 0
        """Messages so far that were none."""
        self._fault, self._said, self._said_at = "", 0, -_SAY_SECONDS

    def admits(self, path: str) -> bool:
        """Return whether a request of this path may connect: it is not the script's, or it has the page's token."""
        parts = urlsplit(path)
        if parts.path != PATH:
            return True
        return any(secrets.compare_digest(found, self._token) for found in parse_qs(parts.query).get("token", []))

    def is_own(self, path: str) -> bool:
        """Return whether a connection is the script's."""
        return urlsplit(path).path == PATH

    def insert_script(self, body: bytes, encoding: str | None) -> bytes:
        """Insert the script into viser's page."""
        page = gzip.decompress(body) if encoding == "gzip" else body
        script = files("scenes.live.page").joinpath("page.js").read_text("utf-8")
        tag = f'<script data-token="{self._token}" data-keys="{" ".join(sorted(KEYS))}">{script}</script>'
        page = page.replace(_HEAD, _HEAD + tag.encode(), 1)
        return gzip.compress(page, 6) if encoding == "gzip" else page

    async def serve(self, connection: Any) -> None:
        """Take the messages of one page until it goes; then `poll` has None of it."""
        number = next(self._numbers)
        self._sockets[number] = connection, asyncio.get_running_loop()
        try:
            await connection.send(self._greeting)
            async for text in connection:
                try:
                    self._arrived.put((number, parse_message(text)))
                except RequestError as error:
                    self.dropped += 1
                    self._fault = str(error)
        except ConnectionClosed:
            pass
        finally:
            self._sockets.pop(number, None)
            self._arrived.put((number, None))

    def greet(self, help_rows: list[tuple[str, str]], *, dark: bool) -> None:
        """Give all pages, and those to come, the list of keys and the theme."""
        self._greeting = json.dumps({"help": help_rows, "dark": dark})
        for connection, loop in list(self._sockets.values()):
            asyncio.run_coroutine_threadsafe(_send(connection, self._greeting), loop)

    def poll(self) -> list[tuple[int, PageMessage | None]]:
        """Return what came since the last time: the page's number and the message, None where the page is gone."""
        found = []
        while not self._arrived.empty():
            found.append(self._arrived.get())
        return found

    def report(self, now: float, tell: Callable[[str], None]) -> None:
        """Say once a minute how many messages were dropped, if any; `now` is a value of time.perf_counter."""
        if self.dropped > self._said and now - self._said_at >= _SAY_SECONDS:
            tell(f"{self.dropped - self._said} messages of a page were dropped: {self._fault}")
            self._said, self._said_at = self.dropped, now


async def _send(connection: Any, text: str) -> None:
    with suppress(ConnectionClosed):
        await connection.send(text)
