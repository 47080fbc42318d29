"""When a run ends whose length is not told beforehand: where its curve is flat, or where its time is up."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mapctl.errors import CheckpointError, RequestError
from priors.training.ending.decay import Decay
from priors.training.ending.flatness import Point, find_greatest_gain, is_flat
from priors.training.parallel import TrainingGroup
from priors.training.trainer import Trainer

VALIDATIONS = 32
"""In as many steps as a recipe plans, where a run goes on until its curve is flat."""


@dataclass(frozen=True)
class UntilFlat:
    """How a run goes that ends where its validation curve is flat.

    The recipe's number of steps is a plan: what grows or joins in the course of training goes by it, and nothing is
    called flat before half of it.
    """

    share: float = 0.02
    """Flat is a curve whose error falls by less than this over the last third of the steps (see `flatness`)."""
    decay: float = 0.25
    """Steps in which the learning rate then falls to nothing, as a share of those before them."""
    most: float = 3.0
    """Times the planned steps after which a run ends whose curve never becomes flat."""
    decay_from: Decay | None = None
    """Where the learning rate falls, if that is told; a curve is then not looked at."""

    def __post_init__(self):
        for name in ("share", "decay", "most"):
            if not 0 < getattr(self, name) < math.inf:
                raise RequestError(f"{name} must be positive, got {getattr(self, name):g}")
        given = self.decay_from
        if given is not None and (given.begin < 1 or given.steps < 1):
            raise RequestError(f"the decay is given as STEP:STEPS, both at least 1, got {given}")

    def count_decay_steps(self, step: int) -> int:
        """Steps of a decay that begins at this one."""
        return max(1, round(self.decay * step))

    def find_latest_decay(self, planned: int) -> Decay:
        """The decay of a run whose curve never becomes flat."""
        if self.decay_from is not None:
            return self.decay_from
        begin = max(1, round(self.most * planned / (1 + self.decay)))
        return Decay(begin, self.count_decay_steps(begin))


@dataclass(frozen=True)
class End:
    """How a run ends, once that is decided."""

    decay: Decay
    """Where the learning rate falls; no steps where it does not."""
    reason: str
    """For people."""
    by_clock: bool = False
    """Whether the time was up, so that no other run ends at the same step by itself."""


class Course:
    """Decides the end of a run, once, for all its processes alike, and keeps it with the checkpoints."""

    def __init__(
        self,
        rule: UntilFlat | None,
        minutes: float | None,
        trainer: Trainer[Any],
        *,
        least: int,
        cost: float = 1.0,
        clock: Callable[[], float] = time.process_time,
    ):
        """`minutes` of this process' core, if they are limited; nothing is flat before `least` steps; a step of the
        decay takes `cost` times as long as one before it."""
        self.rule, self.minutes, self.trainer = rule, minutes, trainer
        self.end: End | None = None
        self._least, self._cost, self._clock = least, cost, clock
        self._began, self._spent = clock(), 0.0
        self._measured = (0, 0.0)  # step and seconds at the validation before
        self._pace = 0.0
        self._planned = trainer.steps
        if rule is not None:
            trainer.hold_rate(rule.find_latest_decay(trainer.steps).end)

    @property
    def seconds(self) -> float:
        """Seconds of this process' core, over all parts of the run."""
        return self._spent + self._clock() - self._began

    @property
    def overdue(self) -> bool:
        """Whether the time that is left is needed for the decay."""
        if self.minutes is None or self.end is not None or self.trainer.step == 0:
            return False
        return self._left <= self._find_pace() * self._count_decay_steps()

    def mark_validation(self) -> None:
        """A validation has ended: steps since the last one and this one tell the pace."""
        step, seconds = self._measured
        self._measured = (self.trainer.step, self.seconds)
        if self.trainer.step > step:
            self._pace = (self.seconds - seconds) / (self.trainer.step - step)

    def decide(self, points: Sequence[Point], *, overdue: bool, group: TrainingGroup) -> End | None:
        """The end, where it is decided now; `overdue` is agreed upon by all processes."""
        if self.end is not None:
            return None
        found = self._find_end(points)
        if found is None and overdue:
            steps = int(group.do_first(lambda: str(self._fit_decay()).encode()))
            found = End(Decay(self.trainer.step, steps), f"{self.minutes:g} minutes were nearly up", by_clock=True)
        if found is not None:
            self._set_end(found)
        return found

    def as_index(self) -> dict[str, Any]:
        """What a checkpoint keeps of it; nothing of a run whose length was told."""
        kept: dict[str, Any] = {}
        if self.rule is not None:
            kept["until_flat"] = asdict(self.rule)
        if self.end is not None:
            kept["end"] = asdict(self.end)
        return kept | ({"seconds": self.seconds} if self.minutes is not None else {})

    def as_card(self) -> dict[str, Any]:
        """For a card: when and why the run ended, and how long it took where that was limited."""
        if self.rule is None and self.minutes is None:
            return {}
        told: dict[str, Any] = {"steps": self.trainer.step}
        if self.end is not None:
            told |= {"decay_from": self.end.decay.begin, "reason": self.end.reason}
        return {"ended": told | ({"minutes": round(self.seconds / 60, 2)} if self.minutes is not None else {})}

    def load(self, run: Path, index: Mapping[str, Any]) -> None:
        """Go on from what `as_index` gave. CheckpointError where the run was begun to end in another way."""
        now = None if self.rule is None else asdict(self.rule)
        if (then := index.get("until_flat")) != now:
            raise CheckpointError(f"{run}: the run was begun {_describe(then)}, and is to go on {_describe(now)}")
        self._spent, self._began = float(index.get("seconds", 0.0)), self._clock()
        self._measured = (int(index["step"]), self._spent)
        if (kept := index.get("end")) is not None and self.rule is not None:
            self._set_end(End(Decay(**kept["decay"]), kept["reason"], kept["by_clock"]))

    @property
    def _left(self) -> float:
        return 60 * (self.minutes or math.inf) - self.seconds

    def _find_pace(self) -> float:
        """Seconds that a step takes, validations counted: the mean since the last validation but one, or over all."""
        return max(self._pace, self.seconds / max(1, self.trainer.step))

    def _count_decay_steps(self) -> int:
        """Steps of a decay from now on, in steps of now; none where the learning rate does not fall."""
        return 0 if self.rule is None else math.ceil(self._cost * self.rule.count_decay_steps(self.trainer.step))

    def _fit_decay(self) -> int:
        """Steps of a decay for which there is time."""
        if self.rule is None:
            return 0
        fits = int(max(0.0, self._left) / (self._cost * self._find_pace()))
        return max(1, min(self.rule.count_decay_steps(self.trainer.step), fits))

    def _find_end(self, points: Sequence[Point]) -> End | None:
        rule, step = self.rule, self.trainer.step
        if rule is None or step < 1:
            return None
        latest = rule.find_latest_decay(self._planned)
        if step >= latest.begin:
            told = f"the decay was told to begin at step {latest.begin}"
            never = f"the curve was not flat after {latest.begin} steps"
            return End(latest, never if rule.decay_from is None else told)
        measured = rule.decay_from is None and points and points[-1][0] == step >= self._least
        if not measured or not is_flat(points, rule.share):
            return None
        gain = find_greatest_gain(points) or 0.0
        reason = f"the curve was flat: at most {100 * max(0.0, gain):.1f} % better over the last third of {step} steps"
        return End(Decay(step, rule.count_decay_steps(step)), reason)

    def _set_end(self, end: End) -> None:
        self.end = end
        if self.rule is None:
            self.trainer.steps = end.decay.end
        else:
            self.trainer.begin_decay(end.decay)


def _describe(rule: Mapping[str, Any] | None) -> str:
    return "with a length of its own" if rule is None else f"with --until-flat ({rule})"
