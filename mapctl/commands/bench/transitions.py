"""`mapctl bench transitions`: gaps by LaFAN1's protocol."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

import priors
from controllers.benchmarks.shared.bones import scale_to_canonical_bones
from controllers.benchmarks.shared.held_out import load_canonical
from controllers.benchmarks.shared.tables import Row
from controllers.benchmarks.transitions import (
    Method,
    Sampler,
    benchmark_over_time,
    benchmark_partial_keys,
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
from mapctl.commands.bench.baselines import check_unseen
from mapctl.commands.bench.output import print_rows
from mapctl.commands.shared import outputs
from mapctl.commands.shared.progress_bar import show_progress
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS, GroundPose
from mapctl.inbetweening.retrieval import MotionCollection
from mapctl.motion import Motion
from mapctl.pose import decode
from mapctl.protocols import Inbetweener
from priors.stitching.inbetweener import Stitcher
from priors.training.corpus import read_corpus
from priors.training.mocap.cuts import CMU
from priors.training.transition_statistics import compute_position_std
from scenes.plots.transitions import plot_errors


def run(table: Transitions) -> int:
    """Check the options, measure and print."""
    _check(table)
    network = priors.load_inbetweener(table.inbetweener)
    held_out = network.card.data.get("held_out", {})
    kinds = load_canonical(table.data, held_out, table.count, fps=PRIOR_FPS)
    kinds = {kind: [scale_to_canonical_bones(clip) for clip in clips] for kind, clips in kinds.items()}
    if table.partial_keys:
        return print_rows(table, _measure_partial_keys(table, network, kinds, held_out))
    if table.over_time is not None:
        return print_rows(table, _measure_over_time(table, network, kinds, held_out, table.over_time))
    with TemporaryDirectory() as cache:
        corpus = read_corpus(table.data, match="", cache=Path(cache), cuts=CMU)
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
        check_unseen(str(table.prior), density.card, held_out)
    if density is not None:
        methods["rollouts"] = of_inbetweener(RolloutInbetweener([density], network), finish=False)
    with show_progress("transitions") as progress:
        rows = benchmark_transitions(
            kinds,
            methods,
            past=_count_past(table),
            std=compute_position_std(train),
            baseline="slerp",
            samplers=samplers,
            energy=None if density is None else of_density(density),
            progress=progress,
        )
    return print_rows(table, rows)


def _check(table: Transitions) -> None:
    """RequestError for options that exclude each other, and a picture that cannot be written."""
    other = "--partial-keys" if table.partial_keys else "--over-time" if table.over_time is not None else None
    if other and (table.prior is not None or table.auto):
        raise RequestError(f"{other} is about in-betweeners and stitchers; leave --prior and --auto out")
    if table.partial_keys and table.over_time is not None:
        raise RequestError("--partial-keys and --over-time are two tables; choose one")
    if table.over_time is not None:
        if table.over_time.suffix.lower() != ".png":
            raise RequestError(f"--over-time draws a .png, got {table.over_time}")
        outputs.check_files([table.over_time])


def _count_past(table: Transitions) -> int | None:
    """Count the frames that are known before a gap; None where the whole clip is."""
    return None if table.past == "all" else int(table.past)


def _measure_over_time(
    table: Transitions,
    network: Inbetweener,
    kinds: Mapping[str, Sequence[Motion]],
    held_out: Mapping[str, Sequence[str]],
    picture: Path,
) -> list[Row]:
    """Measure errors over the frames of gaps, and draw them."""
    samplers = {name: of_draws(lambda _, each=each: each) for name, each in _load_compared(table, network).items()}
    for name in filter(None, table.stitcher.split(",")):
        samplers[name] = of_draws(_load_unseeing(name, held_out).drawing().numbered)
    with show_progress("over time") as progress:
        rows = benchmark_over_time(kinds, samplers, past=_count_past(table), progress=progress)
    plot_errors(rows, picture)
    return rows


def _measure_partial_keys(
    table: Transitions,
    network: Inbetweener,
    kinds: Mapping[str, Sequence[Motion]],
    held_out: Mapping[str, Sequence[str]],
) -> list[Row]:
    """Measure gaps in which more is told than the poses beside them."""
    methods = _load_compared(table, network)
    for name in filter(None, table.stitcher.split(",")):
        methods[f"{name}, calm"] = StitchedInbetweener(_load_unseeing(name, held_out), lambda: network)
    with show_progress("partial keys") as progress:
        rows = benchmark_partial_keys(kinds, methods, progress=progress)
        if not table.raw:
            rows = [row | {"by": f"{row['by']}, raw"} for row in rows]
            finished = benchmark_partial_keys(kinds, methods, finish=True, progress=progress)
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
    check_unseen(name, stitcher.card, held_out)
    return stitcher
