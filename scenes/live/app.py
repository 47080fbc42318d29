"""The live viewer: characters, page and panel together, and the loop that keeps them moving."""

import math
import queue
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stdout, suppress
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import viser

from mapctl.curves.obstacles import Obstacle
from mapctl.errors import MapctlError, RequestError
from mapctl.runtime.live_protocol import LiveCharacter
from mapctl.streaming.orders import HANDS, Order, keep_latest, read_order
from scenes.live.camera import CameraMode, WorldView
from scenes.live.character import CharacterLook, ShownCharacter
from scenes.live.ground import add_scenery, intersect_ground, parse_ray
from scenes.live.inputs import DISC_RADII, HELP, KEYS, WITHIN, Driving, InputLimits, KeyAction, parse_point
from scenes.live.page import HOST, PageChannel, open_server
from scenes.live.panel import Panel
from scenes.live.paths import PathEditor, Ray, write_csv
from scenes.live.recording import FORMATS, Recorder, Timeline, encode_motion, join_chunks, write_new
from scenes.live.targets import LiveTargets

if TYPE_CHECKING:  # python-osc may not be installed
    from mapctl.streaming.receiver import OscReceiver
    from mapctl.streaming.sender import PoseStream

_TICK = 1 / 60
_HOUSEKEEPING_TICKS = 15
_TYPING_SECONDS = 1.0  # after the last key in a field before it shows what holds
_REPEAT_SECONDS = 10.0  # before the same note is shown again
_NOTE_SECONDS = 8.0  # for which a note is shown
_DEFAULT_SPEED = 1.2  # m/s of a path for a character that stands
_DEFAULT_WITHIN = 2.0  # seconds in which a character is sent to a position, unless the command has a time
_REPORT_SECONDS = 2.0  # between two lines on the console, however many commands of other programs there are
_WORLD = "/world"


