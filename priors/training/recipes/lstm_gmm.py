"""What the LSTM-GMM is trained on, and what of it is written (Wang et al. 2019)."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import torch

from mapctl.errors import RequestError
from mapctl.features import LAYOUT
from priors.config import require_at_least
from priors.lstm_gmm import density, labels
from priors.lstm_gmm.network import LstmGmmConfig
from priors.lstm_gmm.paces import PACE_LABELS
from priors.stitching import inbetweener
from priors.training.augmentation.clip_copies import add_copies
from priors.training.augmentation.splices import Splices, drop_splices, hide_splices
from priors.training.corpus import Corpus, Split
from priors.training.devices import make_generator, use_device
from priors.training.gathering import DataSource, describe_selection, find_split_seed, name_origin
from priors.training.initial_states import measure_data_limits, select_initial_states
from priors.training.mocap.holdings import measure_holdings
from priors.training.mocap.paces import follow_paces
from priors.training.quality import density as density_quality
from priors.training.recipe import Export, Gathered, Recipe, Row, average
from priors.training.recipes.density.settings import PAPER, PLAIN, TrainingSettings
from priors.training.recipes.density.trainer import DensityTrainer


@dataclass(frozen=True)
class DensityRecipe(Recipe[LstmGmmConfig, TrainingSettings, DensityTrainer]):
    """What to train a density on, and how."""

    kind = "lstm-gmm"
    headline = "nats a frame"
    decay_cost = 1.4  # free runs are compared
    config: LstmGmmConfig = field(default_factory=LstmGmmConfig)
    """The network."""
    settings: TrainingSettings = field(default_factory=TrainingSettings)
    """How it is trained."""
    starts: int = 64
    """Moments of mocap that the finished prior carries."""
    made: Path | None = None
    """Folder of clips that `mapctl make` made, which are trained on as well."""
    splices: Splices = field(default_factory=Splices)
    """Splices of the clips, which are trained on as well."""
    labels: str = ""
    """Regular expression whose named groups read labels from a clip's path, to condition the density on."""
    label_pace: bool = False
    """Whether the pace is a label as well: stand, walk or run, by how a window ends. It is where training begins with a
    prior that knows paces."""
    init: str | None = None
    """Prior whose weights and statistics training begins with; the network is then that prior's."""

    def __post_init__(self):
        super().__post_init__()
        require_at_least(self, 1, "starts")
        if self.label_pace and "(?P<pace>" in self.labels:
            raise RequestError("the group pace is that of --label-pace; call the one of --labels by another name")

    def check(self) -> None:
        """Before anything is read."""
        super().check()
        if self.settings.critic.steps and self.until_flat is not None:
            raise RequestError("a critic joins a run of a known length: leave out --until-flat or --critic-steps")
        if self.splices.count:
            inbetweener.load(self.splices.stitcher)  # a wrong name shall not be told after all clips were read

    def source(self) -> DataSource:
        """Where motion comes from."""
        return replace(super().source(), made=self.made, splices=replace(self.splices, seed=self.settings.seed))

    def make_trainer(self, parts: Split) -> DensityTrainer:
        """Make the trainer of a new network for the clips' labels, or of the initial network with its own labels."""
        with use_device("cpu"):  # copies are made one after the other
            seeded = make_generator(self.settings.seed)
            copied = add_copies(parts.train.to("cpu"), self.settings.copies, seeded)
            followed = follow_paces(copied) if self.label_pace or self.init is not None else None
        corpus = copied.to(torch.get_default_device().type)
        known = labels.read(hide_splices(corpus.names), self.labels)
        followed = None if followed is None else followed.to(corpus.features.device)
        if self.init is None:
            known = known.renamed((*known.names, *PACE_LABELS)) if self.label_pace else known
            config = replace(self.config, labels=known.names)
            return DensityTrainer(config, self.settings, corpus, labels=known, paces=followed)
        before = density.load(self.init).reference
        known, paces = known.renamed(before.config.labels), None
        if {*PACE_LABELS} <= {*known.names}:
            paces = followed
        elif self.label_pace:
            raise RequestError(f"the prior {self.init!r} was not trained with labels of paces; leave --label-pace out")
        return DensityTrainer(before.config, self.settings, corpus, labels=known, paces=paces, init=before.state_dict())

    def list_teachers(self) -> tuple[str, ...]:
        """Models that the weights begin with or learn from, bundled or trained."""
        return super().list_teachers() + ((self.splices.stitcher,) if self.splices.count else ())

    def find_shape(self, trainer: DensityTrainer) -> LstmGmmConfig:
        """Return the configuration of the network that is trained."""
        return trainer.network.config

    def describe_data(self, corpus: Corpus) -> dict[str, str]:
        """What tells the data of this run from others'."""
        return corpus.identity() | {
            "match": self.match or "",
            "split seed": str(self.settings.seed if self.split is None else self.split),
            "labels": self.labels,
            "init": self.init or "",
            **({"paces": "labels"} if self.label_pace else {}),
            **self._describe_splices(),
        }

    def format_news(self, rows: Sequence[Row]) -> str:
        """One line on the losses of some steps."""
        news = f"{average(rows, 'loss'):.2f} nats"
        return f"{news}, {average(rows, 'told'):.2f} told apart" if "told" in rows[-1] else news

    @classmethod
    def find_headline(cls, row: Row) -> float:
        """Negative log density of unseen clips, nats a frame."""
        return _number(row.get("validation_nats"))

    @classmethod
    def find_card_headline(cls, quality: Row) -> float:
        """Find it in the quality that a card tells."""
        return _number(quality.get("test_nats_per_frame"))

    @classmethod
    def as_log_error(cls, value: float) -> float:
        """Nats by the numbers of a frame: the logarithm of how far each is off, up to a constant."""
        return value / LAYOUT.continuous

    @property
    def split_seed(self) -> int:
        """That of the initial weights, where there are any."""
        return find_split_seed(self.init, self.settings.seed, self.split)

    def export(self, trainer: DensityTrainer, gathered: Gathered, curve: Sequence[Row]) -> Export:
        """The network with moments to start from, and what the data show to be possible."""
        model, corpus, parts = trainer.average.eval(), gathered.corpus, gathered.parts
        clips, seeded = drop_splices(parts.train), make_generator(self.settings.seed)
        known = labels.read(clips.names, self.labels)
        found = select_initial_states(model, clips, count=self.starts, generator=seeded, labels=known.held)
        data = {
            "clips": len(corpus.names),
            "frames": len(corpus.features),
            **describe_selection(corpus),
            "holds": measure_holdings(corpus),
            "match": self.match or "",
            "labels": self.labels,
            **self._describe_splices(),
            "split_seed": self.split_seed,
            "starts": list(found.names),
            "held_out": gathered.held_out(),
        }
        return Export(
            {
                **model.state_dict(),
                "starts.previous": found.state.last_frame,
                "starts.hidden": found.state.hidden,
                "starts.cell": found.state.cell,
                "starts.speed": found.speed,
                "starts.weight": found.weight,
            },
            data,
            density_quality.measure_quality(model, parts),
            asdict(measure_data_limits(clips)),
        )

    def format_command(self) -> str:
        """What to type for the same run, for the card; options that are the defaults are left out."""
        option, config, settings = self._find_variant()
        parts = [f"mapctl train lstm-gmm --data DATA -o RUN --match '{self.match or ''}'"]
        parts += [f"--labels '{self.labels}'"] if self.labels else []
        parts += ["--label-pace"] * self.label_pace
        parts += [f"--init {name_origin(self.init)}"] if self.init else [f"--width {self.config.width}"]
        mixed = self.init is None and self.config.components != config.components
        parts += [f"--components {self.config.components}"] if mixed else []
        parts += ["--made MADE"] if self.made else []
        parts += self.format_reading() + ["--bfloat16"] * self.settings.bfloat16
        parts += self.format_changed(settings, "steps", "batch", "window", "learning_rate", "standing_share", "seed")
        critic = self.settings.critic.steps
        parts += [f"--critic-steps {critic}"] if critic else []
        parts += self.settings.copies.format_options() + self.splices.format_options()
        parts += self.format_processes() + self.format_ending()
        return " ".join(parts + option)

    def _describe_splices(self) -> dict[str, str]:
        """How many were tried, and by which stitcher; nothing where there are none."""
        splices = self.splices
        return {"splices": str(splices.count), "stitcher": splices.stitcher} if splices.count else {}

    def _find_variant(self) -> tuple[list[str], LstmGmmConfig, TrainingSettings]:
        """The option of the variant that this is one of, and what the command takes with it alone."""
        for option, (config, settings) in (("--paper", PAPER), ("--plain", PLAIN)):
            shape = {"width": self.config.width, "components": self.config.components, "labels": self.config.labels}
            if self.init is None and replace(config, **shape) == self.config:
                return [option], config, settings
        return [], LstmGmmConfig(), TrainingSettings()


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)
