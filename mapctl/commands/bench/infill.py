"""`mapctl bench infill`: clips with pieces taken out."""

from collections.abc import Mapping, Sequence

import priors
from controllers.benchmarks.infilling import benchmark_infilling, benchmark_infilling_by_kind
from controllers.benchmarks.lost_joints import benchmark_missing_joints
from controllers.benchmarks.shared.held_out import load_canonical
from controllers.benchmarks.shared.tables import Row
from mapctl.commands.bench import Infill
from mapctl.commands.bench.output import print_rows
from mapctl.commands.shared.progress_bar import show_progress
from mapctl.errors import RequestError
from mapctl.motion import Motion


def run(table: Infill) -> int:
    """Measure and print."""
    network = priors.load_inbetweener(table.inbetweener)
    kinds = load_canonical(table.data, network.card.data.get("held_out", {}), table.count)
    rows = _compare_infillers(table, kinds)
    by_kind = benchmark_infilling_by_kind(kinds, network)
    return print_rows(table, [*rows, *by_kind, *benchmark_missing_joints(kinds, network)])


def _compare_infillers(table: Infill, kinds: Mapping[str, Sequence[Motion]]) -> list[Row]:
    """Measure the tables of infillers, if there is one."""
    if table.infiller is None:
        if table.baselines:
            raise RequestError("--baselines are compared with an infiller; name it by --infiller")
        return []
    infiller = priors.load_infiller(table.infiller)
    ours = infiller.card.config["architecture"]
    networks = {ours: infiller}
    for name in filter(None, table.baselines.split(",")):
        other = priors.load_infiller(name)
        architecture = other.card.config["architecture"]
        # Two of one kind differ by their names.
        networks[f"{architecture} {name}" if architecture in networks else architecture] = other
    clips = [clip for found in kinds.values() for clip in found]
    with show_progress("filling") as progress:
        return benchmark_infilling(clips, networks, ours=ours, progress=progress)
