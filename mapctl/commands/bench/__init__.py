"""`mapctl bench TABLE`: what the solver costs on this machine, and what each job is worth; a sub-command a table."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from tyro.conf import arg

from mapctl.commands.shared import options
from mapctl.commands.shared.command import Command, ModelCommand


@dataclass(frozen=True, kw_only=True)
class Table(ModelCommand):
    """What every table is asked."""

    tells_licence: ClassVar[bool] = False

    json: bool = False
    """Print JSON instead of a table."""


@dataclass(frozen=True, kw_only=True)
class ComparedTable(Table):
    """A table that other models of the same kind may be in."""

    baselines: Annotated[str, arg(metavar="RUN,RUN,...")] = ""
    """Other models of the kind to compare, bundled or trained; each row then names its model."""


@dataclass(frozen=True, kw_only=True)
class PriorTable(Table):
    """A table of one density."""

    prior: options.Name = "locomotion"
    """A bundled prior, or the file or run folder of a trained one."""


@dataclass(frozen=True, kw_only=True)
class MocapTable(Table):
    """A table over clips that were kept from training."""

    data: options.DataFolder
    """The folder that was trained on, for the clips that were held out."""
    count: options.Count = 48
    """Clips, spread over the kinds."""
    clips: Annotated[str, arg(metavar="REGEX")] = ""
    """Of these clips, those whose paths hold this: of two models, those that neither was trained on."""
    inbetweener: options.Name = "transformer"
    """The bundled transformer, or the file or run folder of a trained transformer or infiller."""


@dataclass(frozen=True, kw_only=True)
class Speed(PriorTable):
    """Milliseconds a frame, fast path and reference; or this version and another in turn."""

    work = "mapctl.commands.bench.speed"

    beside: options.MaybeDataFolder = None
    """A checkout of another version, as `git worktree add DIR COMMIT` makes it, whose steering, following and start-up
    are timed in turn with these."""
    turns: options.Count = 8
    """How often both take their turn."""


@dataclass(frozen=True, kw_only=True)
class Ablation(PriorTable):
    """Starts and unknowns of the solver compared."""

    work = "mapctl.commands.bench.ablation"

    shots: options.Count = 0
    """Instead of walks along curves: the first and last steps of so many random shots, chosen in several ways."""


@dataclass(frozen=True, kw_only=True)
class Follow(PriorTable, ComparedTable):
    """Curves walked by densities with the solver, and by motion matching over the clips that they were trained on."""

    work = "mapctl.commands.bench.follow"

    data: options.MaybeDataFolder = None
    """The folder that was trained on, for motion matching; without it that is left out."""
    count: options.Count = 3
    """Walks of each curve."""


@dataclass(frozen=True, kw_only=True)
class FreeRun(PriorTable, ComparedTable):
    """8 random motions of 10,000 frames beside the training data."""

    work = "mapctl.commands.bench.free_run"


@dataclass(frozen=True, kw_only=True)
class Generation(PriorTable, ComparedTable):
    """Raw, refined and finished motion beside mocap that training did not see."""

    work = "mapctl.commands.bench.generation"

    data: options.DataFolder
    """The folder that was trained on, for the clips that were held out."""
    count: options.Count = 48
    """Clips of 10 s to draw."""
    refiner: options.Name = "auto"
    """A bundled refiner, or the file or run folder of a trained one; auto is the prior's own."""
    baselines: Annotated[str, arg(metavar="RUN,RUN,...")] = ""
    """Other densities, and other refiners of this one, to compare, bundled or trained."""


@dataclass(frozen=True, kw_only=True)
class Steer(PriorTable, ComparedTable):
    """Random commands: which are reached, and how soon; or places to reach in passing, and discs to walk round."""

    work = "mapctl.commands.bench.steer"

    prior: options.Name = "locomotion-live"
    """A bundled prior, or the file or run folder of a trained one."""
    count: options.Count = 48
    """Commands to give, or walks of each kind."""
    targets: bool = False
    """Hands that reach and discs that are walked round, instead of speeds and directions."""


