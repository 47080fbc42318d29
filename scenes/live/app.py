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
import viser

from mapctl.curves.obstacles import Obstacle
from mapctl.errors import MapctlError
from mapctl.features import PRIOR_FPS
from mapctl.runtime.live_protocol import LiveCharacter
from mapctl.streaming.protocols import FrameStream, MessageSource
from scenes.drawn_character import DrawnCharacter
from scenes.live import ground
from scenes.live.access import ServerErrorReporter, restrict_to_own_pages
from scenes.live.actor import LiveActor
from scenes.live.controls import ControlPanel
from scenes.live.going import GoThere
from scenes.live.inputs import InputLimits, Refusal, SteeringInputs
from scenes.live.notifications import Notifications
from scenes.live.readouts import Readouts
from scenes.live.recording import FORMATS, Recording, RecordingDelivery, encode_with_fallback, save_without_replacing
from scenes.live.remote.orders import RemoteOrders
from scenes.live.target_orders import LiveTargets

HOST = "127.0.0.1"
"""Nobody but this machine can connect."""
_TICK = 1 / 60
_READOUT_TICKS = 15  # ticks
_TYPING_SECONDS = 1.0  # seconds after the last key in a field before it is put right
_WORLD = "/world"


class LiveApp:
    """The live viewer of one loop. What users do is queued and runs on the loop's thread; an error there is shown in
    the page and on the console, and ends nothing else.
    """

    def __init__(
        self,
        characters: Sequence[LiveCharacter],
        orders: Sequence[SteeringInputs],
        *,
        port: int,
        fastest: float,
        labels: Mapping[str, Sequence[str]],
        stream: FrameStream | None = None,
        source: MessageSource | None = None,
        drawn: Sequence[DrawnCharacter | None] = (),
    ):
        """Open the page. `fastest` is the prior's, m/s; `labels` are the prior's, by group.

        Frames also go to `stream`, and orders also come from `source`; whoever made these closes them. `drawn` are the
        meshes by character; where there is none a mannequin is shown.
        """
        with redirect_stdout(io.StringIO()), restrict_to_own_pages():  # viser greets in a box of its own
            self.server = viser.ViserServer(host=HOST, port=port, label="mapctl live", verbose=False)
        self._bounds = InputLimits(math.floor(10 * fastest) / 10, labels)
        scene, gui = self.server.scene, self.server.gui
        self._notices = Notifications(self.server)
        self._delivery = RecordingDelivery(self.server, self._notices)
        self._quiet = ServerErrorReporter(self.server.get_event_loop(), self._notices.console)
        _set_up_stage(self.server)
        self._world = scene.add_frame(_WORLD, show_axes=False)
        ground.add_grid(scene, f"{_WORLD}/grid")
        self._path = ground.DrawnPath(scene, f"{_WORLD}/path")
        self._members = [
            LiveActor(scene, _WORLD, k, *one)
            for k, one in enumerate(zip(characters, orders, drawn or [None] * len(characters), strict=True))
        ]
        self._chosen, self._is_paused = 0, False
        self._stream, self._began = stream, 0.0
        self._typed_at: float | None = None
        self._todo: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self.targets = LiveTargets(scene, _WORLD, self._members, lambda: self._chosen_member, self._enqueue)
        self._panel = ControlPanel(
            gui, self, self.targets, characters=len(characters), bounds=self._bounds, below=self._notices.below
        )
        self._panel.show(self._members[0].orders)
        self._remote = None if source is None else RemoteOrders(source, self, self._members, groups=list(labels))
        self._going = GoThere(gui, scene, _WORLD)
        self._gauges = Readouts(gui)
        scene.on_click()(lambda event: self._draw_at(event.ray_origin, event.ray_direction))

    @property
    def url(self) -> str:
        """Where the page is. The port is another than asked for if that one was taken."""
        return f"http://{HOST}:{self.server.get_port()}"

    def run(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Run until `stop()` is true or Ctrl-C."""
        self._began = time.perf_counter()  # what was due before is not streamed: it would only come late
        for tick in range(2**62):
            if stop():
                return
            began = time.perf_counter()
            while not self._todo.empty():
                self._run_safely(self._todo.get())
            if self._remote is not None:
                self._run_safely(self._remote.obey)
            with self.server.atomic():
                self._run_safely(lambda now=began: self._show_due(now))
            if tick % _READOUT_TICKS == 0:
                self._run_safely(lambda now=began: self._run_housekeeping(now))
            time.sleep(max(0.0, _TICK - (time.perf_counter() - began)))

    def save_recordings(self, folder: Path) -> list[Path]:
        """Write what is being recorded, as BVH files that replace none."""
        pending = [member.recording for member in self._members if member.recording and member.recording.pieces]
        for member in self._members:
            member.recording = None
        return [
            save_without_replacing(encode_with_fallback(recording.motion(), FORMATS[0], recording.drawn), folder)
            for recording in pending
        ]

    def close(self) -> None:
        """End characters and page."""
        for member in self._members:
            member.character.close()
        self._quiet.close()
        with redirect_stdout(io.StringIO()):
            self.server.stop()

    def order(self, **changes: Any) -> None:
        """Change the chosen character's orders, and show them; it leaves its path."""

        def ordered() -> None:
            self._apply_order(self._chosen_member, changes)
            self._panel.show(self._chosen_member.orders)

        self._enqueue(ordered)

    def typed(self, **changes: Any) -> None:
        """Change orders from a control, which already shows them and may still be typed into."""

        def ordered() -> None:
            self._apply_order(self._chosen_member, changes)
            self._panel.enable(self._chosen_member.orders)
            self._typed_at = time.perf_counter()

        self._enqueue(ordered)

    def nudge(self, **by: float) -> None:
        """Add to the chosen character's speed (m/s) or heading (degrees), as far as it goes."""

        def ordered() -> None:
            orders = self._chosen_member.orders
            wanted = {name: getattr(orders, name) + step for name, step in by.items()}
            if "speed" in wanted:
                wanted["speed"] = min(self._bounds.fastest, max(0.0, wanted["speed"]))
            if "heading" in wanted:
                wanted["heading"] = math.remainder(wanted["heading"], 360)
            self._apply_order(self._chosen_member, wanted)
            self._panel.show(self._chosen_member.orders)

        self._enqueue(ordered)

    def choose(self, character: int) -> None:
        """Choose the character whose orders are shown and changed from now on."""

        def chosen() -> None:
            if not 0 <= character < len(self._members):
                raise MapctlError(f"there is no character {character + 1}")
            self._chosen = character
            self._gauges.forget()
            self._panel.show(self._chosen_member.orders)
            self.targets.show()
            self._label_recording()

        self._enqueue(chosen)

    def toggle_pause(self) -> None:
        """Stop everybody, or go on."""
        self._enqueue(lambda: self.set_paused(not self._is_paused))

    def set_paused(self, paused: bool) -> None:
        """See RemoteStage."""
        self._is_paused = paused
        self._panel.paused.label = "Go on" if paused else "Pause"
        if self._stream is not None:
            self._stream.pause()
        for member in self._members:
            member.pace.forget()
            self._run_safely(lambda one=member: one.character.pause(paused))

    def reset(self) -> None:
        """Restart all characters."""
        self._enqueue(self.restart)

    def restart(self) -> None:
        """See RemoteStage."""
        for number, member in enumerate(self._members):
            self._notices.state(f"gone {member.name}", None)
            self._run_safely(lambda one=member: one.reset(self.targets.obstacles))
            if self._stream is not None:
                self._stream.forget(number)
        self._gauges.forget()
        self._panel.show(self._chosen_member.orders)
        self.targets.show()

    def walk_path(self) -> None:
        """Let the chosen character walk the drawn path."""

        def walked() -> None:
            try:
                self.walk(self._chosen_member, self._path.points)
            except MapctlError as error:
                self._notices.event("No path to walk", str(error), console=False)

        self._enqueue(walked)

    def walk(self, member: LiveActor, points: Sequence[tuple[float, float]]) -> None:
        """See RemoteStage."""
        member.character.walk(list(points), member.orders.speed or 1.2)

    def change(self, member: LiveActor, changes: Mapping[str, Any]) -> list[Refusal]:
        """See RemoteStage."""
        refusals = self._apply_order(member, changes)
        self._show_orders(member)
        return refusals

    def aim(self, member: LiveActor) -> None:
        """See RemoteStage."""
        member.aim(self.targets.obstacles)
        self._show_orders(member)

    def go(self, member: LiveActor, place: tuple[float, float], within: float, facing: float | None) -> None:
        """See RemoteStage."""
        member.go(place, within, facing, self.targets.obstacles, stand=False)
        self._going.mark(place)

    def set_disc(self, disc: Obstacle | None) -> None:
        """See RemoteStage."""
        self.targets.set_disc(disc)
        self._panel.disc.value = disc is not None

    def clear_path(self) -> None:
        """Forget the drawn points."""
        self._enqueue(self._path.clear)

    def toggle_recording(self, client: viser.ClientHandle | None) -> None:
        """Begin to record the chosen character, or end and give that browser the file."""

        def toggled() -> None:
            member = self._chosen_member
            if member.recording is None:
                member.recording = Recording(member.character.skeleton, member.drawn)
            else:
                recording, member.recording = member.recording, None
                ending = self._panel.ending.value if self._panel.ending.value in FORMATS else FORMATS[0]
                threading.Thread(target=self._delivery.export, args=(recording, ending, client), daemon=True).start()
            self._label_recording()

        self._enqueue(toggled)

    @property
    def _chosen_member(self) -> LiveActor:
        return self._members[self._chosen]

    def _enqueue(self, action: Callable[[], None]) -> None:
        """Enqueue what a browser asks for on its own thread, for the loop."""
        self._todo.put(action)

    def _run_safely(self, action: Callable[[], None]) -> None:
        """Run an action; report whatever goes wrong, and go on."""
        try:
            action()
        except Exception as error:
            self._notices.fault(error)

    def _show_orders(self, member: LiveActor) -> None:
        if member is self._chosen_member:
            self._panel.show(member.orders)
            self.targets.show()

    def _apply_order(self, member: LiveActor, changes: Mapping[str, Any]) -> list[Refusal]:
        member.orders, refusals = self._bounds.changed(member.orders, changes)
        for name in changes:
            self._notices.held(name, getattr(member.orders, name))
        self._notices.show_refusals(refusals)
        member.command(self.targets.obstacles)
        return refusals

    def _show_due(self, now: float) -> None:
        for member in self._members:
            if not member.gone:
                self._run_safely(lambda one=member: self._receive(one, now))
            if not self._is_paused:
                self._run_safely(lambda one=member: one.show_due(now))
        x, z = self._chosen_member.place if self._panel.follow.value else (0.0, 0.0)
        self._world.position = (-x, 0.0, -z)  # the world goes past the camera, which stays the viewer's own

    def _receive(self, member: LiveActor, now: float) -> None:
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
            if self._stream is not None and delivered.due >= self._began:
                number = self._members.index(member)
                self._stream.put(number, delivered.due, delivered.seconds, delivered.root, delivered.quats)
            for note in delivered.notes:
                self._notices.event(member.name.capitalize(), note)
            if member is self._chosen_member:
                self._gauges.add(delivered, PRIOR_FPS)

    def _run_housekeeping(self, now: float) -> None:
        """Do what need not be done every time."""
        self._gauges.show()
        self._notices.expire_refusal(now)
        if self._remote is not None and (said := self._remote.report(now)) is not None:
            self._notices.console(said)
        if self._typed_at is not None and now - self._typed_at > _TYPING_SECONDS:
            self._typed_at = None
            self._panel.show(self._chosen_member.orders)
        for member in self._members:
            if not member.gone and not self._is_paused:
                self._report_pace(member, now)

    def _report_pace(self, member: LiveActor, now: float) -> None:
        """Say that a character does not keep up, and that it does again."""
        changed, slow = member.pace.judge(now), member.pace.slow
        said = f"{member.name} is too slow for this machine: {member.pace.text(now)}" if slow else None
        if changed or slow:
            self._notices.state(f"slow {member.name}", said)
        if changed:
            self._notices.console(said or f"{member.name} keeps up again")

    def _draw_at(self, ray_origin: Any, ray_direction: Any) -> None:
        """Send the chosen character where a click meets the ground, or add a point to the path there: the ray's origin
        and direction, three numbers each, checked for that."""

        def added() -> None:
            ray = ground.parse_ray(ray_origin, ray_direction)
            shift = np.asarray(self._world.position)
            place = ground.intersect_ground(ray[0] - shift, ray[1])
            if place is None:
                return
            if self._going.send(self._chosen_member, place, self.targets.obstacles):
                self._panel.show(self._chosen_member.orders)
            elif self._panel.draw.value:
                self._path.add(*place)

        self._enqueue(added)

    def _label_recording(self) -> None:
        self._panel.record.label = "Record" if self._chosen_member.recording is None else "Stop and save"


def _set_up_stage(server: viser.ViserServer) -> None:
    """Set up axis, theme and camera."""
    server.scene.set_up_direction("+y")
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
    server.initial_camera.position = (2.2, 1.9, 4.2)
    server.initial_camera.look_at = (0.0, 0.85, 0.0)
