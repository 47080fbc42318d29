"""A folder of finished models in the form in which they come with mapctl: NAME.safetensors with NAME.json beside it."""

import json
import math
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from mapctl.errors import CheckpointError
from mapctl.formats.atomic import atomic_path, write_text
from priors import checkpoints
from priors.checkpoints import Card
from priors.training.bundled.models import RECIPES, BundledModel

MOST_BYTES = 64_000_000
"""Of a set, and of all bundled files together."""


@dataclass(frozen=True)
class Finished:
    """What is told of a finished model."""

    name: str
    """As commands call it."""
    card: Card
    """Its own."""
    size: int
    """Bytes of weights and card."""

    @property
    def minutes(self) -> float | None:
        """Minutes of one core that its training took; None where it was not limited."""
        return self.card.training.get("ended", {}).get("minutes")

    @property
    def steps(self) -> int | None:
        """Steps that were taken."""
        settings = self.card.training.get("settings", {})
        known = self.card.training.get("ended", {}).get("steps") or settings.get("steps") or settings.get("rounds")
        return None if known is None else int(known)

    @property
    def why(self) -> str:
        """Why training ended."""
        return self.card.training.get("ended", {}).get("reason", "all steps are done")

    @property
    def quality(self) -> tuple[float, str]:
        """The one number that says how good it is on unseen clips, and what it is; NaN where the card lacks it."""
        recipe = RECIPES.get(self.card.kind)
        return (math.nan, "") if recipe is None else (recipe.find_card_headline(self.card.quality), recipe.headline)

    @property
    def minutes_of_motion(self) -> float:
        """Minutes of motion that it was trained on; NaN where the card is older than that it tells."""
        return float(self.card.data.get("trained_on", {}).get("minutes", math.nan))

    @property
    def log_error(self) -> float:
        """Logarithm of its error on unseen clips, up to a constant of its kind; NaN where the card lacks it."""
        recipe = RECIPES.get(self.card.kind)
        return math.nan if recipe is None else recipe.as_log_error(self.quality[0])

    @property
    def held_out(self) -> object:
        """Names of the clips that training did not see; those of a refiner are its density's."""
        return self.card.data.get("held_out", self.card.data.get("density"))

    def find_change(self, other: "Finished") -> float:
        """By how many percent the other's error is larger than this one's; NaN where a card tells too little."""
        return 100 * math.expm1(other.log_error - self.log_error)


def read_finished(name: str, path: Path) -> Finished:
    """Read a finished model's card; CheckpointError where it is damaged, or the weights are missing."""
    card_path = path.with_suffix(".json")
    card = checkpoints.read_card(card_path)
    if not path.is_file():
        raise CheckpointError(f"{path}: the weights of {card_path} are missing")
    return Finished(name, card, path.stat().st_size + card_path.stat().st_size)


def is_finished(run: Path) -> bool:
    """Whether a run folder holds a finished model."""
    return (run / "model.safetensors").is_file() and (run / "model.json").is_file()


def copy_model(model: BundledModel, run: Path, folder: Path) -> Path:
    """Copy a finished run's weights and card as NAME.safetensors and NAME.json; the card calls the models that this one
    needed by their names."""
    card = checkpoints.read_card(run / "model.json")
    target = folder / f"{model.name}.safetensors"
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_path(target) as scratch:
        shutil.copyfile(run / "model.safetensors", scratch)
    text = json.dumps(vars(name_needs(card, model.needs)), indent=1, allow_nan=False) + "\n"
    write_text(target.with_suffix(".json"), text)
    return target


def name_needs(card: Card, needs: Mapping[str, str]) -> Card:
    """The card, with the names of models instead of the folders that training took them from."""
    data, command = dict(card.data), card.training["command"]
    if "--density" in needs:
        command = command.replace(f"--density {data['density']}", f"--density {needs['--density']}")
        data["density"] = needs["--density"]
    if "--stitcher" in needs:
        command = command.replace(f" --stitcher {data['stitcher']}", "")
        data["stitcher"] = needs["--stitcher"]
    command = command.replace(" --path PATH", "") if needs.get("--path") == "path" else command
    return replace(card, data=data, training={**card.training, "command": command})
