"""Weights on disk: safetensors with a JSON card beside them. Nothing is ever unpickled.

The card holds the configuration, the fingerprint of the feature layout, seed, data and licence, the training curve and
the measured quality. A card that does not fit the code is refused with both layouts printed.
"""

import json
import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, ClassVar, Generic, TypeVar

import torch
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, TypeAdapter, ValidationError
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from mapctl.errors import CheckpointError, RequestError
from mapctl.features import LAYOUT
from mapctl.formats import toml
from mapctl.formats.atomic import atomic_path
from mapctl.formats.text import one_line, shorten
from priors import weight_sets

_SYSTEM_ERROR = re.compile(r"\(os error (\d+)\)")


def write_tensors(path: Path, tensors: Mapping[str, Tensor], *, metadata: Mapping[str, str] | None = None) -> None:
    """Write a file that appears whole or not at all; RequestError where it cannot be written, as on a full disk."""
    contiguous = {name: tensor.cpu().contiguous() for name, tensor in tensors.items()}
    with atomic_path(path) as scratch:
        try:
            save_file(contiguous, scratch, metadata=dict(metadata) if metadata else None)
        except SafetensorError as error:
            # The library's own kind of error, with the system's error number in words.
            found = _SYSTEM_ERROR.search(str(error))
            raise OSError(int(found[1]), os.strerror(int(found[1]))) if found else OSError(str(error)) from error


N = TypeVar("N", bound=nn.Module)
M = TypeVar("M", bound="NetworkModel[Any]")


class _MotionClass(BaseModel):
    clips: int
    vector: str


class _TrainingData(BaseModel):
    """Keys of a card's `data` that are read again; the others are documentation."""

    model_config = ConfigDict(strict=True)

    starts: list[str] = []
    labels: re.Pattern[str] = re.compile("")
    holds: dict[str, Any] = {}
    match: str = ""
    classes: dict[str, _MotionClass] = {}


def _check_data(data: dict[str, Any]) -> dict[str, Any]:
    _TrainingData.model_validate(data)
    return data


@dataclass(frozen=True, repr=False)
class Card:
    """Card of a set of weights."""

    __pydantic_config__ = toml.STRICT

    kind: str
    """Kind of network: `lstm-gmm` and so on."""
    config: dict[str, Any]
    """The network's settings."""
    layout: list[list[Any]] = field(default_factory=lambda: [list(block) for block in LAYOUT.blocks])
    """Blocks of the feature vector: name and width; those of this code if not given."""
    fingerprint: str = field(default_factory=LAYOUT.fingerprint)
    """Fingerprint of the feature layout."""
    licence: str = field(kw_only=True)
    """Licence of the weights."""
    data: Annotated[dict[str, Any], AfterValidator(_check_data)] = field(default_factory=dict)
    """Training data: clips, frames, attribution, split seed."""
    training: dict[str, Any] = field(default_factory=dict)
    """Recipe, seed, steps, command and curve."""
    quality: dict[str, Any] = field(default_factory=dict)
    """Measured quality and the command that printed it."""
    abilities: dict[str, float] = field(default_factory=dict)
    """Limits of speed (m/s) and turning (rad/s) that the data show, by their names in `DataLimits`."""

    def __repr__(self) -> str:
        return f"<Card: {self.kind}, {self.licence or 'without a licence'}>"


