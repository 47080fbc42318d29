"""`mapctl live`: characters in the browser, steered live."""

import functools
from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

import priors
from controllers.common.character import Character
from controllers.steering.process import CharacterProcess, CharacterRequest
from controllers.steering.steer import SteerSettings
from mapctl.commands.shared import options, outputs, streaming
from mapctl.commands.shared.command import ModelCommand
from mapctl.commands.shared.inputs import as_character, read_character, read_drawn_character
from mapctl.errors import RequestError
from mapctl.intent.steering import Command
from mapctl.streaming.messages import Endpoint
from mapctl.terms import FootContact
from priors import checkpoints

if TYPE_CHECKING:
    from mapctl.streaming.receiver import OscReceiver
    from mapctl.streaming.sender import PoseStream
    from scenes.live.app import LiveApp

_MAX_CHARACTERS = 16
_STITCHER = "stitcher"
_START_SPACING = 1.5  # metres between characters where they begin


@dataclass(frozen=True)
class Live(ModelCommand, options.ReadOptions, streaming.StreamOptions):
    """Steer characters in a browser on this machine: sliders, keys, drawn paths, recording."""

    port: Annotated[int, arg(metavar="P")] = 8080
    """Port of the page, on 127.0.0.1 only; the next free port if this one is taken."""
    characters: options.Count = 1
    """Number of characters, side by side; each computes on a core of its own as long as there are cores."""
    character: options.MaybeCharacter = None
    """File of a skinned character, as .glb or .vrm, that is shown with its own mesh and moves on its own bones."""
    rig: options.OutRig = "canonical"
    """Joints and bones on which characters move and are recorded, shown as mannequins: canonical, or those of a clip, a
    preset or a rig file."""
    prior: options.Prior = "locomotion-live"
    seed: options.Count = 0
    """Seed of the first poses, and of what is drawn for walks."""
    liveliness: options.Liveliness = SteerSettings.liveliness
    listen: options.MaybeEndpoint = None
    """Where commands come from over OSC, as /mapctl/speed 1.4 (docs/guides/streaming.md): a port alone takes those of
    this machine; 0.0.0.0:PORT takes those of every machine."""


def run(command: Live) -> int:
    """Check, open, serve until Ctrl-C; whatever was opened is closed, also where the rest cannot be."""
    _check(command)
    with ExitStack() as opened:
        receiver = None
        if command.listen is not None:
            from mapctl.streaming.receiver import OscReceiver

            receiver = opened.enter_context(closing(OscReceiver(Endpoint.parse(command.listen, option="--listen"))))
        show, stream = _open_app(command, receiver, opened)
        if not show.url.endswith(f":{command.port}"):
            print(f"port {command.port} is in use")
        if stream is not None:
            print(f"poses go to {', '.join(map(str, stream.endpoints))} (VMC)")
        if receiver is not None:
            print(f"orders come from {receiver.endpoint} (OSC)")
        print(f"open {show.url} in a browser; Ctrl-C ends", flush=True)
        try:
            show.run()
        except KeyboardInterrupt:
            print()
            for path in show.save_recordings(Path.cwd()):
                print(f"the recording is in {path.name}")
    if stream is not None:
        print(streaming.summarise(stream))
    return 0


def _open_app(command: Live, receiver: "OscReceiver | None", opened: ExitStack) -> "tuple[LiveApp, PoseStream | None]":
    from scenes.live.app import LiveApp
    from scenes.live.character import CharacterLook

    prior, drawn = priors.load(command.prior), read_drawn_character(command.character)
    checkpoints.note_use(_STITCHER)  # the characters' processes load it
    body = read_character(command.rig, command) if drawn is None else as_character(drawn.body)
    look = CharacterLook(drawn, body.on_rig, outputs.format_used_licences())
    characters = _start_characters(command, body, opened)
    stream = streaming.open_stream(command, [body.skeleton] * len(characters))
    if stream is not None:
        opened.callback(stream.close)
    show = LiveApp(
        characters,
        look,
        port=command.port,
        fastest=prior.limits.max_steering_speed,
        labels=prior.labels,
        stream=stream,
        source=receiver,
    )
    opened.callback(show.close)
    return show, stream


def _check(command: Live) -> None:
    options.check_seed(command.seed)
    options.check_liveliness(command.liveliness)
    if not 1 <= command.port <= 65535:
        raise RequestError(f"the port must be a number from 1 to 65535, got {command.port}")
    if not 1 <= command.characters <= _MAX_CHARACTERS:
        raise RequestError(f"--characters must be 1 to {_MAX_CHARACTERS}, got {command.characters}")
    if command.character is not None and command.rig != "canonical":
        raise RequestError("--character moves on its own bones; leave it or --rig out")
    for package in ("viser", "trimesh"):
        if find_spec(package) is None:
            raise RequestError(f"this needs the package {package}: pip install 'mapctl[live]'")
    streaming.check(command, command.listen, characters=command.characters)


def _start_characters(command: Live, body: Character, opened: ExitStack) -> Sequence[CharacterProcess]:
    """Start the characters side by side, all at once, and wait until they walk."""
    settings = SteerSettings(liveliness=command.liveliness, footing=FootContact(rest_height=body.toe_rest_height))
    found: list[CharacterProcess] = []
    for number in range(command.characters):
        request = CharacterRequest(
            functools.partial(priors.load, priors.add_set(command.prior)),
            Command(1.2, 0.0),
            command.seed + number,
            (_START_SPACING * (number - (command.characters - 1) / 2), 0.0),
            settings,
            body.skeleton,
            transitions=functools.partial(priors.load_stitcher, priors.add_set(_STITCHER)),
        )
        found.append(opened.enter_context(CharacterProcess(request)))
    for character in found:
        character.wait()
    return found
