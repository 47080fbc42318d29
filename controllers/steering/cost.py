"""What a step has cost lately on this machine, so that the next one ends in time."""

from dataclasses import dataclass

_RISE, _FALL = 0.1, 0.4  # share of the last step in what is expected: another process makes steps longer, none shorter
_FORGET = 0.9  # of an evaluation's time after a step that had none to make: else there would never be one again
_LONGEST_REST = 0.02  # seconds: a rest beyond it was interrupted by another process


@dataclass(frozen=True)
class StepCost:
    """Times of a step."""

    evaluation: float = 0.003
    """Seconds of an evaluation, its share of all else in a step included."""
    rest: float = 0.005
    """Seconds of a step before its search begins and after it ends."""

    def limit_search(self, seconds: float) -> float:
        """Return the seconds after which the search of a step of so many seconds must end."""
        return max(0.0, seconds - self.rest)

    def needed_seconds(self, evaluations: int) -> float:
        """Return the seconds of a step that makes so many evaluations."""
        return self.rest + evaluations * self.evaluation

    def learn(self, seconds: float, evaluations: int, *, search: float | None, cut_short: bool) -> "StepCost":
        """Return the cost as known after a step of so many seconds, whose search had `search` seconds, None without
        a limit, and ended by that limit if it was cut short."""
        one = _expect(self.evaluation, seconds / evaluations) if evaluations else _FORGET * self.evaluation
        rest = self.rest
        if cut_short and search is not None:
            rest = min(_LONGEST_REST, _expect(rest, max(0.0, seconds - search)))
        return StepCost(one, rest)


def _expect(known: float, last: float) -> float:
    return known + (_RISE if last > known else _FALL) * (last - known)