@dataclass(frozen=True, kw_only=True)
class Live(PriorTable):
    """Random commands against the wall clock, for several characters at once."""

    work = "mapctl.commands.bench.live"

    prior: options.Name = "locomotion-live"
    """A bundled prior, or the file or run folder of a trained one."""
    minutes: options.Number = 0.5
    """How long each number of characters is steered."""
    characters: Annotated[str, arg(metavar="N,N,...")] = "1,2,4"
    """How many at once, one number after the other."""
    find_most: bool = False
    """Find how many this machine carries with no frame late instead: twice as many each time, then between."""
    orders: options.MaybeNumber = None
    """Order one character to be somewhere every so many seconds instead, and measure how it obeys."""
    stitcher: options.Name = "stitcher"
    """Who makes the ways to these places: the bundled stitcher, or the file or run folder of a trained one."""


@dataclass(frozen=True, kw_only=True)
class Tween(MocapTable, ComparedTable):
    """Clips that training did not see, of which keys are left, and such clips without their ends."""

    work = "mapctl.commands.bench.tween"

    prior: options.Name = "auto"
    """What rollouts are drawn from: a bundled prior, the file or run folder of a trained one, or auto."""


@dataclass(frozen=True, kw_only=True)
class Tweener(Table):
    """The tables of Zhou et al. 2020 over clips that training did not see, all or some of them: how well the hips'
    trajectory is told, long gaps, keys that are missed or no whole poses, seconds told from mocap, and speed."""

    work = "mapctl.commands.bench.tweener.run"

    data: options.DataFolder
    """The folder that was trained on, for the clips that were held out."""
    part: Annotated[str, arg(metavar="PART,PART,...")] = "all"
    """Tables to measure: path (table 2), gaps (between two poses of a clip), spectrum (speed by frequency in these
    gaps, figure 8), keys (table 4, before they are made exact, and gaps with a past), partial (halves, places and
    drawings every 2 s), apart (made seconds told from mocap's), dna (the same keys under that of several clips), speed
    (table 3)."""
    count: options.Count = 300
    """Clips, spread over the kinds."""
    path: options.Name = "path"
    """The bundled path predictor, or the file or run folder of a trained one."""
    tweener: options.Name = "tweener"
    """The bundled tweener, or the file or run folder of a trained one."""
    baselines: Annotated[str, arg(metavar="RUN,RUN,...")] = ""
    """Other in-betweeners to compare, bundled or trained."""
    seconds: Annotated[str, arg(metavar="S,S,...")] = "6.4"
    """Long gaps, seconds."""
    dna: options.Count = 0
    """Clips of different content whose motion DNA the same keys 8 s apart are put under, 12 if 0; with a number
    and no --part it is all that is measured."""
    sequences: options.Count = 200
    """Sequences of keys of several clips, each of --frames; a tenth as many are told apart from mocap."""
    frames: options.Count = 2048
    """Frames of each such sequence at 30 a second; the longest one whose speed is measured has twice as many."""
    raw: bool = False
    """Leave out the rows that a MAP stage finishes."""
    markdown: bool = False
    """Print rows as a page's table in Markdown holds them."""


@dataclass(frozen=True, kw_only=True)
class Representation(Table):
    """Table 1 of Zhou et al. 2020: which numbers a network should tell rotations by. Networks are trained here, half an
    hour in all, and measured on clips that they do not see."""

    work = "mapctl.commands.bench.tweener.representation"

    data: options.DataFolder
    """Folder of .bvh files, searched below."""
    steps: options.Count = 20_000
    """Training steps of each network."""
    seed: options.Count = 1
    """Seed of what is held out, weights, poses and headings."""
    cache: options.MaybeDataFolder = None
    """Folder of a training run's clips as features (RUN/cache), which take minutes to read."""


@dataclass(frozen=True, kw_only=True)
class Timing(MocapTable):
    """Pairs of poses of such clips, and the time between them that `mapctl tween --suggest-timing` would suggest."""

    work = "mapctl.commands.bench.timing"


