"""How tests fill gaps: `auto` is finished by the MAP stage, `infiller` and `slerp` stay as they are proposed."""

from controllers.inbetweening.pipeline import InfillSettings
from controllers.inbetweening.proposers import AutoInbetweener, SlerpInbetweener
from mapctl.protocols import Inbetweener

UNFINISHED = InfillSettings(refine=False)


def by_method(method: str, infiller: Inbetweener) -> tuple[Inbetweener, InfillSettings]:
    """Return the in-betweener and the settings of a method."""
    return {"auto": AutoInbetweener, "infiller": lambda it: it, "slerp": lambda it: SlerpInbetweener()}[method](
        infiller
    ), InfillSettings(refine=method == "auto")


def words_of(method: str) -> list[str]:
    """The options of a method on the command line."""
    return ["--method", method, *([] if method == "auto" else ["--no-refine"])]
