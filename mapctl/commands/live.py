"""`mapctl live`: characters in the browser, steered as they go."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from mapctl.commands.shared import options
from mapctl.commands.shared.threads import use_single_thread
from mapctl.errors import RequestError
from mapctl.runtime.processes import reraise_ctrl_c

if TYPE_CHECKING:
    from controllers.steering.process import CharacterProcess
    from scenes.live.app import LiveApp

_MAX_CHARACTERS = 16
_START_SPACING = 1.5  # metres between characters where they begin


@dataclass(frozen=True)
class Live:
    """Steer characters in a browser on this machine: sliders, keys, drawn paths, recording."""

    port: Annotated[int, arg(metavar="P")] = 8080
    """Where the page is served, on 127.0.0.1 only; the next free port if this one is taken."""
    characters: options.Count = 1
    """How many, side by side; each computes on a core of its own as long as there are cores."""
    prior: options.Name = "locomotion-live"
    """A bundled prior, or the file or run folder of a trained one."""
    seed: options.Count = 0
    """Of the poses that they begin with."""

    def run(self) -> int:
        """Check, open, serve until Ctrl-C."""
        use_single_thread()
        self._check()
        with reraise_ctrl_c():
            show = self._open_app()
        try:
            if not show.url.endswith(f":{self.port}"):
                print(f"port {self.port} is in use")
            print(f"open {show.url} in a browser; Ctrl-C ends", flush=True)
            show.run()
        except KeyboardInterrupt:
            print()
            for path in show.save_recordings(Path.cwd()):
                print(f"the recording that was going on is in {path.name}")
        finally:
            show.close()
        return 0

    def _open_app(self) -> "LiveApp":
        import priors
        from scenes.live.app import LiveApp
        from scenes.live.inputs import SteeringInputs

        prior = priors.load(self.prior)
        orders = [SteeringInputs() for _ in range(self.characters)]
        with reraise_ctrl_c():
            characters = self._start_characters()
        try:
            return LiveApp(
                characters, orders, port=self.port, fastest=prior.limits.max_steering_speed, labels=prior.labels
            )
        except BaseException:
            for character in characters:
                character.close()
            raise

    def _check(self) -> None:
        options.check_seed(self.seed)
        if not 1 <= self.port <= 65535:
            raise RequestError(f"the port must be a number from 1 to 65535, got {self.port}")
        if not 1 <= self.characters <= _MAX_CHARACTERS:
            raise RequestError(f"--characters must be 1 to {_MAX_CHARACTERS}, got {self.characters}")
        for package in ("viser", "trimesh"):
            if find_spec(package) is None:
                raise RequestError(f"this needs the package {package}: pip install 'mapctl[live]'")

    def _start_characters(self) -> "Sequence[CharacterProcess]":
        import priors
        from controllers.steering.process import CharacterProcess, CharacterRequest
        from mapctl.intent.steering import Command

        load = functools.partial(priors.load, self.prior)
        places = [(_START_SPACING * (number - (self.characters - 1) / 2), 0.0) for number in range(self.characters)]
        found: list[CharacterProcess] = []
        try:
            for number, at in enumerate(places):
                found.append(CharacterProcess(CharacterRequest(load, Command(1.2, 0.0), self.seed + number, at)))
            for character in found:
                character.wait()
        except BaseException:
            for character in found:
                character.close()
            raise
        return found
