"""`mapctl live`: characters in the browser, steered live."""

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import UseAppendAction, arg

from mapctl.commands.shared import options
from mapctl.commands.shared.command import ModelCommand


@dataclass(frozen=True)
class Live(ModelCommand, options.ReadOptions):
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
    prior: options.Name = "locomotion-live"
    """A bundled prior, or the file or run folder of a trained one."""
    seed: options.Count = 0
    """Seed of the first poses."""
    stream: options.MaybeEndpoint = None
    """Where poses go over the VMC protocol (most programs receive at port 39539): a port alone is on this machine. The
    second character's poses go to the next port, and so on."""
    stream_root: bool = False
    """Let the root travel over the ground in the stream, and not the hips."""
    stream_delay: options.Number = 0.1
    """Seconds by which the stream is behind, so that a frame that is computed late is not sent late."""
    listen: options.MaybeEndpoint = None
    """Where commands come from over OSC, as /mapctl/speed 1.4 (docs/guides/streaming.md): a port alone takes those of
    this machine; 0.0.0.0:PORT takes those of every machine."""
