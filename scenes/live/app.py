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

from mapctl.errors import MapctlError, RequestError
from scenes.live.camera import WorldView
from scenes.live.character import CharacterLook, ShownCharacter
from scenes.live.inputs import HELP, KEYS, UNCONDITIONED, Driving
from scenes.live.page import HOST, PageChannel, open_server
from scenes.live.panel import Panel
from scenes.live.paths import PathEditor, write_csv
from scenes.live.recording import FORMATS, Recorder, Timeline, encode_motion, join_chunks, write_new
from scenes.live.remote import RemoteCommands
from scenes.live.targets import LiveTargets

if TYPE_CHECKING:  # python-osc may not be installed
    from controllers.steering.process import CharacterProcess
    from mapctl.streaming.receiver import OscReceiver
    from mapctl.streaming.sender import PoseStream

_TICK = 1 / 60
_HOUSEKEEPING_TICKS = 15
_REPEAT_SECONDS = 10.0  # before the same note is shown again
_NOTE_SECONDS = 8.0  # for which a note is shown
_DEFAULT_SPEED = 1.2  # m/s of a path for a character that stands


class LiveApp:
    """The live viewer. What users do is queued and runs on the loop's thread; an error there is shown in the page and
    on the console, and ends nothing else. Methods are for that thread, but for `enqueue`.
    """

    def __init__(
        self,
        characters: "Sequence[CharacterProcess]",
        look: CharacterLook,
        *,
        port: int,
        fastest: float,
        labels: Mapping[str, Sequence[str]],
        stream: "PoseStream | None" = None,
        source: "OscReceiver | None" = None,
    ):
        """Open the page. `look` is that of all characters; `fastest` is the prior's speed, m/s, and `labels` are its
        gaits and styles, by group.

        Frames also go to `stream`, and commands also come from `source`; the caller closes these.
        """
        self._channel, self._stream = PageChannel(KEYS, HELP), stream
        self.server = open_server(port, self._channel)
        self.fastest, self.labels = math.floor(10 * fastest) / 10, labels
        self.is_paused = False
        self._paused_at = self._began = 0.0
        self._queue: queue.SimpleQueue[Callable[[], Any]] = queue.SimpleQueue()
        self._noted: dict[str, float] = {}
        scene = self.server.scene
        self.view = WorldView(self.server, characters=len(characters))
        self.characters = [ShownCharacter(scene, number, one, look) for number, one in enumerate(characters)]
        self.chosen = self.characters[0]
        self.targets = LiveTargets(self)
        self.path = PathEditor(self)
        self.recorder = Recorder(self.server, self.notify)
        self.timeline = Timeline(self.characters, self._set_paused)
        self.panel = Panel(self.server.gui, self, characters=len(characters))
        self.panel.show_command(self.chosen.wanted)
        self.driving = Driving(self)
        self._lock: float | None = None
        self._remote = None if source is None else RemoteCommands(source, self)
        scene.on_click()(lambda event: self.enqueue(lambda: self.click(event.ray_origin, event.ray_direction)))
        self.server.on_client_connect(lambda client: self.enqueue(lambda: self.show_all([client])))

    @property
    def url(self) -> str:
        """Address of the page; the port is another than requested if that one was taken."""
        return f"http://{HOST}:{self.server.get_port()}"

    def run(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Run until `stop()` is true or Ctrl-C."""
        self._began, ticks = time.perf_counter(), 0
        while not stop():
            now = time.perf_counter()
            while not self._queue.empty():
                self._run_safely(self._queue.get())
            with self.server.atomic():
                self._run_safely(lambda now=now: self._step(now))
            if ticks % _HOUSEKEEPING_TICKS == 0:
                self._run_safely(lambda: self.panel.show_state(self.chosen, self.timeline))
            ticks += 1
            time.sleep(max(0.0, _TICK - (time.perf_counter() - now)))

    def enqueue(self, action: Callable[[], Any]) -> None:
        """Run an action on the loop's thread; from any thread."""
        self._queue.put(action)

    def notify(self, title: str, text: str) -> None:
        """Show a note in every browser and on the console; the same once in a while only."""
        now, text = time.perf_counter(), " ".join(text.split())
        self._noted = {note: at for note, at in self._noted.items() if now - at < _REPEAT_SECONDS}
        if self._noted.setdefault(f"{title} {text}", now) != now:
            return
        self.print(f"{title}: {text}")
        for client in list(self.server.get_clients().values()):
            with suppress(Exception):  # it may have gone just now
                client.add_notification(title, text, auto_close_seconds=_NOTE_SECONDS)

    def print(self, text: str) -> None:
        """Print a line on the console."""
        print(f"mapctl: {text}", file=sys.stderr, flush=True)

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
        """End characters and page; a file that is being written is finished first."""
        self.recorder.wait()
        for character in self.characters:
            character.character.close()
        with redirect_stdout(StringIO()):
            self.server.stop()

    # Steering

    def change(self, character: ShownCharacter, **changes: Any) -> list[str]:
        """Change fields of a character's command, within what the prior can do, and have it obey; it leaves its path.
        Returns a sentence for each value that was limited; RequestError for values that are none."""
        notes = self._obey(character, changes)
        self._show_command(character)
        return notes

    def change_from_panel(self, **changes: Any) -> None:
        """Change the chosen character's command from a control, which may still be typed into and keeps its text."""
        for note in self._obey(self.chosen, changes):
            self.notify("Limited", note)
        if "speed" in changes and self.chosen.wanted.speed > 0:
            self.driving.walk_speed = self.chosen.wanted.speed

    def label(self, character: ShownCharacter, group: str, label: str) -> None:
        """Have a character move in a gait or style, as the group may be; UNCONDITIONED leaves it to the prior."""
        if label not in (UNCONDITIONED, *self.labels[group]):
            raise RequestError(f"{label!r} is not a {group} of this prior")
        others = tuple(one for one in character.wanted.labels if not one.startswith(f"{group}="))
        self.change(character, labels=others if label == UNCONDITIONED else (*others, f"{group}={label}"))

    def aim(self, character: ShownCharacter, **changes: Any) -> None:
        """Have a character reach for other targets (`reach`) or look at another (`look_at`)."""
        character.aim(replace(character.wanted, **changes))
        self._show_command(character)

    def choose(self, number: int) -> None:
        """Choose the character, from 0, whose command is shown and changed from now on."""
        self.chosen = self.characters[number]
        self.view.chase.switch(self.chosen.position)
        self._show_command(self.chosen)

    def set_paused(self, paused: bool) -> None:
        """Stop all characters, or let them go on, which shows the present."""
        if not paused:
            self.timeline.return_to_present()
        self._set_paused(paused)

    def restart(self) -> None:
        """Restart all characters with their first command."""
        self.timeline.return_to_present()
        for number, character in enumerate(self.characters):
            self._run_safely(lambda one=character: one.reset())
            if self._stream is not None:
                self._stream.forget(number)
        self._show_command(self.chosen)

    def walk_path(self) -> None:
        """Have the chosen character walk along the path. RequestError where its points make none."""
        path, speed = self.path, self.chosen.wanted.speed or _DEFAULT_SPEED
        self.chosen.character.walk(list(path.points), speed, closed=path.is_closed)

    def click(self, ray_origin: Any, ray_direction: Any) -> None:
        """Send the chosen character where a click meets the ground, or add a point to the path there."""
        point, journey = self.view.find_ground(ray_origin, ray_direction), self.panel.read_journey()
        if point is None:
            return
        if journey is not None:
            within, facing, stands = journey
            if stands:
                self.change(self.chosen, speed=0.0)
            self.targets.go(self.chosen, point, within, facing)
        elif self.panel.draw.value is True:
            self.path.add(point)

    def download_path(self, client: viser.ClientHandle | None) -> None:
        """Give a browser the path as a CSV file."""
        curve = self.path.curve
        if curve is None:
            raise RequestError("a path needs 2 points or more")
        if client is not None:
            client.send_file_download("mapctl-path.csv", write_csv(curve), save_immediately=True)

    def show_all(self, clients: list[viser.ClientHandle] | None = None) -> None:
        """Bring all characters into the view of these browsers, of all by default."""
        self.view.show_all(np.array([character.position for character in self.characters]), clients)

    # The loop's own

    def _step(self, now: float) -> None:
        for page, state in self._channel.poll():
            self.driving.update(page, state)
        self.driving.step(now)
        if self._remote is not None:
            self._remote.obey()
        for number, character in enumerate(self.characters):
            self._run_safely(lambda one=character, k=number: self._receive(one, k))
            if not self.is_paused:
                self._run_safely(lambda one=character: one.show_due(now))
        self.timeline.step(now)
        self.view.step(now, self.chosen.position, self.chosen.facing)

    def _receive(self, character: ShownCharacter, number: int) -> None:
        try:
            chunks = character.receive()
        except MapctlError as error:
            self.notify(character.name, f"it has ended: {error}. Reset restarts it")
            return
        for chunk in chunks:
            if self._stream is not None and chunk.due >= self._began:  # what was due before could only come late
                self._stream.put(number, chunk)
            for note in chunk.notes:
                self.notify(character.name, note)

    def _obey(self, character: ShownCharacter, changes: Mapping[str, Any]) -> list[str]:
        command, notes = replace(character.wanted, **changes).within(self.fastest)
        character.command(command)
        return notes

    def _show_command(self, character: ShownCharacter) -> None:
        if character is self.chosen:
            self.panel.show_command(character.wanted)
            self.targets.show()

    def show_path(self, text: str) -> None:
        """Show a line on the path, and whether it is closed."""
        self.panel.closed.value = self.path.is_closed
        self.panel.path.content = text

    def _set_paused(self, paused: bool) -> None:
        if paused == self.is_paused:
            return
        now, self.is_paused = time.perf_counter(), paused
        self.panel.paused.label = "Resume" if paused else "Pause"
        seconds, self._paused_at = 0.0 if paused else now - self._paused_at, now
        for character in self.characters:
            self._run_safely(lambda one=character: one.pause(paused, seconds))

    def steer(self, speed: float, heading: float | None, facing: float | None) -> None:
        """Steer the chosen character at a speed, m/s; headings in radians, None keeps or frees them."""
        heading = self.chosen.wanted.heading if heading is None else heading
        self.change(self.chosen, speed=speed, heading=heading, facing=facing)

    def find_lock(self) -> float | None:
        """Return the locked facing of the chosen character, radians: toward its target where there is one."""
        target, position = self.targets.point, self.chosen.position
        if self._lock is None or target is None:
            return self._lock
        return math.atan2(target[0] - position[0], target[2] - position[1])

    def _toggle_lock(self) -> None:
        self._lock = self.view.find_heading((0.0, 1.0), None) if self._lock is None else None
        self.change(self.chosen, facing=self.find_lock())

    def act(self, key: str) -> None:
        """Do what a key of ACTIONS does."""
        actions: dict[str, Callable[[], Any]] = {
            "KeyX": lambda: self.change(self.chosen, speed=0.0),
            "KeyL": self._toggle_lock,
            "KeyP": lambda: self.set_paused(not self.is_paused),
            "KeyR": self.restart,
            "KeyN": lambda: self.choose((self.characters.index(self.chosen) + 1) % len(self.characters)),
        }
        if key in actions:  # the list of keys is the page's own
            self._run_safely(actions[key])

    def _run_safely(self, action: Callable[[], Any]) -> None:
        """Run an action; report whatever goes wrong, and go on."""
        try:
            action()
        except MapctlError as error:
            self.notify("Not done", str(error))
        except Exception as error:
            self.notify("Something went wrong", f"{type(error).__name__}: {error}"[:200])
