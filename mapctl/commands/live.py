"""`mapctl live`: characters in the browser, steered live."""

import functools
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import UseAppendAction, arg

import priors
from controllers.common.character import Character
from controllers.steering.process import CharacterProcess, CharacterRequest
from controllers.steering.steer import SteerSettings
from mapctl.commands.shared import options, outputs, streaming
from mapctl.commands.shared.command import ModelCommand
from mapctl.commands.shared.inputs import as_character, read_character, read_drawn_character, read_rigged
from mapctl.errors import RequestError
from mapctl.intent.steering import Command
from mapctl.motion import Motion
from mapctl.retarget.carry import retarget_motion
from mapctl.streaming.messages import Endpoint
from mapctl.terms import FootContact
from priors import checkpoints
from scenes.drawn_character import DrawnCharacter

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
    character: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="CHARACTER")] = ()
    """File of a skinned character, as .glb or .vrm, that is shown with its own mesh and moves on its own bones; may be
    given several times, for the first character, the second and so on, and the last one for all others."""
    rig: options.OutRig = "canonical"
    """Joints and bones on which characters move, shown as mannequins: canonical, or those of a clip, a preset or a rig
    file. Recordings are on them, of a --character too, which is retargeted when it is saved."""
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

    prior, drawn = priors.load(command.prior), _read_drawn(command)
    checkpoints.note_use(_STITCHER)  # the characters' processes load it
    bodies, licence = _read_bodies(command, drawn), outputs.format_used_licences()
    rigs = _choose_recorded_rigs(command, drawn, bodies)
    looks = [CharacterLook(*one, licence) for one in zip(drawn, rigs, strict=True)]
    characters = _start_characters(command, bodies, opened)
    stream = streaming.open_stream(command, [character.skeleton for character in characters])
    if stream is not None:
        opened.callback(stream.close)
    show = LiveApp(
        characters,
        looks,
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
    if len(command.character) > command.characters:
        raise RequestError(
            f"--character is given {len(command.character)} times for {command.characters} of --characters"
        )
    for package in ("viser", "trimesh"):
        if find_spec(package) is None:
            raise RequestError(f"this needs the package {package}: pip install 'mapctl[live]'")
    streaming.check(command, command.listen, characters=command.characters)


def _read_drawn(command: Live) -> list[DrawnCharacter | None]:
    """Read the file of each character; those without one are mannequins."""
    read = {file: read_drawn_character(file) for file in dict.fromkeys(command.character)}
    files = [*command.character, *command.character[-1:] * (command.characters - len(command.character))]
    return [read[file] for file in files] or [None] * command.characters


def _read_bodies(command: Live, drawn: Sequence[DrawnCharacter | None]) -> list[Character]:
    """Read the body of each character: of its own file, else of --rig."""
    rig = read_character(command.rig, command)
    return [rig if one is None else as_character(one.body) for one in drawn]


def _choose_recorded_rigs(
    command: Live, drawn: Sequence[DrawnCharacter | None], bodies: Sequence[Character]
) -> list[Callable[[Motion], Motion] | None]:
    """Choose for each character what puts its recording on --rig; None where it stays as it is."""
    if command.rig == "canonical":
        return [None] * len(bodies)
    rig = read_rigged(command.rig, command)

    def carry(motion: Motion) -> Motion:
        return rig.on_rig(retarget_motion(motion, rig).motion)

    return [body.on_rig if one is None else carry for one, body in zip(drawn, bodies, strict=True)]


def _start_characters(command: Live, bodies: Sequence[Character], opened: ExitStack) -> Sequence[CharacterProcess]:
    """Start the characters side by side, all at once, and wait until they walk."""
    found: list[CharacterProcess] = []
    for number, own in enumerate(bodies):
        request = CharacterRequest(
            functools.partial(priors.load, priors.add_set(command.prior)),
            Command(1.2, 0.0),
            command.seed + number,
            (_START_SPACING * (number - (len(bodies) - 1) / 2), 0.0),
            SteerSettings(liveliness=command.liveliness, footing=FootContact(rest_height=own.toe_rest_height)),
            own.skeleton,
            transitions=functools.partial(priors.load_stitcher, priors.add_set(_STITCHER)),
        )
        found.append(opened.enter_context(CharacterProcess(request)))
    for character in found:
        character.wait()
    return found
