"""`mapctl bench transitions`: gaps by LaFAN1's protocol."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

import priors
from controllers.benchmarks.infilling import scale_to_canonical_bones
from controllers.benchmarks.shared.held_out import load_canonical
from controllers.benchmarks.shared.tables import Row
from controllers.benchmarks.transitions import (
    Method,
    Sampler,
    benchmark_told,
    benchmark_transitions,
    draw_retrieved,
    hold_last_pose,
    of_density,
    of_draws,
    of_inbetweener,
    of_retrieval,
)
from controllers.inbetweening.proposers import (
    AutoInbetweener,
    RolloutInbetweener,
    SlerpInbetweener,
    StitchedInbetweener,
)
from mapctl.commands.bench import Transitions
from mapctl.commands.bench.output import print_rows
from mapctl.commands.shared.progress_bar import show_progress
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS, GroundPose
from mapctl.inbetweening.retrieval import MotionCollection
from mapctl.motion import Motion
from mapctl.pose import decode
from mapctl.protocols import Inbetweener
from priors.checkpoints import Card
from priors.stitching.inbetweener import Stitcher
from priors.training.corpus import read_corpus
from priors.training.transition_statistics import compute_position_std


def run(table: Transitions) -> int:
    """Measure and print."""
    network = priors.load_inbetweener(table.inbetweener)
    held_out = network.card.data.get("held_out", {})
    kinds = load_canonical(table.data, held_out, table.count, fps=PRIOR_FPS)
    kinds = {kind: [scale_to_canonical_bones(clip) for clip in clips] for kind, clips in kinds.items()}
    if table.told:
        return print_rows(table, _measure_told(table, network, kinds, held_out))
    with TemporaryDirectory() as cache:
        corpus = read_corpus(table.data, match="", cache=Path(cache), skip_first=True)
    # By name: a folder with clips beside those of the training would be split otherwise.
    kept_out = {name for names in held_out.values() for name in names}
    train = corpus.subset(number for number, name in enumerate(corpus.names) if name not in kept_out)
    origin = GroundPose(torch.zeros(2), torch.zeros(()))
    collection = MotionCollection.of([decode(clip, origin) for clip in train.clips()])
    methods: dict[str, Method] = {
        "zero velocity": hold_last_pose,
        "slerp": of_inbetweener(SlerpInbetweener(), finish=False),
        "retrieval": of_retrieval(collection),
    }
    for name, each in _load_compared(table, network).items():
        methods |= _name_methods(name, each, raw=table.raw)
    if table.auto:
        methods["auto"] = of_inbetweener(AutoInbetweener(network, priors.load_choice("auto")))
    samplers: dict[str, Sampler] = {}
    for name in filter(None, table.stitcher.split(",")):
        stitcher = _load_unseeing(name, held_out)
        methods |= _name_methods(f"{name}, calm", stitcher, raw=table.raw)
        samplers[name] = of_draws(stitcher.drawing().numbered)
    if samplers:
        samplers["retrieval"] = draw_retrieved(collection)
    density = None if table.prior is None else priors.load(table.prior)
    if density is not None:
        _check_unseen(str(table.prior), density.card, held_out)
    if density is not None:
        methods["rollouts"] = of_inbetweener(RolloutInbetweener([density], network), finish=False)
    past = None if table.past == "all" else int(table.past)
    with show_progress("transitions") as progress:
        rows = benchmark_transitions(
            kinds,
            methods,
            past=past,
            std=compute_position_std(train),
            baseline="slerp",
            samplers=samplers,
            energy=None if density is None else of_density(density),
            progress=progress,
        )
    return print_rows(table, rows)


def _measure_told(
    table: Transitions,
    network: Inbetweener,
    kinds: Mapping[str, Sequence[Motion]],
    held_out: Mapping[str, Sequence[str]],
) -> list[Row]:
    """Measure gaps in which more is told than the poses beside them."""
    if table.prior is not None or table.auto:
        raise RequestError("--told is about in-betweeners and stitchers; leave --prior and --auto out")
    methods = _load_compared(table, network)
    for name in filter(None, table.stitcher.split(",")):
        methods[f"{name}, calm"] = StitchedInbetweener(_load_unseeing(name, held_out), lambda: network)
    with show_progress("told") as progress:
        rows = benchmark_told(kinds, methods, progress=progress)
        if not table.raw:
            rows = [row | {"by": f"{row['by']}, raw"} for row in rows]
            finished = benchmark_told(kinds, methods, finish=True, progress=progress)
            rows += [row | {"by": f"{row['by']}, finished"} for row in finished]
    return rows


def _load_compared(table: Transitions, network: Inbetweener) -> dict[str, Inbetweener]:
    """Load the baselines, and name the in-betweener after them."""
    compared = {name: priors.load_inbetweener(name) for name in filter(None, table.baselines.split(","))}
    return compared | {table.inbetweener: network}


def _name_methods(name: str, inbetweener: Inbetweener, *, raw: bool) -> dict[str, Method]:
    """Name the rows of an in-betweener: as it proposes, and finished unless they are to be raw."""
    methods = {f"{name}, raw": of_inbetweener(inbetweener, finish=False)}
    return methods if raw else methods | {f"{name}, finished": of_inbetweener(inbetweener)}


def _load_unseeing(name: str, held_out: Mapping[str, Sequence[str]]) -> Stitcher:
    """Load a stitcher that has not seen the clips that are measured."""
    stitcher = priors.load_stitcher(name)
    _check_unseen(name, stitcher.card, held_out)
    return stitcher


def _check_unseen(name: str, card: Card, held_out: Mapping[str, Sequence[str]]) -> None:
    """RequestError where a model's training saw clips that are kept for measuring."""
    own = {clip for clips in card.data.get("held_out", {}).values() for clip in clips}
    seen = [clip for clips in held_out.values() for clip in clips if clip not in own]
    if seen:
        raise RequestError(
            f"{name} was trained on {seen[0]}, which is kept for measuring; train it with that seed on the same files"
        )
