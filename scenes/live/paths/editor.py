"""The path that users edit in the live viewer: what is drawn, dragged, pressed, saved and loaded."""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import viser

from mapctl.curves.curve import Curve
from mapctl.errors import MapctlError, RequestError
from mapctl.mesh.primitives import Array
from scenes.live.access import format_error
from scenes.live.paths import files
from scenes.live.paths.handles import PathHandles, Ray, find_ball
from scenes.live.paths.points import PathPoints, Point
from scenes.live.recording import RecordedFile, save_without_replacing

Action = Callable[[], None]
Locate = Callable[[Ray], Point | None]
"""Returns where a ray from a browser meets the ground, x and z in metres; None where it does not."""


class PathEditor:
    """The path of all browsers. Methods without a `_` at their front, but `place`, may be called on any thread: what
    they do happens on the show's own, and what cannot be done is said in a line of the page."""

    def __init__(self, scene: viser.SceneApi, world: str, *, locate: Locate, enqueue: Callable[[Action], None]):
        """Add the path below the node `world`; `enqueue` runs an action on the show's own thread."""
        self._locate, self._enqueue = locate, enqueue
        self.path = PathPoints()
        self.changed: Callable[[str], None] = lambda text: None
        """Hears after a change what there is to say of the path; empty where nothing went wrong."""
        self._handles = PathHandles(
            scene, f"{world}/path", drag=self._drag, drag_between=self._drag_between, click=self._click
        )
        self._waits = False  # whether the path is about to be shown
        self._inserted: int | None = None  # index of the point that became one by the drag that goes on

    def place(self, x: float, z: float, ray: Array | None = None) -> None:
        """Add a point at the end, for the show's own thread; a click's ray (2, 3) that meets a ball selects its point
        instead, since browsers tell of a click on a ball as one on the ground too."""
        hit = None if ray is None else find_ball(self.path.points, ray)
        self._try(lambda: self.path.add(x, z) if hit is None else self.path.select(hit))

    def insert(self) -> None:
        """Insert a point in the middle between the selected one, or the last but one, and the next."""

        def inserted() -> None:
            places = self.path.midpoints()
            if not places:
                raise RequestError("a point is inserted between two: there are fewer")
            after = self.path.selected if self.path.selected is not None else len(places) - 1
            after = min(after, len(places) - 1)
            self.path.insert(after, *places[after])

        self._change(inserted)

    def remove(self) -> None:
        """Remove the selected point."""
        self._change(lambda: self.path.remove(self.path.selected))

    def close(self, closed: bool) -> None:
        """Close the path to a loop, or open it."""
        self._change(lambda: self.path.close(closed is True))

    def clear(self) -> None:
        """Remove all points."""
        self._change(self.path.clear)

    def save(self, client: viser.ClientHandle | None) -> None:
        """Give a browser the path as a CSV file."""

        def saved() -> None:
            content = files.write_csv(self._require_curve())
            if client is not None:
                with suppress(Exception):  # it may have gone just now
                    client.send_file_download(files.NAME, content, save_immediately=True)

        self._change(saved)

    def keep(self, folder: Path | None = None) -> None:
        """Write the path into a folder, by default the one in which the show was started, under a name that replaces
        nothing."""

        def kept() -> str:
            table = RecordedFile("csv", files.write_csv(self._require_curve()), stem=Path(files.NAME).stem)
            try:
                return f"The path is in {save_without_replacing(table, folder or Path.cwd()).name}."
            except OSError as error:
                raise RequestError(f"the path cannot be written: {format_error(error)}") from None

        self._change(kept)

    def load(self, name: str, content: bytes) -> None:
        """Take the path of a file that a browser sent."""

        def loaded() -> str:
            found = files.read_path(name, content)
            self.path.replace(found.points, closed=found.closed)
            return f"{found.note}." if found.note else ""

        self._change(loaded)

    def _require_curve(self) -> Curve:
        curve = self.path.curve
        if curve is None:
            raise RequestError(f"a path needs 2 points or more, and has {len(self.path.points)}")
        return curve

    def _drag(self, index: int, phase: str, ray: Ray) -> None:
        def dragged() -> None:
            if phase != "end" and (place := self._locate(ray)) is not None:
                self.path.move(index, *place)

        self._change(dragged)

    def _drag_between(self, index: int, phase: str, ray: Ray) -> None:
        def dragged() -> None:
            place = self._locate(ray)
            if phase == "start" and place is not None:
                self._inserted = None  # also where the point cannot be
                self.path.insert(index, *place)
                self._inserted = index + 1
            elif phase == "update" and place is not None and self._inserted is not None:
                self.path.move(self._inserted, *place)
            elif phase == "end":
                self._inserted = None

        self._change(dragged)

    def _click(self, index: int, removes: bool) -> None:
        def clicked() -> None:
            if removes:
                self.path.remove(index)
            else:
                self.path.select(index)

        self._change(clicked)

    def _change(self, action: Callable[[], str | None]) -> None:
        self._enqueue(lambda: self._try(action))

    def _try(self, action: Callable[[], str | None]) -> None:
        """Do something to the path, and show it once all that waits with it is done: a drag is many."""
        try:
            self.changed(action() or "")
        except MapctlError as error:
            self.changed(f"⚠️ {error}")
        if not self._waits:
            self._waits = True
            self._enqueue(self._show)

    def _show(self) -> None:
        self._waits = False
        self._handles.show(self.path, keep_between=self._inserted is not None)
