"""The live show: characters, controls and drawings together, and the loop that keeps them moving."""

import io
import math
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
import viser

from mapctl.body import colours
from mapctl.errors import MapctlError
from mapctl.features import PRIOR_FPS
from mapctl.steering import Command
from mapctl.streaming import Delivered, LiveCharacter
from scenes.live import ground
from scenes.live.gauges import Gauges
from scenes.live.panel import Orders, Panel
from scenes.live.puppet import Puppet
from scenes.live.recording import Recording, as_file

HOST = "127.0.0.1"
"""Nobody but this machine can connect."""
_TICK = 1 / 60
_GAUGES_EVERY = 15  # ticks
_WORLD = "/world"


@dataclass
class _Member:
    """One character on the stage."""

    character: LiveCharacter
    puppet: Puppet
    marks: ground.Marks
    orders: Orders
    first: Orders
    waiting: deque[tuple[float, Delivered, int]] = field(default_factory=deque)
    place: np.ndarray = field(default_factory=lambda: np.zeros(2))
    recording: Recording | None = None


class Show:
    """A Deck. Everything but the loop itself runs when the loop gets to it, on one thread."""

    def __init__(
        self, characters: Sequence[LiveCharacter], orders: Sequence[Orders], *, port: int, fastest: float,
        labels: Mapping[str, Sequence[str]],
    ):  # fmt: skip
        """Open the page. `fastest` ends the speed slider, m/s; `labels` are the prior's, by group."""
        with redirect_stdout(io.StringIO()):  # viser greets in a box of its own
            self.server = viser.ViserServer(host=HOST, port=port, label="mapctl live", verbose=False)
        scene, gui = self.server.scene, self.server.gui
        scene.set_up_direction("+y")
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        self.server.initial_camera.position = (2.2, 1.9, 4.2)
        self.server.initial_camera.look_at = (0.0, 0.85, 0.0)
        self._world = scene.add_frame(_WORLD, show_axes=False)
        ground.add_grid(scene, f"{_WORLD}/grid")
        self._path = ground.DrawnPath(scene, f"{_WORLD}/path")
        self._members = [self._member(k, *pair) for k, pair in enumerate(zip(characters, orders, strict=True))]
        self._chosen, self._is_paused = 0, False
        self._todo: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._panel = Panel(gui, self, characters=len(characters), fastest=fastest, labels=labels)
        self._panel.show(self._members[0].orders)
        self._gauges = Gauges(gui)
        scene.on_click()(self._clicked)

    @property
    def url(self) -> str:
        """Where the page is. The port is another than asked for if that one was taken."""
        return f"http://{HOST}:{self.server.get_port()}"

    def run(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Until `stop()` says so or Ctrl-C. MapctlError if a character is no more."""
        for tick in range(2**62):
            if stop():
                return
            began = time.perf_counter()
            while not self._todo.empty():
                self._todo.get()()
            with self.server.atomic():
                self._show_due(began)
            if tick % _GAUGES_EVERY == 0:
                self._gauges.show()
            time.sleep(max(0.0, _TICK - (time.perf_counter() - began)))

    def close(self) -> None:
        """End characters and page."""
        for member in self._members:
            member.character.close()
        self.server.stop()

    def order(self, **changes: Any) -> None:
        """See Deck."""
        self._soon(lambda: self._order(changes))

    def choose(self, character: int) -> None:
        """See Deck."""

        def chosen() -> None:
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
                member.character.pause(self._is_paused)

        self._soon(toggled)

    def reset(self) -> None:
        """See Deck."""

        def begun_anew() -> None:
            for member in self._members:
                member.waiting.clear()
                member.orders = replace(member.first)
                self._command(member)
                member.character.reset()
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
                self._notify("No path to walk", str(error))

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
                ending = str(self._panel.ending.value)
                threading.Thread(target=self._hand_out, args=(recording, ending, client), daemon=True).start()
            self._label_recording()

        self._soon(toggled)

    @property
    def _member_chosen(self) -> _Member:
        return self._members[self._chosen]

    def _member(self, number: int, character: LiveCharacter, orders: Orders) -> _Member:
        scene, name = self.server.scene, f"{_WORLD}/character{number + 1}"
        puppet = Puppet(scene, name, character.skeleton, colours.default(number))
        marks = ground.Marks(scene, f"{_WORLD}/marks{number + 1}", character.skeleton)
        return _Member(character, puppet, marks, orders, replace(orders))

    def _soon(self, action: Callable[[], None]) -> None:
        """Browsers speak on threads of their own; what they ask for waits for the loop."""
        self._todo.put(action)

    def _order(self, changes: Mapping[str, Any]) -> None:
        member = self._member_chosen
        member.orders = replace(member.orders, **changes)
        self._panel.show(member.orders)
        self._command(member)

    def _command(self, member: _Member) -> None:
        orders = member.orders
        facing = None if orders.facing is None else math.radians(orders.facing)
        member.character.command(Command(orders.speed, math.radians(orders.heading), facing,
                                         step_length=orders.step_length, told=tuple(orders.told.values())))  # fmt: skip

    def _show_due(self, now: float) -> None:
        for member in self._members:
            for delivered in member.character.poll():
                self._take(member, delivered)
            due = None
            while member.waiting and member.waiting[0][0] <= now:
                due = member.waiting.popleft()
            if due is not None and not self._is_paused:
                self._pose(member, *due[1:])
        if self._panel.follow.value:
            x, z = self._member_chosen.place
            self._world.position = (-x, 0.0, -z)  # the world goes past the camera, which stays the viewer's own
        else:
            self._world.position = (0.0, 0.0, 0.0)

    def _take(self, member: _Member, delivered: Delivered) -> None:
        member.waiting.extend((delivered.due + k / PRIOR_FPS, delivered, k) for k in range(len(delivered.root)))
        member.marks.forecast(delivered.forecast)
        if member.recording is not None:
            member.recording.add(delivered)
        if member is self._member_chosen:
            self._gauges.add(delivered, PRIOR_FPS)

    def _pose(self, member: _Member, delivered: Delivered, frame: int) -> None:
        member.puppet.pose(delivered.root[frame], delivered.quats[frame])
        member.place = delivered.root[frame, ::2]
        joints = delivered.motion(member.character.skeleton).joint_positions()[frame].numpy()
        member.marks.planted(joints, delivered.contacts[frame])

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)

        def added() -> None:
            shift = np.asarray(self._world.position)
            if self._panel.draw.value and (place := ground.on_the_ground(origin - shift, direction)) is not None:
                self._path.add(*place)

        self._soon(added)

    def _label_recording(self) -> None:
        self._panel.record.label = "Record" if self._member_chosen.recording is None else "Stop and save"

    def _hand_out(self, recording: Recording, ending: str, client: viser.ClientHandle | None) -> None:
        torch.set_num_threads(1)
        try:
            content = as_file(recording.motion(), ending)
        except MapctlError as error:
            self._notify("Nothing saved", str(error))
            return
        receiver = self.server if client is None else client
        receiver.send_file_download(f"mapctl.{ending}", content, save_immediately=True)

    def _notify(self, title: str, body: str) -> None:
        for client in self.server.get_clients().values():
            client.add_notification(title, body, auto_close_seconds=6.0)
