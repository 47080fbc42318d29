"""`mapctl bench tweener`: the hips' trajectory told by the body."""

import priors
from controllers.benchmarks.shared.held_out import load_canonical
from controllers.benchmarks.tweener.root_prediction import benchmark_root_prediction
from controllers.benchmarks.tweener.walked_in_place import benchmark_walked_in_place
from mapctl.commands.bench import Tweener
from mapctl.commands.bench.output import print_rows


def run(table: Tweener) -> int:
    """Measure and print."""
    path = priors.load_path(table.path)
    kinds = load_canonical(table.data, path.card.data.get("held_out", {}), table.count)
    return print_rows(table, [*benchmark_root_prediction(kinds, path), *benchmark_walked_in_place(kinds, path)])
