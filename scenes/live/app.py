"""The live show: characters, controls and drawings together, and the loop that keeps them moving."""

import io
import math
import queue
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stdout, suppress
from pathlib import Path
from typing import Any

import viser

from mapctl.curves.obstacles import Obstacle
from mapctl.errors import MapctlError
from mapctl.motion import Motion
from mapctl.runtime.live_protocol import LiveCharacter
from mapctl.streaming.protocols import FrameStream, MessageSource
from scenes.drawn_character import DrawnCharacter
from scenes.live import ground
from scenes.live.access import ServerErrorReporter, restrict_to_own_pages
from scenes.live.actor import LiveActor
from scenes.live.cast import Cast, make_members
from scenes.live.export.recorder import Recorder
from scenes.live.going import GoThere
from scenes.live.inputs import InputLimits, Refusal, SteeringInputs
from scenes.live.notifications import Notifications
from scenes.live.page.channel import PageChannel
from scenes.live.panel.controls import ControlPanel
from scenes.live.panel.layout import PanelLayout, Tab
from scenes.live.panel.sigmas import SigmaControls
from scenes.live.paths.editor import PathEditor
from scenes.live.paths.handles import Ray
from scenes.live.readouts import Readouts
from scenes.live.recording import FORMATS, RecordingDelivery, encode_with_fallback, save_without_replacing
from scenes.live.remote.orders import RemoteOrders
from scenes.live.target_orders import LiveTargets
from scenes.live.timeline.controls import TimelineControls
from scenes.live.timeline.timeline import Timeline
from scenes.live.view.themes import THEMES
from scenes.live.view.watching import Watchers
from scenes.live.viewing import Viewing

