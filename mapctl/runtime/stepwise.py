"""Work that is done a step at a time, between deadlines, and the type of functions that are called on progress."""

import time
from collections.abc import Callable, Generator
from typing import Any, Generic, TypeVar

Result = TypeVar("Result")


class StepwiseWork(Generic[Result]):
    """Work whose steps a generator takes; what comes of it depends on nothing but the generator."""

    def __init__(self, steps: Generator[None, None, Result]):
        self._steps = steps
        self._result: list[Result] = []
        self._error: BaseException | None = None

    def proceed(self, seconds: float) -> None:
        """Take steps for so long, or to the end; a step that was begun is finished."""
        end = time.perf_counter() + seconds
        while not self._result and time.perf_counter() < end:
            self._step()

    def finish(self) -> Result:
        """Take all steps that are left, and return what came of them."""
        while not self._result:
            self._step()
        return self._result[0]

    def __getstate__(self) -> dict[str, Any]:
        """Finish the work, so that it can be pickled and copied, which a generator cannot."""
        return {"_steps": None, "_result": [self.finish()], "_error": None}

    def _step(self) -> None:
        if self._error is not None:
            raise self._error
        try:
            next(self._steps)
        except StopIteration as end:
            self._result.append(end.value)
        except BaseException as error:  # a generator that was broken off would end with nothing
            self._error = error
            raise


Progress = Callable[[int, int], None]
"""Function called with work done and work in all."""
