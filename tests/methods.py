"""How tests fill gaps: `auto` is finished by the MAP stage, `infiller` and `slerp` stay as they are proposed."""

from controllers.common.map_refinement import RefinementSettings
from controllers.inbetweening.pipeline import INFILL_REFINEMENT
from controllers.inbetweening.proposers import AutoInbetweener, SlerpInbetweener
from mapctl.protocols import Inbetweener


def by_method(method: str, infiller: Inbetweener) -> tuple[Inbetweener, RefinementSettings | None]:
    """Return the in-betweener and the refinement of a method."""
    return {"auto": AutoInbetweener, "infiller": lambda it: it, "slerp": lambda it: SlerpInbetweener()}[method](
        infiller
    ), INFILL_REFINEMENT if method == "auto" else None


def words_of(method: str) -> list[str]:
    """The options of a method on the command line."""
    return ["--method", method, *([] if method == "auto" else ["--no-refine"])]