class LiveApp:
    """The live viewer. What users do is queued and runs on the loop's thread; an error there is shown in the page and
    on the console, and ends nothing else. Methods are for that thread, but for `enqueue`.
    """

    def __init__(
        self,
        characters: Sequence[LiveCharacter],
        looks: Sequence[CharacterLook],
        *,
        port: int,
        fastest: float,
        labels: Mapping[str, Sequence[str]],
        stream: "PoseStream | None" = None,
        source: "OscReceiver | None" = None,
    ):
        """Open the page. `looks` are by character; `fastest` is the prior's speed, m/s, and `labels` are its, by group.

        Frames also go to `stream`, and commands also come from `source`; the caller closes these.
        """
        channel = PageChannel(KEYS, HELP)
        self.server = open_server(port, channel)
        self.limits = InputLimits(math.floor(10 * fastest) / 10, labels)
        self.is_paused = False
        self._paused_at = 0.0
        self._began = 0.0
        self._queue: queue.SimpleQueue[Callable[[], Any]] = queue.SimpleQueue()
        self._noted: dict[str, float] = {}
        self._typed_at: float | None = None
        self._channel, self._stream = channel, stream
        scene = self.server.scene
        scene.set_up_direction("+y")
        self.view = WorldView(self.server, _WORLD, add_scenery(self.server, _WORLD), characters=len(characters))
        self.characters = [
            ShownCharacter(scene, _WORLD, number, *one)
            for number, one in enumerate(zip(characters, looks, strict=True))
        ]
        self.chosen = self.characters[0]
        self.targets = LiveTargets(scene, _WORLD, self.characters, lambda: self.chosen, self.enqueue)
        self.path = PathEditor(scene, _WORLD, locate=self._find_ground, enqueue=self.enqueue, on_change=self._show_path)
        self.recorder = Recorder(self.server, self.notify)
        self.timeline = Timeline(self.characters, self._set_paused, lambda: self.is_paused)
        self.panel = Panel(self.server.gui, self, characters=len(characters))
        self.panel.show_inputs(self.chosen.inputs)
        outputs = self._drive, self._act, self.view.chase.orbit, self.view.find_heading, self.notify
        self.driving = Driving(*outputs, self.limits.fastest, min(1.2, self.limits.fastest))
        self._remote = None if source is None else RemoteCommands(source, self)
        scene.on_click()(lambda event: self.enqueue(lambda: self.click(event.ray_origin, event.ray_direction)))
        self.server.on_client_connect(lambda client: self.enqueue(lambda: self.show_all([client])))

    @property
    def url(self) -> str:
        """Address of the page; the port is another than asked for if that one was taken."""
        return f"http://{HOST}:{self.server.get_port()}"

    def run(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Run until `stop()` is true or Ctrl-C."""
        self._began = time.perf_counter()
        for tick in range(2**62):
            if stop():
                return
            now = time.perf_counter()
            while not self._queue.empty():
                self._run_safely(self._queue.get())
            with self.server.atomic():
                self._run_safely(lambda now=now: self._step(now))
            if tick % _HOUSEKEEPING_TICKS == 0:
                self._run_safely(lambda now=now: self._run_housekeeping(now))
            time.sleep(max(0.0, _TICK - (time.perf_counter() - now)))

    def enqueue(self, action: Callable[[], Any]) -> None:
        """Run an action on the loop's thread; from any thread."""
        self._queue.put(action)

    def notify(self, title: str, text: str) -> None:
        """Show a note in every browser and on the console; the same once in a while only."""
        now = time.perf_counter()
        self._noted = {note: at for note, at in self._noted.items() if now - at < _REPEAT_SECONDS}
        text = " ".join(text.split())
        if self._noted.setdefault(f"{title} {text}", now) != now:
            return
        self.print(f"{title}: {text}")
        for client in list(self.server.get_clients().values()):
            with suppress(Exception):  # it may have gone just now
                client.add_notification(title, text, auto_close_seconds=_NOTE_SECONDS)

    def save_recordings(self, folder: Path) -> list[Path]:
        """Write what is being recorded, as BVH files that replace none."""
        saved = []
        for character in self.characters:
            chunks, character.recorded = character.recorded, None
            if chunks:
                content = encode_motion(join_chunks(character, chunks), FORMATS[0])
                saved.append(write_new(folder / f"mapctl.{FORMATS[0]}", content))
        return saved

    def close(self) -> None:
        """End characters and page; a file that is being made is finished first."""
        self.recorder.wait()
        for character in self.characters:
            character.character.close()
        with redirect_stdout(StringIO()):
            self.server.stop()

    # Steering

    def change(self, character: ShownCharacter, changes: Mapping[str, Any]) -> list[str]:
        """Change a character's inputs by name, within the limits, and have it obey; it leaves its path. Returns what
        could not be done as it was asked."""
        notes = self._apply(character, changes)
        self._show_inputs(character)
        return notes

    def change_from_panel(self, **changes: Any) -> None:
        """Change the chosen character's inputs from a control, which may still be typed into."""
        self._apply(self.chosen, changes)
        if "speed" in changes and self.chosen.inputs.speed > 0:
            self.driving.walk_speed = self.chosen.inputs.speed
        self.panel.enable(self.chosen.inputs)
        self._typed_at = time.perf_counter()

    def aim(self, character: ShownCharacter) -> None:
        """Have a character reach for and look at its inputs' targets."""
        character.aim(self.targets.obstacles)
        self._show_inputs(character)

    def set_disc(self, disc: Obstacle | None) -> None:
        """Have all characters walk round a disc, or round nothing."""
        self.targets.set_disc(disc)
        self.panel.disc.value = disc is not None

    def choose(self, number: int) -> None:
        """Choose the character, from 0, whose inputs are shown and changed from now on."""
        self.chosen = self.characters[number]
        self.view.chase.switch(self.chosen.position)
        self._show_inputs(self.chosen)

    def set_paused(self, paused: bool) -> None:
        """Stop all characters, or let them go on, which shows the present."""
        if not paused:
            self.timeline.leave()
        self._set_paused(paused)

    def restart(self) -> None:
        """Restart all characters with their first inputs."""
        self.timeline.return_to_present()
        for number, character in enumerate(self.characters):
            self._run_safely(lambda one=character: one.reset(self.targets.obstacles))
            if self._stream is not None:
                self._stream.forget(number)
        self._show_inputs(self.chosen)

    def walk(self, character: ShownCharacter, points: Sequence[tuple[float, float]], *, closed: bool = False) -> None:
        """Have a character walk along points, x and z in metres. RequestError where they make no path."""
        character.character.walk(list(points), character.inputs.speed or _DEFAULT_SPEED, closed=closed)

    def click(self, ray_origin: Any, ray_direction: Any) -> None:
        """Send the chosen character where a click meets the ground, or add a point to the path there."""
        ray = self.view.to_world_ray(parse_ray(ray_origin, ray_direction))
        point, journey = intersect_ground(ray), self.panel.read_journey()
        if point is None:
            return
        if journey is not None:
            within, facing, stands = journey
            if stands:
                self.change(self.chosen, {"speed": 0.0})
            self.targets.go(self.chosen, point, within, None if facing is None else math.radians(facing))
        elif self.panel.draw.value is True:
            self.path.add(*point, ray)

    # Path

    def walk_path(self) -> None:
        """Have the chosen character walk the drawn path."""
        self.walk(self.chosen, self.path.path.points, closed=self.path.path.is_closed)

    def download_path(self, client: viser.ClientHandle | None) -> None:
        """Give a browser the path as a CSV file."""
        curve = self.path.path.curve
        if curve is None:
            raise RequestError("a path needs 2 points or more")
        if client is not None:
            client.send_file_download("mapctl-path.csv", write_csv(curve), save_immediately=True)

    # View

    def set_camera(self, mode: CameraMode) -> None:
        """Have the camera turn with the chosen character, follow it, or stay."""
        self.view.chase.mode = mode

    def show_all(self, clients: list[viser.ClientHandle] | None = None) -> None:
        """Bring all characters into the view of these browsers, of all by default."""
        self.view.show_all(np.array([character.position for character in self.characters]), clients)

    def show_marks(self, visible: bool) -> None:
        """Show or hide arrows and trails."""
        for character in self.characters:
            character.trajectories.show_all(visible)

    # The loop's own

    def _step(self, now: float) -> None:
        for page, state in self._channel.poll():
            self.driving.hear(page, state)
        self.driving.step(now)
        if self._remote is not None:
            self._remote.obey()
        for number, character in enumerate(self.characters):
            self._run_safely(lambda one=character, k=number: self._receive(one, k, now))
            if not self.is_paused:
                self._run_safely(lambda one=character: one.show_due(now))
        self.timeline.step(now)
        self.view.step(now, self.chosen.position, self.chosen.facing)

    def _receive(self, character: ShownCharacter, number: int, now: float) -> None:
        try:
            chunks = character.receive(now)
        except MapctlError as error:
            self.notify(character.name.capitalize(), f"it has ended: {error}. Reset restarts it")
            return
        for chunk in chunks:
            if self._stream is not None and chunk.due >= self._began:  # what was due before could only come late
                self._stream.put(number, chunk.due, chunk.seconds, chunk.root, chunk.quats)
            for note in chunk.notes:
                self.notify(character.name.capitalize(), note)

    def _run_housekeeping(self, now: float) -> None:
        self.panel.show_state(self.chosen, self.recorder, self.timeline)
        if self._typed_at is not None and now - self._typed_at > _TYPING_SECONDS:
            self._typed_at = None
            self.panel.show_inputs(self.chosen.inputs)

    def _apply(self, character: ShownCharacter, changes: Mapping[str, Any]) -> list[str]:
        character.inputs, notes = self.limits.change(character.inputs, changes)
        self.panel.show_refusal(notes)
        character.command(self.targets.obstacles)
        return notes

    def _show_inputs(self, character: ShownCharacter) -> None:
        if character is self.chosen:
            self.panel.show_inputs(character.inputs)
            self.targets.show()

    def _show_path(self, note: str) -> None:
        self.panel.closed.value = self.path.path.is_closed
        self.panel.path.content = "\n\n".join(filter(None, (self.path.describe(), note)))

    def _set_paused(self, paused: bool) -> None:
        if paused == self.is_paused:
            return
        now, self.is_paused = time.perf_counter(), paused
        self.panel.paused.label = "Resume" if paused else "Pause"
        seconds, self._paused_at = 0.0 if paused else now - self._paused_at, now
        if self._stream is not None:
            self._stream.pause()
        for character in self.characters:
            self._run_safely(lambda one=character: one.pause(paused, seconds))

    def _drive(self, speed: float, heading: float | None) -> None:
        self.change(self.chosen, {"speed": speed} | ({} if heading is None else {"heading": heading}))

    def _act(self, action: KeyAction) -> None:
        inputs, characters = self.chosen.inputs, self.characters
        actions: dict[KeyAction, Callable[[], Any]] = {
            KeyAction.STAND: lambda: self.change(self.chosen, {"speed": 0.0}),
            KeyAction.TURN_AROUND: lambda: self.change(self.chosen, {"heading": inputs.heading + 180.0}),
            KeyAction.PAUSE: lambda: self.set_paused(not self.is_paused),
            KeyAction.RESET: self.restart,
            KeyAction.WALK_PATH: self.walk_path,
            KeyAction.CAMERA: self._take_next_camera,
            KeyAction.SHOW_ALL: self.show_all,
            KeyAction.NEXT: lambda: self.choose((characters.index(self.chosen) + 1) % len(characters)),
            KeyAction.HELP: lambda: None,  # the page's own
        }
        self._run_safely(actions[action])

    def _take_next_camera(self) -> None:
        self.panel.camera.value = self.view.next_mode().value

    def _find_ground(self, ray: Ray) -> tuple[float, float] | None:
        """Find where a ray as a browser sent it meets the ground of the world, x and z in metres."""
        return intersect_ground(self.view.to_world_ray(parse_ray(*ray)))

    def _run_safely(self, action: Callable[[], Any]) -> None:
        """Run an action; report whatever goes wrong, and go on."""
        try:
            action()
        except MapctlError as error:
            self.notify("Not done", str(error))
        except Exception as error:
            self.notify("Something went wrong", f"{type(error).__name__}: {error}"[:200])

    def print(self, text: str) -> None:
        """Print a line on the console."""
        print(f"mapctl: {text}", file=sys.stderr, flush=True)


class RemoteCommands:
    """Reads what other programs send, and has it obeyed: of several commands of a kind the last that came."""

    def __init__(self, source: "OscReceiver", app: "LiveApp"):
        self._source, self._app = source, app
        self._noted_at, self._dropped = -math.inf, 0

    def obey(self) -> None:
        """Obey what came since the last call."""
        notes = list[str]()
        for character, orders in self._read(notes):
            changes: dict[str, Any] = {}
            for order in orders:
                try:
                    if order.name in HANDS or order.name == "look":
                        self._aim(character, order)
                    elif (act := self._actions().get(order.name)) is not None:
                        act(character, order)
                    elif order.word is not None:
                        changes["labels"] = {**changes.get("labels", {}), order.name: order.word}
                    elif order.name == "stop":
                        changes["speed"] = 0.0
                    else:
                        changes[order.name] = _read_number(order)
                except MapctlError as error:
                    notes.append(str(error))
            if changes:
                notes += self._app.change(character, changes)
        self._report(notes)

    def _read(self, notes: list[str]) -> list[tuple[ShownCharacter, list[Order]]]:
        """Return the commands by character: what steers first, then where to go, which keeps the new speed."""
        characters, found = self._app.characters, list[Order]()
        for message in self._source.poll():
            try:
                found.append(read_order(message, characters=len(characters), groups=list(self._app.limits.labels)))
            except RequestError as error:
                notes.append(str(error))
        latest = keep_latest(found)
        journeys = [order for order in latest if order.name in ("place", "path")]
        steering = [order for order in latest if order not in journeys]
        return [
            (character, mine)
            for orders in (steering, journeys)
            for number, character in enumerate(characters)
            if (mine := [order for order in orders if order.character == number])
        ]

    def _actions(self) -> dict[str, Callable[[ShownCharacter, Order], None]]:
        app = self._app
        return {
            "reset": lambda character, order: app.restart(),
            "pause": lambda character, order: app.set_paused(_read_number(order) != 0),
            "disc": lambda character, order: app.set_disc(_read_disc(order)),
            "path": lambda character, order: app.walk(character, _read_points(order.numbers)),
            "place": self._go,
        }

    def _aim(self, character: ShownCharacter, order: Order) -> None:
        point = parse_point(order.numbers) if order.numbers else None
        if order.numbers and point is None:
            raise RequestError(f"{order.name}: the position is too far away")
        if order.name == "look":
            character.inputs = replace(character.inputs, look_at=point)
        else:
            reach = {**character.inputs.reach, HANDS[order.name]: point}
            reach = {hand: at for hand, at in reach.items() if at is not None}
            character.inputs = replace(character.inputs, reach=reach)
        self._app.aim(character)

    def _go(self, character: ShownCharacter, order: Order) -> None:
        (position,) = _read_points(order.numbers[:2])
        asked = order.numbers[2] if len(order.numbers) > 2 else _DEFAULT_WITHIN
        facing = math.radians(math.remainder(order.numbers[3], 360)) if len(order.numbers) > 3 else None
        self._app.targets.go(character, position, min(WITHIN[1], max(WITHIN[0], asked)), facing)

    def _report(self, notes: Sequence[str]) -> None:
        """Print one line in two seconds on what could not be obeyed."""
        now, dropped = time.perf_counter(), self._source.dropped - self._dropped
        notes = [*notes, *([self._source.fault] if dropped else [])]
        if notes and now - self._noted_at >= _REPORT_SECONDS:
            self._noted_at, self._dropped = now, self._source.dropped
            more = f" (and {len(notes) - 1} more)" if len(notes) > 1 else ""
            self._app.print(f"OSC: {notes[-1]}{more}")


def _read_number(order: Order) -> float | None:
    """Return the number of a command, of an angle within half a turn either way; None without one."""
    if not order.numbers:
        return None
    return math.remainder(order.numbers[0], 360) if order.name in ("heading", "facing") else order.numbers[0]


def _read_points(numbers: Sequence[float]) -> list[tuple[float, float]]:
    points = list(zip(numbers[::2], numbers[1::2], strict=True))
    if any(parse_point((x, 0.0, z)) is None for x, z in points):
        raise RequestError("the position is too far away")
    return points


def _read_disc(order: Order) -> Obstacle | None:
    if not order.numbers:
        return None
    x, z, radius = order.numbers
    if not DISC_RADII[0] <= radius <= DISC_RADII[1] or parse_point((x, 0.0, z)) is None:
        raise RequestError(f"disc: the radius must be {DISC_RADII[0]:g} to {DISC_RADII[1]:g} m, the position near")
    return Obstacle((x, z), radius)
