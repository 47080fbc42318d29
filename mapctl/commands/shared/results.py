"""Shared parts of commands that return a motion: checks of the request, models, and motion, report and film."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from torch import Tensor

import priors
from controllers.inbetweening import proposers
from controllers.inbetweening.proposers import AutoInbetweener, ModelLoaders
from mapctl import formats, metrics, motion_dna
from mapctl import report as reports
from mapctl.commands.shared import inputs, options, outputs
from mapctl.errors import RequestError
from mapctl.metrics import make_comparable
from mapctl.motion import Motion
from mapctl.problem.solution import Solution
from mapctl.protocols import Inbetweener
from mapctl.retarget.rigs import Rig
from priors.stitcher import Stitcher
from priors.tweener import Style, Tweener, mix_styles, pick_class
from scenes.film import film_side_by_side

Examples = Sequence[tuple[str, Tensor | None]]
"""Name and poses of each motion file whose style is requested; without poses the name of a class."""


def read_dna(command: options.ProposalOptions) -> Examples:
    """Read the motion files that --dna names; what is none is a class. RequestError for methods without styles, and for
    files that no poses can be taken of."""
    if command.dna is None:
        return ()
    if command.method not in ("auto", "tweener"):
        raise RequestError(f"--method {command.method} takes no style; leave --dna out or take --method tweener")
    names = [name.strip() for name in command.dna.split(",")]
    if not all(names):
        raise RequestError(f"--dna takes motion files and classes with a comma between two, got {command.dna!r}")
    found: list[tuple[str, Tensor | None]] = []
    for name in names:
        path = Path(name)
        if not path.is_file() and path.suffix.lower() not in formats.READERS:
            found.append((name, None))
            continue
        motion = inputs.read_motion(path, None, quiet=True)
        try:
            found.append((path.name, motion_dna.of(motion)))
        except RequestError as error:
            raise RequestError(f"{name} gives no style: {error}") from error
    return found


def find_styles(tweener: Tweener, examples: Examples) -> list[Style]:
    """Find the style of each example; RequestError for a class that the weights do not have."""
    return [
        pick_class(tweener.classes, name) if dna is None else tweener.encode_style(dna, name) for name, dna in examples
    ]


def restyle(inbetweener: Inbetweener, style: Style) -> Inbetweener:
    """Return an in-betweener whose tweener, if it has one or is one, moves in another style."""
    if isinstance(inbetweener, AutoInbetweener) and inbetweener.tweener is not None:
        return replace(
            inbetweener, network=restyle(inbetweener.network, style), tweener=restyle(inbetweener.tweener, style)
        )
    return inbetweener.in_style(style) if isinstance(inbetweener, Tweener) else inbetweener


def check_destinations(out: Path, video: Path | None, *others: Path | None, given: Sequence[Path]) -> None:
    """Raise RequestError unless the motion, its film and the other files can be written, none over a given file; leaves
    no trace.
    """
    formats.check_ending(out)
    outputs.check_files(options.collect_paths(out, video, *others), given=given)
    if video is not None:
        outputs.check_film(video, outputs.FILM_SIZE)


def check_proposal(command: options.ProposalOptions, *, prior: str | None = None, way: bool | None = None) -> None:
    """Raise RequestError for an unknown method, and for a density or a network that the method does not use. `way`:
    whether --way asks for the hips' positions, of a command that has it."""
    method = command.method
    proposers.check_method(method)
    if command.stitcher is not None and method != "stitcher":
        raise RequestError(f"--method {method} stitches nothing; leave --stitcher out or take --method stitcher")
    if prior is not None and command.no_refine and method not in ("auto", "rollouts"):
        raise RequestError(f"--method {method} --no-refine has no MAP stage for a density; leave --prior out")
    if command.inbetweener is not None and method == "slerp":
        raise RequestError("--method slerp uses no network; leave --inbetweener out")
    takes_path = method == "tweener" or (method == "auto" and _is_tweener(command.inbetweener))
    if command.path is not None and not takes_path and not way:
        users = "--method tweener" if way is None else "--way and for --method tweener"
        raise RequestError(f"--path predicts the hips' position for {users}; leave it out")


def _is_tweener(inbetweener: str | None) -> bool:
    return inbetweener is not None and priors.find_inbetweener_kind(inbetweener) == "tweener"


def load_models(
    command: options.ProposalOptions, *, prior: str | None = None, dna: Examples | None = None
) -> ModelLoaders:
    """Build the loaders of the named models, or of the bundled ones, tweeners in a style if there is one; RequestError
    for a network that is not of the kind that the method asks for, and for classes that are not known. A named tweener
    is, for `auto`, the one that it takes in long gaps.
    """
    inbetweener, path, is_tweener = command.inbetweener, command.path or "path", _is_tweener(command.inbetweener)
    examples = read_dna(command) if dna is None else dna

    def set_style(network: Inbetweener) -> Inbetweener:
        if not examples or not isinstance(network, Tweener):
            return network
        return network.in_style(mix_styles(find_styles(network, examples)))

    def load_network(method: str) -> Inbetweener:
        if method == "infiller" and inbetweener is None:
            raise RequestError(
                "no infiller is bundled; name one that `mapctl train infiller` trained by --inbetweener RUN"
            )
        usual = "tweener" if method == "tweener" else "transformer"
        # Of a named tweener `auto` makes its own for long gaps.
        named = None if method == "auto" and is_tweener else inbetweener
        network = priors.load_inbetweener(named or usual, path)
        if isinstance(network, Stitcher):
            raise RequestError(f"{inbetweener} is a stitcher; name it by --stitcher, with --method stitcher")
        kinds = {"infiller": "infiller", "transformer": "pose-transformer", "tweener": "tweener"}
        if network.card.kind != kinds.get(method, network.card.kind):
            raise RequestError(f"--method {method} takes no {network.card.kind}; leave it or {inbetweener} out")
        return set_style(network)

    def load_tweener() -> Inbetweener | None:
        if not (is_tweener or examples or command.path or priors.has_model("tweener")):
            return None  # the free weights have none, and `auto` does without
        return set_style(priors.load_tweener((is_tweener and inbetweener) or "tweener", path))

    load_densities = partial(priors.load_choice, prior or "auto")
    return ModelLoaders(
        load_network, load_densities, load_tweener, partial(priors.load_stitcher, command.stitcher or "stitcher")
    )


def write_result(
    name: str, command: Any, solution: Solution, before: Motion, *, rig: Rig | None, more: Mapping[str, Any] = {}
) -> None:
    """Write the motion of a command's solution; the report, with `more` entries, and the film of the motion `before`
    and this one where the command's options ask for them."""
    outputs.save_motion(solution.motion, command.out)
    if getattr(command, "report", None) is not None:
        reports.write_report({**build_report(name, command, solution), **more}, command.report)
    if command.video is not None:
        with outputs.show_progress("filming", quiet=command.quiet) as progress:
            film_side_by_side(before, solution.motion, command.video, rig=rig, progress=progress)


def build_report(name: str, command: Any, solution: Solution) -> dict[str, Any]:
    """Build the report on a job whose motion is measured as `mapctl measure` takes it, without a curve."""
    request = {key: value for key, value in options.describe_request(name, command).items() if value is not None}
    comparable = make_comparable(solution.motion, inputs.read_rig(command.rig, command))[0]
    return outputs.add_licence(reports.build_report(solution, request=request, measures=metrics.measure(comparable)))
