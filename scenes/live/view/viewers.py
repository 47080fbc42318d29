"""The cameras of all browsers: framed when one comes or changes its size, theirs to move after that."""

import math
from collections.abc import Callable

import numpy as np
import viser

from mapctl.mesh.primitives import Array
from scenes.live.view.chase import turn_about_up
from scenes.live.view.framing import FOV, Box, Framing, frame_characters

_MOVED = 0.02  # metres by which a camera differs from where it was put once its viewer has moved it
_FIRST_SIZE = (1280.0, 760.0)  # pixels, until a browser says


class Viewers:
    """Frames the characters for each browser, and knows where each one looks."""

    def __init__(self, server: viser.ViserServer, find_places: Callable[[], Array]):
        """`find_places` gives where characters are shown, (n, 2), metres; it is asked on the show's own thread."""
        self._server, self._find_places = server, find_places
        self._put: dict[int, Framing] = {}
        self._panels: dict[int, tuple[tuple[float, float], Box | None]] = {}
        self._sizes: dict[int, tuple[int, int]] = {}
        server.initial_camera.fov = FOV
        self._set_first(frame_characters(find_places(), _FIRST_SIZE))
        server.on_client_connect(_mark_page)

    def set_layout(self, viewer: int, size: tuple[float, float], panel: Box | None) -> None:
        """Note where the panel lies over a browser's canvas, and how large that is, pixels."""
        if self._panels.get(viewer) == (size, panel):
            return
        self._panels[viewer] = size, panel
        client = self._server.get_clients().get(viewer)
        if client is not None and not self._is_moved(client):
            self._frame(client)

    def keep(self) -> None:
        """Frame the characters for browsers that came or changed their size; a few times a second is enough."""
        clients = self._server.get_clients()
        for gone in self._sizes.keys() - clients.keys():
            for kept in (self._sizes, self._put, self._panels):
                kept.pop(gone, None)
        for number, client in clients.items():
            size = client.camera.image_width, client.camera.image_height
            if self._sizes.get(number) != size:
                was_moved = number in self._sizes and self._is_moved(client)
                self._sizes[number] = size
                if not was_moved:
                    self._frame(client)

    def frame_all(self) -> None:
        """Bring everybody into every browser's view."""
        for client in self._server.get_clients().values():
            self._frame(client)

    def find_direction(self, direction: tuple[float, float], viewer: int | None) -> Array:
        """Return the direction (3,), as it is shown, of what is to the right and away as a browser's camera sees it;
        as the first camera sees it where the browser is not known."""
        clients = self._server.get_clients()
        client = clients.get(-1 if viewer is None else viewer, next(iter(clients.values()), None))
        camera = self._server.initial_camera if client is None else client.camera
        look = np.asarray(camera.look_at) - np.asarray(camera.position)
        ahead = math.atan2(look[0], look[2])
        right, away = direction
        return turn_about_up(np.array([-right, 0.0, away]), ahead)

    def _frame(self, client: viser.ClientHandle) -> None:
        size: tuple[float, float] = (client.camera.image_width, client.camera.image_height)
        _, panel = self._panels.get(client.client_id, (size, None))
        if min(size) < 50:
            return
        found = frame_characters(self._find_places(), size, panel)
        with client.atomic():
            client.camera.fov = FOV
            client.camera.position = found.position
            client.camera.look_at = found.look_at
        self._put[client.client_id] = found
        self._set_first(found)

    def _set_first(self, found: Framing) -> None:
        """Have viser's own reset of the view come back to this."""
        self._server.initial_camera.position, self._server.initial_camera.look_at = found.position, found.look_at

    def _is_moved(self, client: viser.ClientHandle) -> bool:
        put = self._put.get(client.client_id)
        return put is not None and float(np.abs(client.camera.position - put.position).max()) > _MOVED


async def _mark_page(client: viser.ClientHandle) -> None:
    """Tell the page's own script which client it is."""
    client.gui.add_html(f'<i hidden data-mapctl-viewer="{client.client_id}"></i>', order=-math.inf)