HOST = "127.0.0.1"
"""Nobody but this machine can connect."""
_TICK = 1 / 60
_REST_SECONDS = 1.0  # after which a loop that rests looks about
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
        rigs: Sequence[Callable[[Motion], Motion] | None] = (),
        theme: str = THEMES[0],
        rests: bool = False,
        recordings: Path | None = None,
        licence: str = "",
    ):
        """Open the page. `fastest` is the prior's, m/s; `labels` are the prior's, by group.

        Frames also go to `stream`, and orders also come from `source`; whoever made these closes them. `drawn` are the
        meshes by character; where there is none a mannequin is shown. `rigs` put a character's motion on the joints on
        which it is recorded, where these are not the drawn character's. `theme` is one of THEMES. With `rests`
        everybody stops while no browser shows them, nothing is recorded, and there is neither `stream` nor `source`.
        Recordings, under the `licence`, grow in the folder `recordings`, where there is one, and survive a crash there.
        """
        channel = PageChannel()
        self.server = _open_server(port, channel)
        self._bounds = InputLimits(math.floor(10 * fastest) / 10, labels)
        scene, gui = self.server.scene, self.server.gui
        self._layout = PanelLayout(gui)
        self._notices = Notifications(self.server)
        self._quiet = ServerErrorReporter(self.server.get_event_loop(), self._notices.console)
        scene.set_up_direction("+y")
        members = make_members(scene, _WORLD, characters, orders, drawn=drawn, rigs=rigs, licence=licence)
        self._todo: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._typed_at: float | None = None
        self._gauges = Readouts(gui)
        self._cast = Cast(members, self._notices, self._gauges, stream)
        self.targets = LiveTargets(scene, _WORLD, members, lambda: self._cast.chosen, self.enqueue)
        self._view = Viewing(
            self.server,
            _WORLD,
            self,
            self._cast,
            channel,
            self._notices,
            fastest=self._bounds.fastest,
            theme=theme,
            enqueue=self.enqueue,
        )
        self.path = PathEditor(scene, _WORLD, locate=self._find_ground, enqueue=self.enqueue)
        self._recorder = Recorder(lambda: self._cast.chosen, RecordingDelivery(self.server, self._notices), recordings)
        self._panel = self._build_panel(gui, len(characters), theme)
        self._view.attach(self._panel.viewing)
        self._panel.show(members[0].orders)
        self._timeline = Timeline(members, self.set_paused)
        with self._layout.open(Tab.PLAY):
            self._times = TimelineControls(gui, self)
        self._remote = None if source is None else RemoteOrders(source, self, members, groups=list(labels))
        with self._layout.open(Tab.PATH):
            self._going = GoThere(gui, scene, _WORLD)
        with self._layout.open(Tab.TERMS):
            self._sigmas = SigmaControls(gui, members, lambda: self._cast.chosen, self.enqueue)
            self._gauges.add_plots()
        self._watchers = Watchers(self.server, wake=lambda: self.enqueue(lambda: None))
        self._may_rest = rests and stream is None and source is None
        scene.on_click()(lambda event: self._draw_at(event.ray_origin, event.ray_direction))

    def _build_panel(self, gui: viser.GuiApi, characters: int, theme: str) -> ControlPanel:
        return ControlPanel(
            gui,
            self._layout,
            self,
            self.targets,
            self._view,
            self.path,
            self,
            characters=characters,
            bounds=self._bounds,
            below=self._notices.below,
            mode=self._view.mode,
            theme=theme,
        )

    @property
    def url(self) -> str:
        """Where the page is. The port is another than asked for if that one was taken."""
        return f"http://{HOST}:{self.server.get_port()}"

    def run(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Run until `stop()` is true or Ctrl-C."""
        self._cast.begin(time.perf_counter())
        for tick in range(2**62):
            if stop():
                return
            began = time.perf_counter()
            while not self._todo.empty():
                self._notices.run_safely(self._todo.get())
            if self._remote is not None:
                self._notices.run_safely(self._remote.obey)
            self._cast.rest(self._may_rest and self._watchers.are_away(began) and not self._cast.is_recorded)
            with self.server.atomic():
                self._notices.run_safely(lambda now=began: self._show_due(now))
            if tick % _READOUT_TICKS == 0 or self._cast.rests:
                self._notices.run_safely(lambda now=began: self._run_housekeeping(now))
            self._wait(_TICK - (time.perf_counter() - began))

    def _wait(self, seconds: float) -> None:
        """Wait for the next moment at which something is to be done: where everybody rests, until somebody asks."""
        if not self._cast.rests:
            time.sleep(max(0.0, seconds))
            return
        with suppress(queue.Empty):
            self._notices.run_safely(self._todo.get(timeout=_REST_SECONDS))

    def save_recordings(self, folder: Path) -> list[Path]:
        """Write what is being recorded, as BVH files that replace none."""
        pending = [member.recording for member in self._cast.members if member.recording and member.recording.frames]
        for member in self._cast.members:
            member.recording = None
        saved = []
        for recording in pending:
            made = encode_with_fallback(recording.motion(), FORMATS[0], recording.drawn)
            saved.append(save_without_replacing(made, folder))
            recording.discard()
        return saved

    def close(self) -> None:
        """End characters and page."""
        self._recorder.close()
        self._cast.close()
        self._quiet.close()
        with redirect_stdout(io.StringIO()):
            self.server.stop()

    def order(self, **changes: Any) -> None:
        """Change the chosen character's orders, and show them; it leaves its path."""

        def ordered() -> None:
            self._apply_order(self._cast.chosen, changes)
            self._panel.show(self._cast.chosen.orders)

        self.enqueue(ordered)

    def typed(self, **changes: Any) -> None:
        """Change orders from a control, which already shows them and may still be typed into."""

        def ordered() -> None:
            self._apply_order(self._cast.chosen, changes)
            if "speed" in changes and self._cast.chosen.orders.speed > 0:
                self._view.driving.walk_speed = self._cast.chosen.orders.speed
            self._panel.enable(self._cast.chosen.orders)
            self._typed_at = time.perf_counter()

        self.enqueue(ordered)

    def nudge(self, **by: float) -> None:
        """Add to the chosen character's speed (m/s) or heading (degrees), as far as it goes."""

        def ordered() -> None:
            orders = self._cast.chosen.orders
            wanted = {name: getattr(orders, name) + step for name, step in by.items()}
            if "speed" in wanted:
                wanted["speed"] = min(self._bounds.fastest, max(0.0, wanted["speed"]))
            if "heading" in wanted:
                wanted["heading"] = math.remainder(wanted["heading"], 360)
            self._apply_order(self._cast.chosen, wanted)
            self._panel.show(self._cast.chosen.orders)

        self.enqueue(ordered)

    def choose(self, character: int) -> None:
        """Choose the character whose orders are shown and changed from now on."""

        def chosen() -> None:
            self._cast.choose(character)
            self._panel.show(self._cast.chosen.orders)
            self.targets.show()
            self._sigmas.show()
            self._label_recording()

        self.enqueue(chosen)

    def toggle_pause(self) -> None:
        """Stop everybody, or go on."""
        self.enqueue(lambda: self.set_paused(not self._cast.is_paused))

    def set_paused(self, paused: bool) -> None:
        """See RemoteStage."""
        self._panel.play.paused.label = "Go on" if paused else "Pause"
        self._cast.set_paused(paused)
        self._timeline.set_paused(paused)

    def reset(self) -> None:
        """Restart all characters."""
        self.enqueue(self.restart)

    def restart(self) -> None:
        """See RemoteStage."""
        self._timeline.return_to_present()
        self._cast.restart(self.targets.obstacles)
        self._panel.show(self._cast.chosen.orders)
        self.targets.show()

    def set_rate(self, rate: float) -> None:
        """See TimelineActions."""

        def slowed() -> None:
            self._timeline.clock.set_rate(rate)
            self._cast.set_rate(rate)

        self.enqueue(slowed)

    def look_back(self, seconds: float) -> None:
        """See TimelineActions."""
        self.enqueue(lambda: self._timeline.look_back(seconds))

    def replay(self) -> None:
        """See TimelineActions."""
        self.enqueue(self._timeline.replay)

    def return_to_present(self) -> None:
        """See TimelineActions."""
        self.enqueue(self._timeline.return_to_present)

    def walk_path(self) -> None:
        """Let the chosen character walk the drawn path."""

        def walked() -> None:
            try:
                self.walk(self._cast.chosen, self.path.path.points, closed=self.path.path.is_closed)
            except MapctlError as error:
                self._notices.event("No path to walk", str(error), console=False)

        self.enqueue(walked)

    def walk(self, member: LiveActor, points: Sequence[tuple[float, float]], *, closed: bool = False) -> None:
        """See RemoteStage."""
        member.character.walk(list(points), member.orders.speed or 1.2, closed=closed)

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
        self._panel.reaching.disc.value = disc is not None

    def toggle_recording(self, client: viser.ClientHandle | None) -> None:
        """Begin to record the chosen character, or end and give that browser the file."""

        def toggled() -> None:
            self._recorder.toggle(self._panel.recording.chosen_ending, client)
            self._label_recording()

        self.enqueue(toggled)

    def save_again(self, client: viser.ClientHandle | None) -> None:
        """See RecordActions."""
        self.enqueue(lambda: self._recorder.save_again(self._panel.recording.chosen_ending, client))

    def cancel_export(self) -> None:
        """See RecordActions."""
        self._recorder.cancel()

    def enqueue(self, action: Callable[[], None]) -> None:
        """Enqueue what a browser asks for on its own thread, for the loop."""
        self._todo.put(action)

    def _show_orders(self, member: LiveActor) -> None:
        if member is self._cast.chosen:
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
        self._timeline.stand(still=self._cast.is_still)
        self._timeline.proceed(now)
        self._cast.show(now, self._timeline.clock.now())
        self._view.step(now)

    def _run_housekeeping(self, now: float) -> None:
        """Do what need not be done every time."""
        self._gauges.show()
        self._times.show(self._timeline)
        self._label_recording()
        self._sigmas.settle(now)
        self._notices.expire_refusal(now)
        if self._remote is not None and (said := self._remote.report(now)) is not None:
            self._notices.console(said)
        if self._typed_at is not None and now - self._typed_at > _TYPING_SECONDS:
            self._typed_at = None
            self._panel.show(self._cast.chosen.orders)
        self._cast.report_pace(now)
        self._view.keep(now)

    def _draw_at(self, ray_origin: Any, ray_direction: Any) -> None:
        """Send the chosen character where a click meets the ground, or add a point to the path there: the ray's origin
        and direction, three numbers each, checked for that."""

        def added() -> None:
            ray = self._view.locate_ray(ground.parse_ray(ray_origin, ray_direction))
            place = ground.intersect_ground(*ray)
            if place is None:
                return
            if self._going.send(self._cast.chosen, place, self.targets.obstacles):
                self._panel.show(self._cast.chosen.orders)
            elif self._panel.path.draw.value:
                self.path.place(*place, ray)

        self.enqueue(added)

    def _find_ground(self, ray: Ray) -> tuple[float, float] | None:
        """Find where a ray meets the ground of the world, x and z in metres."""
        return ground.intersect_ground(*self._view.locate_ray(ground.parse_ray(*ray)))

    def _label_recording(self) -> None:
        self._panel.recording.show(self._recorder)


def _open_server(port: int, channel: PageChannel) -> viser.ViserServer:
    with redirect_stdout(io.StringIO()), restrict_to_own_pages(channel):  # viser greets in a box of its own
        return viser.ViserServer(host=HOST, port=port, label="mapctl live", verbose=False)
