"""The search for a step where contacts stand in its way: without them first, then with them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from mapctl.features import LAYOUT
from mapctl.problem.context import WindowRequest
from mapctl.problem.warm_start import BestOfSamples, SteeringKnots
from mapctl.problem.window_solvers import LatentNoiseSolver, SolvedWindow
from mapctl.terms import FootContact, Term

_KNOTS, _KNOT_SIGMA = 7, 0.8  # samples: noise of every feature, slow enough for a step


@dataclass(frozen=True)
class RelaxedFootingFirst:
    """Window solver that spends half on all terms but contacts, from the best of some samples, and half on all terms.

    A standing character has both feet planted, by contacts that are fixed while a window is solved: the contact term
    then prevents any step. The search without it finds one, along which the prior predicts new contacts.
    """

    relaxed_method: LatentNoiseSolver
    """Solver of the first half."""
    half: LatentNoiseSolver
    """Solver of the second half."""
    relaxed_terms: Sequence[Term]
    """Terms of the first half."""

    @staticmethod
    def of(half: LatentNoiseSolver, samples: int, terms: Sequence[Term], footing: FootContact) -> "RelaxedFootingFirst":
        """Build it from the solver of one half; the first draws so many samples beside its own evaluations."""
        space = SteeringKnots(_KNOTS, tuple(LAYOUT.slices)[:-1], _KNOT_SIGMA)
        budget = replace(half.budget, evaluations=samples + (half.budget.evaluations or 1))
        relaxed = replace(half, proposal=BestOfSamples(samples, space), budget=budget)
        others = [term for term in terms if term.name != footing.name]
        return RelaxedFootingFirst(relaxed, half, others)

    def __call__(self, request: WindowRequest) -> SolvedWindow:
        """Solve the window; either half has half of the time."""
        request = replace(request, seconds=request.seconds / 2)
        first = self.relaxed_method(replace(request, terms=self.relaxed_terms))
        second = self.half(replace(request, warm_start=first.warm_start))
        return replace(second, evaluations=first.evaluations + second.evaluations)
