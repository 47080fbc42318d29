"""Motion DNA: the same keys under DNA of clips of different content."""

import priors
from controllers.benchmarks.shared.tables import Row
from controllers.benchmarks.tweener.dna import benchmark_dna, choose_examples, choose_keys, load_style_clips
from controllers.inbetweening.pipeline import InfillSettings
from mapctl.commands.bench import Tweener
from mapctl.commands.shared.progress_bar import show_progress

_EXAMPLES = 12


def measure(table: Tweener) -> dict[str, list[Row]]:
    """Measure them as raw motion, or finished by MAP."""
    tweener = priors.load_tweener(table.tweener, table.path)
    clips = load_style_clips(table.data, tweener.card.data.get("held_out", {}))
    with show_progress("keys") as progress:
        rows = benchmark_dna(
            choose_keys(clips),
            choose_examples(clips, table.dna or _EXAMPLES),
            clips,
            lambda dna: tweener if dna is None else tweener.styled(dna),
            priors.load_inbetweener(),
            settings=InfillSettings(finish=not table.raw),
            progress=progress,
        )
    return {"dna": rows}
