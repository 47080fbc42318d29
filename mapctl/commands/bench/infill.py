"""`mapctl bench infill`: clips with pieces taken out."""

from collections.abc import Mapping, Sequence

import priors
from controllers.benchmarks.infilling import benchmark_infilling, benchmark_infilling_by_kind
from controllers.benchmarks.lost_joints import benchmark_missing_joints
from controllers.benchmarks.shared.held_out import load_canonical
from controllers.benchmarks.shared.tables import Row
from mapctl.commands.bench import Infill
from mapctl.commands.bench.baselines import find_held_out, list_models, measure_each
from mapctl.commands.bench.output import print_rows
from mapctl.commands.shared.progress_bar import show_progress
from mapctl.errors import RequestError
from mapctl.motion import Motion


def run(table: Infill) -> int:
    """Measure and print."""
    models = list_models(table.inbetweener, table.baselines)
    infillers = [name for name in models[1:] if priors.find_inbetweener_kind(name) == "infiller"]
    networks = {name: priors.load_inbetweener(name) for name in models if name not in infillers}
    held_out = find_held_out({name: each.card for name, each in networks.items()}, table.clips)
    kinds = load_canonical(table.data, held_out, table.count)
    rows = _compare_infillers(table, kinds, infillers)

    def measure(name: str) -> list[Row]:
        network = networks[name]
        return [*benchmark_infilling_by_kind(kinds, network), *benchmark_missing_joints(kinds, network)]

    return print_rows(table, [*rows, *measure_each(list(networks), measure)])


def _compare_infillers(table: Infill, kinds: Mapping[str, Sequence[Motion]], baselines: Sequence[str]) -> list[Row]:
    """Measure the tables of infillers, if there is one."""
    if table.infiller is None:
        if baselines:
            raise RequestError("infillers are compared with an infiller; name it by --infiller")
        return []
    infiller = priors.load_infiller(table.infiller)
    ours = infiller.card.config["architecture"]
    networks = {ours: infiller}
    for name in baselines:
        other = priors.load_infiller(name)
        architecture = other.card.config["architecture"]
        # Two of one kind differ by their names.
        networks[f"{architecture} {name}" if architecture in networks else architecture] = other
    clips = [clip for found in kinds.values() for clip in found]
    with show_progress("filling") as progress:
        return benchmark_infilling(clips, networks, ours=ours, progress=progress)
