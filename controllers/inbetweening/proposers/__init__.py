"""Proposers of motion in gaps: the in-betweeners behind --method."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from controllers.inbetweening.proposers.auto import AutoInbetweener
from controllers.inbetweening.proposers.rollouts import RolloutInbetweener
from controllers.inbetweening.proposers.slerp import SlerpInbetweener, StitchedInbetweener
from mapctl.errors import RequestError
from mapctl.protocols import Density, Inbetweener

__all__ = [
    "METHODS",
    "AutoInbetweener",
    "ModelLoaders",
    "RolloutInbetweener",
    "SlerpInbetweener",
    "StitchedInbetweener",
    "build_inbetweener",
    "check_method",
]


@dataclass(frozen=True)
class ModelLoaders:
    """Loaders of the models that an in-betweener needs, called when it needs them."""

    network: Callable[[str], Inbetweener]
    """Loader of the network that a method asks for by its own name; of whichever is given for `rollouts`, and for
    `auto` of whichever but a tweener."""
    densities: Callable[[], Sequence[Density]]
    """Loader of the densities for rollouts."""
    tweener: Callable[[], Inbetweener | None]
    """Loader of the network for long gaps that `auto` takes beside the other; of None where there is none."""
    stitcher: Callable[[], Inbetweener]
    """Loader of the network that fills gaps from both sides."""


METHODS: Mapping[str, Callable[[ModelLoaders], Inbetweener]] = {
    "auto": lambda models: AutoInbetweener(
        models.network("auto"), models.densities(), tweener=models.tweener(), stitcher=models.stitcher
    ),
    "transformer": lambda models: models.network("transformer"),
    "infiller": lambda models: models.network("infiller"),
    "tweener": lambda models: models.network("tweener"),
    "stitcher": lambda models: StitchedInbetweener(models.stitcher(), lambda: models.network("stitcher")),
    "rollouts": lambda models: RolloutInbetweener(models.densities(), models.network("rollouts")),
    "slerp": lambda models: SlerpInbetweener(),
}
"""Builders of in-betweeners by the name of the method."""


def check_method(method: str) -> None:
    """Raise RequestError for an unknown method."""
    if method not in METHODS:
        raise RequestError(f"there is no --method {method}; there are {', '.join(METHODS)}")


def build_inbetweener(method: str, models: ModelLoaders) -> Inbetweener:
    """Build the in-betweener of a method; RequestError for one that there is not."""
    check_method(method)
    return METHODS[method](models)