@dataclass(frozen=True, kw_only=True)
class Transitions(Table):
    """Gaps of such clips by LaFAN1's protocol: errors beside slerp and retrieval, feet, jitter and the worst frame."""

    work = "mapctl.commands.bench.transitions"

    data: options.DataFolder
    """The folder that was trained on, for the clips that were held out."""
    count: options.Count = 100
    """Clips, spread over the kinds."""
    past: Annotated[Literal["1", "10", "all"], arg(metavar="1|10|all")] = "10"
    """Frames that are known before a gap, one being known after it; all shows the whole clip."""
    inbetweener: options.Name = "transformer"
    """The bundled transformer, or the file or run folder of a trained transformer or infiller."""
    baselines: Annotated[str, arg(metavar="RUN,RUN,...")] = ""
    """Other in-betweeners to compare, bundled or trained."""
    stitcher: str = ""
    """Stitchers, bundled, by file or run folder, with commas between: calm answer, one draw and the best of 8 by the
    truth, beside 8 of retrieval's, and how far they are from each other, beside mocap's twins."""
    prior: options.MaybeName = None
    """A density, bundled or trained: its rollouts too, and the best of 8 by the energy that --best-of picks by. Takes a
    second a gap."""
    raw: bool = False
    """Leave out the rows that a MAP stage finishes."""
    auto: bool = False
    """Also as --method auto chooses; its rollouts take seconds a gap."""
    partial_keys: bool = False
    """Measure instead one gap of 30 frames a clip in whose middle hands, a foot or the hips are told, too: by the
    in-betweener, the baselines and the stitchers."""
    over_time: options.MaybeFile = None
    """Measure instead errors over the frames of gaps of 30 frames, of three answers each, and draw them as FILE.png."""


@dataclass(frozen=True, kw_only=True)
class Shots(PriorTable, ComparedTable):
    """Random shots of one to four wishes: how many hold, which are told not to, and how it looks beside plain walks; or
    walks round corners."""

    work = "mapctl.commands.bench.shots"

    corners: bool = False
    """Instead of random shots: walks round corners, through a hairpin and back on their own way."""
    seeds: options.Count = 2
    """Seeds of each such walk."""

    count: options.Count = 40
    """Shots."""
    seed: options.Count = 0
    """Seed of the wishes."""
    data: options.MaybeDataFolder = None
    """The folder that the prior was trained on: shots and walks are then told from its clips that were held out."""
    inbetweener: options.Name = "transformer"
    """The bundled transformer, or the file or run folder of a trained transformer."""


@dataclass(frozen=True, kw_only=True)
class Training(Table):
    """Seconds and memory of 100 training steps of each model's default recipe, and how much faster several processes
    are, which take turns with one."""

    work = "mapctl.commands.train.bench"

    data: options.DataFolder
    """Folder of .bvh files, searched below."""
    models: Annotated[str, arg(metavar="MODEL,MODEL,...")] = "all"
    """Models to train, as `mapctl train` calls them."""
    processes: options.Count = 2
    """Processes that share a step's batch, to compare with one; 1 measures one alone."""
    steps: options.Count = 10
    """Steps at each of five points of a run."""
    rounds: options.Count = 1
    """Measurements of each; the table shows their medians."""
    cache: options.MaybeDataFolder = None
    """Folder of a training run's clips as features (RUN/cache), which take minutes to read."""


@dataclass(frozen=True)
class Bench(Command):
    """Cost of the solver on this machine (`mapctl bench` alone), and what the jobs are worth: a table each."""


@dataclass(frozen=True, kw_only=True)
class AllTables(ModelCommand):
    """Make every table of the documentation again, one after the other, and say which figures moved.

    OUT/TABLE.json holds a table with its command, date, commit and machine; `python docs/extensions/measured_tables.py`
    fills the pages from them. Tables that were made by the same command at the same commit are skipped, so that an
    interrupted run goes on.
    """

    work = "mapctl.commands.bench.every.run"
    tells_licence: ClassVar[bool] = False
    single_thread = False  # each table is a process of its own, which sees to that

    data: options.DataFolder
    """The folder that the bundled models were trained on."""
    out: options.OutFolder
    """Folder for the tables; what it holds of an earlier run is what figures are compared with."""
    only: Annotated[str, arg(metavar="TABLE,TABLE,...")] = ""
    """Only these tables."""
    again: bool = False
    """Make tables again that are up to date."""


TABLES: dict[str, type[ModelCommand]] = {
    "speed": Speed,
    "ablation": Ablation,
    "follow": Follow,
    "free-run": FreeRun,
    "generation": Generation,
    "steer": Steer,
    "live": Live,
    "tween": Tween,
    "tweener": Tweener,
    "representation": Representation,
    "transitions": Transitions,
    "timing": Timing,
    "shots": Shots,
    "training": Training,
    "all": AllTables,
}
"""By the name the user types; the first is what `mapctl bench` alone measures."""
