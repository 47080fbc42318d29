"""Whether anybody looks at the page: without, what moves for the page alone may rest."""

from collections.abc import Callable

import viser

_AWAY_SECONDS = 2.0  # without a browser before nobody is looking: longer than a page takes that is loaded again


class Watchers:
    """The browsers that show the page."""

    def __init__(self, server: viser.ViserServer, wake: Callable[[], None]):
        """`wake` is called, on a thread of the server's, when a browser comes."""
        self._server = server
        self._since: float | None = None
        server.on_client_connect(lambda client: wake())

    def are_away(self, now: float) -> bool:
        """Return whether there has been no browser for two seconds; `now` is a value of time.perf_counter."""
        if self._server.get_clients():
            self._since = None
        elif self._since is None:
            self._since = now
        return self._since is not None and now - self._since > _AWAY_SECONDS
