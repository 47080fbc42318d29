"""Under which licence the models of a set are, by the clips that they are trained on."""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from mapctl.commands.train.whole_set import TrainAll
from mapctl.errors import RequestError
from priors.licences import FREE, OF_DATA, find_unfree
from priors.training.bundled.models import SETS, BundledModel, list_models


def license_models(command: TrainAll, models: Sequence[BundledModel]) -> list[BundledModel]:
    """Give models the licence that is asked for; else that of their set, if all clips that any model of it sees are the
    set's own, or that of the training data. RequestError for clips that are known not to be free, under a free one.
    """
    clips = _find_clips(command.data, list_models(command.weights, match=command.match))
    of_set = SETS[command.weights]
    own = all(re.search(of_set.own, clip) for clip in clips)
    licence = command.licence or (of_set.licence if own else OF_DATA)
    if licence in FREE:
        for clip in clips:
            if (told := find_unfree(clip)) is not None:
                raise RequestError(f"{clip} is not free (by {told!r}); weights that are {licence} must not see it")
    return [replace(model, recipe=replace(model.recipe, licence=licence)) for model in models]


def _find_clips(data: Path | None, models: Sequence[BundledModel]) -> list[str]:
    """Find the paths below the data folder of all clips that any of the models is trained on; a refiner sees those of
    its density."""
    if data is None:
        return []
    paths = sorted(file.relative_to(data).as_posix() for file in data.rglob("*") if file.suffix.lower() == ".bvh")
    patterns = {model.recipe.match or "" for model in models if "--density" not in model.needs}
    return [path for path in paths if any(re.search(pattern, path) for pattern in patterns)]
