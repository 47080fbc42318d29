"""Table 2: the hips' trajectory told by the body."""

import priors
from controllers.benchmarks.shared.held_out import load_canonical
from controllers.benchmarks.shared.tables import Row
from controllers.benchmarks.tweener.root_prediction import benchmark_root_prediction
from controllers.benchmarks.tweener.walked_in_place import benchmark_walked_in_place
from mapctl.commands.bench import Tweener


def measure(table: Tweener) -> dict[str, list[Row]]:
    """Measure every frame of clips, and clips walked in place."""
    path = priors.load_path(table.path)
    kinds = load_canonical(table.data, path.card.data.get("held_out", {}), table.count)
    return {"path": benchmark_root_prediction(kinds, path), "walked in place": benchmark_walked_in_place(kinds, path)}