class LoadedModel:
    """A model with its name and card, which print as one line: the network's weights would fill pages."""

    name: str
    """Name, file or run folder by which it was requested."""
    card: Card
    """Card of the weights."""

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields alone for a pickle or a copy, which computes again what is cached."""
        return {field.name: getattr(self, field.name) for field in fields(self)}  # pyright: ignore[reportArgumentType]

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self.name}, {self.card.licence or 'without a licence'}>"


@dataclass(frozen=True, eq=False, repr=False)
class NetworkModel(LoadedModel, Generic[N]):
    """A trained network with its name and card."""

    kind: ClassVar[str]
    """Kind of network in its card."""
    parts: ClassVar[tuple[Callable[..., Any], "type[NetworkConfig]"]]
    """Classes of the network and of its shape."""

    name: str
    """Name, file or run folder by which it was requested."""
    network: N
    """Network with its weights, in evaluation mode."""
    card: Card
    """Card of the weights."""

    @classmethod
    def load(cls: type[M], name: str) -> M:
        """Load a bundled model, or a trained one by its file or run folder; CheckpointError for anything else."""
        make, config = cls.parts
        with open_checkpoint(name, cls.kind) as (tensors, card):
            return cls(name, build_network(make, config.of_card(card.config), tensors), card)


def save(tensors: dict[str, Tensor], card: Card, path: Path, *, half: bool = True) -> None:
    """Write `path` (.safetensors) and its card (.json beside it); float16 unless `half` is false.

    CheckpointError, and nothing written, for a card that holds NaN or infinity, which JSON does not know.
    """
    try:
        text = json.dumps(vars(card), indent=1, allow_nan=False) + "\n"
    except ValueError as error:
        raise CheckpointError(f"cannot write {path}: it would hold a number that is not finite ({error})") from error
    kept = {
        name: t.half() if half and t.is_floating_point() and name not in ("mean", "std") else t
        for name, t in tensors.items()
    }
    # The card is written first and renamed last: a full disk leaves neither file, nor one that fits no other.
    with atomic_path(path.with_suffix(".json")) as scratch:
        scratch.write_text(text, encoding="utf-8")
        write_tensors(path, kept)


def load(path: Path) -> tuple[dict[str, Tensor], Card]:
    """Load tensors in float32 and the card; CheckpointError if either is missing, broken or of another layout."""
    card = read_card(path.with_suffix(".json"))
    if card.fingerprint != LAYOUT.fingerprint():
        ours = [list(block) for block in LAYOUT.blocks]
        raise CheckpointError(f"{path}: its features are {card.layout}, this code's are {ours}")
    try:
        tensors = {name: t.float() if t.is_floating_point() else t for name, t in load_file(path).items()}
    except Exception as error:  # of a forged header the library raises whatever it meets, KeyError and the like
        raise CheckpointError(f"{path}: no readable safetensors file ({one_line(error)})") from error
    if wrong := [name for name, tensor in tensors.items() if not tensor.isfinite().all()]:
        raise CheckpointError(f"{path}: the tensor {shorten(wrong[0])} is not finite")
    return tensors, card


@contextmanager
def open_checkpoint(name: str, kind: str, *, called: str | None = None) -> Iterator[tuple[dict[str, Tensor], Card]]:
    """Open tensors and card of a bundled name, a file or a run folder, to build the network within.

    CheckpointError for weights of another kind than this, which messages call `called`, and where what is built of the
    card does not take the tensors.
    """
    path = locate(name)
    tensors, card = load(path)
    if card.kind != kind:
        raise CheckpointError(f"{path}: a {card.kind[:40]} is no {called or kind}")
    _note_card(name, path, card)
    try:
        yield tensors, card
    except (ArithmeticError, LookupError, TypeError, ValueError, RuntimeError, RequestError) as error:
        raise CheckpointError(f"{path}: its tensors do not fit its card ({one_line(error, 300)})") from error


def build_network(make: Callable[..., N], config: Any, tensors: dict[str, Tensor]) -> N:
    """Make a network of this shape and give it the tensors, to be used as it is; RuntimeError where they do not fit.

    It is made on the meta device, where a card's numbers take no memory.
    """
    with torch.device("meta"), _WithoutDraws():
        network = make(config)
    network.load_state_dict(tensors, assign=True)
    return network.eval().requires_grad_(False)


class _WithoutDraws(TorchFunctionMode):
    """Leave initial weights undrawn: on the meta device that, as powers and torch.eye, imports torch's compiler, which
    takes a second."""

    def __torch_function__(
        self, func: Callable[..., Any], types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        is_draw = getattr(func, "__module__", None) == nn.init.__name__
        return kwargs["tensor"] if is_draw and kwargs else func(*args, **kwargs or {})


def read_card(path: Path) -> Card:
    """Read the card alone."""
    try:
        return TypeAdapter(Card).validate_json(path.read_bytes(), strict=True)
    except ValidationError as error:
        raise CheckpointError(f"{path}: no readable card ({toml.describe_fault(error, Card)})") from error
    except OSError as error:
        raise CheckpointError(f"{path}: no readable card ({error})") from error


def locate(name: str) -> Path:
    """Locate the safetensors file of a bundled name, of a path, or of a training run's folder.

    A bundled name is one of the set of weights in force, unless it names its set (see `weight_sets`), whatever lies in
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
    """Compute a short hash of a model's weights, by which other models refer to it."""
    return sha256(locate(name).read_bytes()).hexdigest()[:12]


def note_use(name: str) -> None:
    """Note the licence of a model that another process loads; CheckpointError if there is none."""
    path = locate(name)
    _note_card(name, path, read_card(path.with_suffix(".json")))


def _note_card(name: str, path: Path, card: Card) -> None:
    """Note a model's licence; CheckpointError where it lies in the free set and is not free."""
    weights = weight_sets.find_set_of(path)
    known = path.stem if weights == weight_sets.SETS[0] else f"{weights}/{path.stem}"
    if weights == "free" and card.licence not in weight_sets.FREE:
        raise CheckpointError(f"{known} lies with the free weights, and its licence is {card.licence!r}")
    weight_sets.note_licence(
        name if weights is None else known, " ".join(card.licence.split()) or weight_sets.NO_LICENCE
    )


C = TypeVar("C", bound="NetworkConfig")
Size = Annotated[int, Field(ge=1, le=4096)]
"""A width, or a number of layers, in a shape."""
Sizes = Annotated[tuple[Size, ...], Field(min_length=1, max_length=64)]


@dataclass(frozen=True)
class NetworkConfig:
    """Shape of a network. Its subclasses are frozen dataclasses whose fields all have defaults."""

    __pydantic_config__ = toml.STRICT
    FIXED: ClassVar[Mapping[str, Any]] = {}
    """Entries of cards that are no choice: the only value that each may have."""

    def as_card(self) -> dict[str, Any]:
        """Convert to a card's JSON, which has no tuples."""
        return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()}

    @classmethod
    def of_card(cls: type[C], config: Mapping[str, Any]) -> C:
        """Invert `as_card`; RequestError for fields that are not these, of another type or absurdly large."""
        free = {name: value for name, value in config.items() if cls.FIXED.get(name, ...) != value}
        try:
            return TypeAdapter(cls).validate_json(json.dumps(free), strict=True)
        except ValidationError as error:
            raise RequestError(toml.describe_fault(error, cls)) from error


def require_at_least(settings: Any, least: int, *names: str) -> None:
    """Raise RequestError unless each of these fields is at least so much."""
    for name in names:
        if getattr(settings, name) < least:
            raise RequestError(f"{name} must be at least {least}, got {getattr(settings, name)}")
