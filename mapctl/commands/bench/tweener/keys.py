"""Table 4: keys before they are made exact, gaps with a past, and made seconds told from mocap's; and keys that are no
whole poses."""

import priors
from controllers.benchmarks.shared.held_out import load_canonical
from controllers.benchmarks.shared.tables import Row
from controllers.benchmarks.tweener.gap_measures import Method
from controllers.benchmarks.tweener.gaps_with_past import benchmark_gaps_with_past
from controllers.benchmarks.tweener.partial_keys import benchmark_partial_keys
from controllers.benchmarks.tweener.spliced_keys import benchmark_spliced_keys
from controllers.benchmarks.tweener.told_apart import benchmark_told_apart
from controllers.inbetweening.pipeline import InfillSettings
from mapctl.commands.bench import Tweener
from mapctl.commands.bench.tweener.methods import build_auto, list_methods
from mapctl.commands.bench.tweener.sequences import LONG_GAPS, SINGLE_KEYS, HeldOutClips
from mapctl.commands.shared.progress_bar import show_progress
from mapctl.features import PRIOR_FPS
from mapctl.motion import Motion

_SEED = 0
_SHARE_APART = 10  # sequences of keys for each that is told apart


def measure_keys(table: Tweener) -> dict[str, list[Row]]:
    """Measure keys of sequences of several clips, and those behind gaps with a past."""
    kinds, methods = load_kinds(table), list(list_methods(table))
    with show_progress("keys") as progress:
        drawn = HeldOutClips(kinds).draw(table.sequences, table.frames, SINGLE_KEYS, seed=_SEED)
        spliced = benchmark_spliced_keys(drawn, methods, count=table.sequences, progress=progress)
    with show_progress("gaps with a past") as progress:
        past = benchmark_gaps_with_past(kinds, methods, progress=progress)
    return {"keys": spliced, "gaps with a past": past}


def measure_apart(table: Tweener) -> dict[str, list[Row]]:
    """Measure how well made seconds are told from mocap's."""
    held = HeldOutClips(load_kinds(table))
    count = max(1, table.sequences // _SHARE_APART)
    sequences = list(held.draw(count, table.frames, LONG_GAPS, seed=_SEED))
    with show_progress("told apart") as progress:
        rows = benchmark_told_apart(sequences, held.clips, list(list_methods(table)), progress=progress)
    return {"told apart": rows}


def measure_partial(table: Tweener) -> dict[str, list[Row]]:
    """Measure keys that are halves, places or drawings: by the tweener alone, and by what `--method auto` does."""
    tweener = priors.load_tweener(table.tweener, table.path)
    methods = [Method(table.tweener, tweener, InfillSettings(finish=False))]
    methods += [] if table.raw else [build_auto(table)]
    with show_progress("partial keys") as progress:
        rows = benchmark_partial_keys(load_kinds(table), methods, progress=progress)
    return {"partial keys": rows}


def load_kinds(table: Tweener) -> dict[str, list[Motion]]:
    """Load the clips that were kept from the tweener's training, on canonical joints at PRIOR_FPS."""
    card = priors.load_tweener(table.tweener, table.path).card
    return load_canonical(table.data, card.data.get("held_out", {}), table.count, fps=PRIOR_FPS)
