"""The live show: characters, controls and drawings together, and the loop that keeps them moving."""

import io
import math
import queue
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import torch
import viser

from mapctl.errors import MapctlError
from mapctl.features import PRIOR_FPS
from mapctl.runtime.live_protocol import LiveCharacter
from scenes.live import ground
from scenes.live.access import Quiet, one_line, only_own_pages
from scenes.live.actor import Member
from scenes.live.controls import Panel
from scenes.live.inputs import Bounds, Orders
from scenes.live.notifications import Notices
from scenes.live.readouts import Gauges
from scenes.live.recording import FORMATS, Made, Recording, as_some_file, keep

HOST = "127.0.0.1"
"""Nobody but this machine can connect."""
_TICK = 1 / 60
_GAUGES_EVERY = 15  # ticks
_TYPING = 1.0  # seconds after the last key in a field before it is put right
_WORLD = "/world"


class Show:
    """A Deck. Everything but the loop itself runs when the loop gets to it, on one thread; what fails there is said in
    the page and on the console, and ends nothing else.
    """

    def __init__(
        self,
        characters: Sequence[LiveCharacter],
        orders: Sequence[Orders],
        *,
        port: int,
        fastest: float,
        labels: Mapping[str, Sequence[str]],
    ):
        """Open the page. `fastest` is the prior's, m/s; `labels` are the prior's, by group."""
        with redirect_stdout(io.StringIO()), only_own_pages():  # viser greets in a box of its own
            self.server = viser.ViserServer(host=HOST, port=port, label="mapctl live", verbose=False)
        self._bounds = Bounds(math.floor(10 * fastest) / 10, labels)
        scene, gui = self.server.scene, self.server.gui
        self._notices = Notices(self.server)
        self._quiet = Quiet(self.server.get_event_loop(), self._notices.console)
        _set_stage(self.server)
        self._world = scene.add_frame(_WORLD, show_axes=False)
        ground.add_grid(scene, f"{_WORLD}/grid")
        self._path = ground.DrawnPath(scene, f"{_WORLD}/path")
        self._members = [Member(scene, _WORLD, k, *pair) for k, pair in enumerate(zip(characters, orders, strict=True))]
        self._chosen, self._is_paused = 0, False
        self._typed_at: float | None = None
        self._todo: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._panel = Panel(gui, self, characters=len(characters), bounds=self._bounds, below=self._notices.below)
        self._panel.show(self._members[0].orders)
        self._gauges = Gauges(gui)
        scene.on_click()(lambda event: self._draw_at(event.ray_origin, event.ray_direction))

    @property
    def url(self) -> str:
        """Where the page is. The port is another than asked for if that one was taken."""
        return f"http://{HOST}:{self.server.get_port()}"

    def run(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Until `stop()` says so or Ctrl-C."""
        for tick in range(2**62):
            if stop():
                return
            began = time.perf_counter()
            while not self._todo.empty():
                self._try(self._todo.get())
            with self.server.atomic():
                self._try(lambda now=began: self._show_due(now))
            if tick % _GAUGES_EVERY == 0:
                self._try(lambda now=began: self._look_after(now))
            time.sleep(max(0.0, _TICK - (time.perf_counter() - began)))

    def keep_recordings(self, folder: Path) -> list[Path]:
        """Write what is being recorded, as BVH files that replace none."""
        pending = [member.recording for member in self._members if member.recording and member.recording.pieces]
        for member in self._members:
            member.recording = None
        return [keep(as_some_file(recording.motion(), FORMATS[0]), folder) for recording in pending]

    def close(self) -> None:
        """End characters and page."""
        for member in self._members:
            member.character.close()
        self._quiet.close()
        with redirect_stdout(io.StringIO()):
            self.server.stop()

    def order(self, **changes: Any) -> None:
        """See Deck."""

        def ordered() -> None:
            self._order(changes)
            self._panel.show(self._member_chosen.orders)

        self._soon(ordered)

    def typed(self, **changes: Any) -> None:
        """See Deck."""

        def ordered() -> None:
            self._order(changes)
            self._panel.enable(self._member_chosen.orders)
            self._typed_at = time.perf_counter()

        self._soon(ordered)

    def nudge(self, **by: float) -> None:
        """See Deck."""

        def ordered() -> None:
            orders = self._member_chosen.orders
            wanted = {name: getattr(orders, name) + step for name, step in by.items()}
            if "speed" in wanted:
                wanted["speed"] = min(self._bounds.fastest, max(0.0, wanted["speed"]))
            if "heading" in wanted:
                wanted["heading"] = math.remainder(wanted["heading"], 360)
            self._order(wanted)
            self._panel.show(self._member_chosen.orders)

        self._soon(ordered)

    def choose(self, character: int) -> None:
        """See Deck."""

        def chosen() -> None:
            if not 0 <= character < len(self._members):
                raise MapctlError(f"there is no character {character + 1}")
            self._chosen = character
            self._gauges.forget()
            self._panel.show(self._member_chosen.orders)
            self._label_recording()

        self._soon(chosen)

    def toggle_pause(self) -> None:
        """See Deck."""

        def toggled() -> None:
            self._is_paused = not self._is_paused
            self._panel.paused.label = "Go on" if self._is_paused else "Pause"
            for member in self._members:
                member.pace.forget()
                self._try(lambda one=member: one.character.pause(self._is_paused))

        self._soon(toggled)

    def reset(self) -> None:
        """See Deck."""

        def begun_anew() -> None:
            for member in self._members:
                self._notices.state(f"gone {member.name}", None)
                self._try(member.reset)
            self._gauges.forget()
            self._panel.show(self._member_chosen.orders)

        self._soon(begun_anew)

    def walk_path(self) -> None:
        """See Deck."""

        def walked() -> None:
            member = self._member_chosen
            try:
                member.character.walk(list(self._path.points), member.orders.speed or 1.2)
            except MapctlError as error:
                self._notices.event("No path to walk", str(error), console=False)

        self._soon(walked)

    def clear_path(self) -> None:
        """See Deck."""
        self._soon(self._path.clear)

    def toggle_recording(self, client: viser.ClientHandle | None) -> None:
        """See Deck."""

        def toggled() -> None:
            member = self._member_chosen
            if member.recording is None:
                member.recording = Recording(member.character.skeleton)
            else:
                recording, member.recording = member.recording, None
                ending = self._panel.ending.value if self._panel.ending.value in FORMATS else FORMATS[0]
                threading.Thread(target=self._hand_out, args=(recording, ending, client), daemon=True).start()
            self._label_recording()

        self._soon(toggled)

    @property
    def _member_chosen(self) -> Member:
        return self._members[self._chosen]

    def _soon(self, action: Callable[[], None]) -> None:
        """Browsers speak on a thread of their own; what they ask for waits for the loop."""
        self._todo.put(action)

    def _try(self, action: Callable[[], None]) -> None:
        """Whatever goes wrong here is said, and is no reason not to go on."""
        try:
            action()
        except Exception as error:
            self._notices.fault(error)

    def _order(self, changes: Mapping[str, Any]) -> None:
        member = self._member_chosen
        member.orders, refusals = self._bounds.changed(member.orders, changes)
        for name in changes:
            self._notices.held(name, getattr(member.orders, name))
        self._notices.refused(refusals)
        member.command()

    def _show_due(self, now: float) -> None:
        for member in self._members:
            if not member.gone:
                self._try(lambda one=member: self._receive(one, now))
            if not self._is_paused:
                self._try(lambda one=member: one.show_due(now))
        x, z = self._member_chosen.place if self._panel.follow.value else (0.0, 0.0)
        self._world.position = (-x, 0.0, -z)  # the world goes past the camera, which stays the viewer's own

    def _receive(self, member: Member, now: float) -> None:
        try:
            arrived = member.character.poll()
        except MapctlError as error:
            member.gone = str(error)
            said = f"{member.name} is no more: {error}. Reset brings it back; its recording can be saved"
            self._notices.state(f"gone {member.name}", said)
            self._notices.console(said)
            return
        for delivered in arrived:
            member.take(delivered, now)
            for note in delivered.notes:
                self._notices.event(member.name.capitalize(), note)
            if member is self._member_chosen:
                self._gauges.add(delivered, PRIOR_FPS)

    def _look_after(self, now: float) -> None:
        """What need not be done every time."""
        self._gauges.show()
        self._notices.pass_on(now)
        if self._typed_at is not None and now - self._typed_at > _TYPING:
            self._typed_at = None
            self._panel.show(self._member_chosen.orders)
        for member in self._members:
            if not member.gone and not self._is_paused:
                self._watch(member, now)

    def _watch(self, member: Member, now: float) -> None:
        """Say that a character does not keep up, and that it does again."""
        changed, slow = member.pace.judge(now), member.pace.slow
        said = f"{member.name} is too slow for this machine: {member.pace.text(now)}" if slow else None
        if changed or slow:
            self._notices.state(f"slow {member.name}", said)
        if changed:
            self._notices.console(said or f"{member.name} keeps up again")

    def _draw_at(self, ray_origin: Any, ray_direction: Any) -> None:
        """A point of the path where somebody clicked, a ray of two times three numbers if the browser is well."""

        def added() -> None:
            ray = ground.as_ray(ray_origin, ray_direction)
            shift = np.asarray(self._world.position)
            if self._panel.draw.value and (place := ground.on_the_ground(ray[0] - shift, ray[1])) is not None:
                self._path.add(*place)

        self._soon(added)

    def _label_recording(self) -> None:
        self._panel.record.label = "Record" if self._member_chosen.recording is None else "Stop and save"

    def _hand_out(self, recording: Recording, ending: str, client: viser.ClientHandle | None) -> None:
        torch.set_num_threads(1)
        try:
            made = as_some_file(recording.motion(), ending)
            if made.ending != ending:
                self._notices.event(f"No {ending} could be made, here is a {made.ending}", made.why)
            self._send(made, client)
        except Exception as error:
            self._notices.event("Nothing saved", one_line(error))

    def _send(self, made: Made, client: viser.ClientHandle | None) -> None:
        """To the browser that asked; to all others if it is gone; to the current folder if nobody is left."""
        others = self.server.get_clients()
        if client is None or client.client_id not in others:
            if not others:
                return self._notices.console(f"nobody is left to take the recording: {keep(made, Path.cwd())}")
            return self.server.send_file_download(made.name, made.content, save_immediately=True)
        return client.send_file_download(made.name, made.content, save_immediately=True)


def _set_stage(server: viser.ViserServer) -> None:
    """Up, theme and camera."""
    server.scene.set_up_direction("+y")
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
    server.initial_camera.position = (2.2, 1.9, 4.2)
    server.initial_camera.look_at = (0.0, 0.85, 0.0)
