"""Which in-betweeners are compared."""

from collections.abc import Iterator

import priors
from controllers.benchmarks.tweener.gap_measures import Method, RawProposal
from controllers.inbetweening.pipeline import InfillSettings
from controllers.inbetweening.proposers import AutoInbetweener
from mapctl.commands.bench import Tweener
from mapctl.protocols import Inbetweener
from priors.infiller.network import ConvInfiller
from priors.tweening.inbetweener import Tweener as TweenerPrior


def list_methods(table: Tweener, *, auto: bool = False) -> Iterator[Method]:
    """List the tweener and the in-betweeners beside it, each as proposed and finished by MAP; and what `auto` does."""
    for each in (table.tweener, *filter(None, table.baselines.split(","))):
        inbetweener = priors.load_inbetweener(each, table.path)
        yield Method(each, inbetweener, InfillSettings(finish=False), raw=_find_raw(inbetweener))
        if not table.raw:
            yield Method(f"{each}, and MAP", inbetweener)
    if auto and not table.raw and table.baselines:
        yield build_auto(table)


def build_auto(table: Tweener) -> Method:
    """Build what `--method auto` does, with the tweener that is measured."""
    tweener, network = priors.load_tweener(table.tweener, table.path), priors.load_inbetweener()
    return Method("auto", AutoInbetweener(network, priors.load_choice("auto"), tweener=tweener))


def _find_raw(inbetweener: Inbetweener) -> RawProposal | None:
    """Return how it proposes without exact keys, if it has such a way."""
    if isinstance(inbetweener, TweenerPrior):
        return inbetweener.propose_raw
    if isinstance(inbetweener, ConvInfiller) and inbetweener.network.recurrent:
        return inbetweener.propose_raw
    return None
