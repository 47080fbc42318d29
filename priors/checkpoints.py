"""Weights on disk: safetensors with a JSON card beside them. Nothing is ever unpickled.

The card holds the configuration, the fingerprint of the feature layout, seed, data and licence, the training curve and
the measured quality. A card that does not fit the code is refused with both layouts printed.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from mapctl.errors import CheckpointError, RequestError
from mapctl.features import LAYOUT
from mapctl.formats.atomic import atomic_path
from priors import licences, weight_sets
from priors.tensor_files import write_tensors


@dataclass(frozen=True, repr=False)
class Card:
    """Card of a set of weights."""

    kind: str
    """Kind of network: `lstm-gmm` and so on."""
    config: dict[str, Any]
    """The network's settings."""
    layout: list[list[Any]]
    """Blocks of the feature vector: name and width."""
    fingerprint: str
    """Fingerprint of the feature layout."""
    licence: str
    """Licence of the weights."""
    data: dict[str, Any] = field(default_factory=dict)
    """Training data: clips, frames, attribution, split seed."""
    training: dict[str, Any] = field(default_factory=dict)
    """Recipe, seed, steps, command and curve."""
    quality: dict[str, Any] = field(default_factory=dict)
    """Measured quality and the command that printed it."""
    abilities: dict[str, float] = field(default_factory=dict)
    """Limits of speed (m/s) and turning (rad/s) that the data show, by their names in `DataLimits`."""

    def __str__(self) -> str:
        return f"Card: {self.kind}, {self.licence or 'without a licence'}"

    def __repr__(self) -> str:
        return f"<{self}>"

    @staticmethod
    def layout_fields() -> dict[str, Any]:
        """Return the two layout fields for the features of this code."""
        return {"layout": [list(block) for block in LAYOUT.blocks], "fingerprint": LAYOUT.fingerprint()}


class LoadedModel:
    """A model with its name and card, which print as one line: the network's weights would fill pages."""

    name: str
    """Name, file or run folder by which it was asked for."""
    card: Card
    """Card of the weights."""

    def __str__(self) -> str:
        return f"{type(self).__name__}: {self.name}, {self.card.licence or 'without a licence'}"

    def __repr__(self) -> str:
        return f"<{self}>"


def save(tensors: dict[str, Tensor], card: Card, path: Path, *, half: bool = True) -> None:
    """Write `path` (.safetensors) and its card (.json beside it); float16 unless `half` is false.

    CheckpointError, and nothing written, for a card that holds NaN or infinity, which JSON does not know.
    """
    text = encode_json(vars(card), path, indent=1)
    kept = {
        name: t.half() if half and t.is_floating_point() and name not in ("mean", "std") else t
        for name, t in tensors.items()
    }
    # The card is written first and renamed last: a full disk leaves neither file, nor one that fits no other.
    with atomic_path(path.with_suffix(".json")) as scratch:
        scratch.write_text(text, encoding="utf-8")
        write_tensors(path, kept)


def encode_json(values: dict[str, Any], path: Path, *, indent: int | None = None) -> str:
    """Encode the JSON that every parser reads; CheckpointError, naming the file it was for, where a number is not
    finite."""
    try:
        return json.dumps(values, indent=indent, allow_nan=False) + "\n"
    except ValueError as error:
        raise CheckpointError(f"cannot write {path}: it would hold a number that is not finite ({error})") from error


def load(path: Path) -> tuple[dict[str, Tensor], Card]:
    """Load tensors in float32 and the card; CheckpointError if either is missing, broken or of another layout."""
    card = read_card(path.with_suffix(".json"))
    if card.fingerprint != LAYOUT.fingerprint():
        ours = [list(block) for block in LAYOUT.blocks]
        raise CheckpointError(f"{path}: its features are {card.layout}, this code's are {ours}")
    try:
        tensors = load_file(path)
    except (OSError, SafetensorError) as error:
        raise CheckpointError(f"{path}: no readable safetensors file ({error})") from error
    return {name: t.float() if t.is_floating_point() else t for name, t in tensors.items()}, card


@contextmanager
def open_checkpoint(name: str, kind: str, *, called: str | None = None) -> Iterator[tuple[dict[str, Tensor], Card]]:
    """Open tensors and card of a bundled name, a file or a run folder, to build the network within.

    CheckpointError for weights of another kind than this, which messages call `called`, and where what is built of the
    card does not take the tensors.
    """
    path = locate(name)
    tensors, card = load(path)
    if card.kind != kind:
        raise CheckpointError(f"{path}: a {card.kind} is no {called or kind}")
    _note_card(name, path, card)
    try:
        yield tensors, card
    except (KeyError, TypeError, RuntimeError, RequestError) as error:
        raise CheckpointError(f"{path}: its tensors do not fit its card ({' '.join(str(error).split())})") from error


def read_card(path: Path) -> Card:
    """Read the card alone."""
    try:
        return Card(**json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError) as error:
        raise CheckpointError(f"{path}: no readable card ({error})") from error


def list_bundled() -> list[str]:
    """List names of the priors that come with the package, in the set of weights that is in force."""
    return weight_sets.list_models()


def locate(name: str) -> Path:
    """Locate the safetensors file of a bundled name, of a path, or of a training run's folder.

    A bundled name is one of the set of weights in force, unless it says its set (see `weight_sets`), whatever lies in
    the current folder; CheckpointError where that set has no such model, though another one may.
    """
    path = Path(name)
    if not weight_sets.means_bundled(name):
        for candidate in (path, path / "model.safetensors", Path(f"{name}.safetensors")):
            if candidate.is_file() and candidate.suffix == ".safetensors":
                return candidate
    found = weight_sets.find_file(name)
    if found is None:
        raise weight_sets.explain_missing(name)
    return found


def compute_hash(name: str) -> str:
    """Compute a short hash of a model's weights, by which those that were made with it name it."""
    return sha256(locate(name).read_bytes()).hexdigest()[:12]


def note_use(name: str) -> None:
    """Note the licence of a model that somebody else loads, as a process; CheckpointError if there is none."""
    path = locate(name)
    _note_card(name, path, read_card(path.with_suffix(".json")))


def _note_card(name: str, path: Path, card: Card) -> None:
    """Note a model's licence; CheckpointError where it lies in the free set and is not free."""
    weights = weight_sets.find_set_of(path)
    known = path.stem if weights == weight_sets.SETS[0] else f"{weights}/{path.stem}"
    if weights == "free":
        licences.check_free(known, card.licence, {"data": card.data, "training": card.training})
    licences.note_licence(name if weights is None else known, " ".join(card.licence.split()) or licences.NONE_TOLD)
