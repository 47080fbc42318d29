"""Training of the pose transformer: windows of which parts are hidden, and their distance from what it returns."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits as cross_entropy

from mapctl import rotations
from mapctl.inbetweening.partial_motion import KnownParts, PartialMotion
from mapctl.numerics import gaussian
from mapctl.skeleton import CANONICAL, TOE_JOINTS
from priors.pose_transformer import (
    QUANTILES,
    PoseTransformer,
    PoseTransformerConfig,
    PoseTransformerNetwork,
    ProposedPoses,
)
from priors.training.augment import Draws
from priors.training.data import Corpus, Split
from priors.training.gaps import InbetweenerTrainer
from priors.training.loop import Count, Export, NetworkSettings, Number, make_adam, make_generator
from priors.training.windows import TEMPO, PoseVariation, PoseWindows, draw_length, measure_lengths

_SHORTEST_WINDOW = 8  # frames
_CALIBRATED_WINDOWS, _CALIBRATED_FRAMES = 128, (10, 20, 40, 60, 90)
_MIN_STD_ROTATION, _MIN_STD_POSITION = 0.1, 0.05
_JOINTS = CANONICAL.num_joints
_TRUNK = torch.isin(torch.arange(_JOINTS), torch.tensor(CANONICAL.indices(("spine", "chest", "neck", "head"))))

# Weights of the loss.
_POSITIONS = 10.0  # of the mean distance of joints from their true positions, metres
_HARM = 10.0  # of the metres by which joints are farther from there than interpolation puts them
_PACE = 20.0  # of the error of joints' steps, metres a frame
_TURNS = 1.0  # of the error of world rotations: norm of the difference of matrices
_HIPS = 5.0  # of the distance of the hips, metres
_FEET = 5.0  # of the planted toes' steps, metres a frame
_CONTACTS = 0.05  # of the contacts' cross entropy, nats
_EASE = 0.4  # how much windows count for more whose interpolation errs little: 0 all alike, 1 by the share of its error

# What stays known: a window has gaps, lost joints, or keys.
_LOST = 0.22  # share of windows that lose joints
_KEYS = 0.08  # share of windows of which only single frames are known, now and then
_SEVERAL = 0.25  # share of windows with gaps that have several
_BARE = 0.4  # share of runs of known frames that are one frame long
_CONTEXT = 16  # frames of the longest run beside a gap
_OPEN = 0.08  # share of windows with gaps that end, or half as often begin, in one
_GIVEN = 0.33  # share of windows with gaps of which something is known in the gap
_BOWED = 0.25  # share of windows with lost joints that also lack spine to head: a body that reaches far leans and turns


@dataclass(frozen=True, kw_only=True)
class PoseTransformerSettings(NetworkSettings):
    """Train the pose transformer that infill, tween, blend and chain begin with; --batch is in frames."""

    kind = "pose-transformer"
    used_by = "use it with --inbetweener"
    ours = PoseTransformerConfig()
    least_window = 2 * _SHORTEST_WINDOW

    steps: Count = 11_500
    """Steps in all."""
    batch: Count = 2000
    """Frames a step; windows of one step are equally long."""
    window: Count = 200
    """Frames of the longest window; the shortest have 8, and as many are drawn of each octave."""
    learning_rate: Number = 1.5e-3
    """At its highest; less to fine-tune."""

    def make_trainer(self, parts: Split) -> "PoseTransformerTrainer":
        return PoseTransformerTrainer(self, parts.train)


class PoseTransformerTrainer(InbetweenerTrainer[PoseTransformerNetwork]):
    """Draws windows, hides parts of them, and brings the network nearer to proposing them."""

    model, gaps = PoseTransformer, (5, 15, 30, 45, 60, 120)

    def __init__(self, settings: PoseTransformerSettings, corpus: Corpus):
        self.windows = PoseWindows(corpus)
        self.longest = min(settings.window, int(self.windows.lengths.max()) * 9 // 10 - 1)
        self.config = settings.find_config()
        super().__init__(settings, lambda: PoseTransformerNetwork(self.config, bfloat16=settings.bfloat16))
        _set_moments(self.network, self.windows)
        self.begin()

    def make_optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """Optimise the layers' matrices by Muon (Jordan et al. 2024), at the step size that makes one learning rate
        serve both (Liu et al. 2025); all else by AdamW."""
        weights = dict(self.network.named_parameters())
        matrices = {name for name, weight in weights.items() if ".layers." in f".{name}" and weight.ndim == 2}
        muon = torch.optim.Muon(
            [weights[name] for name in weights if name in matrices],
            lr=self.settings.learning_rate,
            weight_decay=0.01,
            adjust_lr_fn="match_rms_adamw",
        )
        others = [weight for name, weight in weights.items() if name not in matrices]
        return {"optimiser": make_adam(others, self.settings.learning_rate), "muon": muon}

    def losses(self) -> dict[str, Tensor]:
        frames = draw_length(_SHORTEST_WINDOW, self.longest, self.generator)
        batch = max(1, self.settings.batch // frames)
        truth = self.windows.draw(batch, frames, self.generator, variation=PoseVariation())
        return compute_losses(self.network, truth, sample_known_parts(truth, self.generator))

    @torch.no_grad()
    def export(self, parts: Split) -> Export:
        """Calibrate the spread of the proposals on the validation clips, and measure that on the test clips."""
        over = zip(QUANTILES, _measure_spread(self.network, parts.validation, seed=1), strict=True)
        # The nominal share of errors lies within the spreads then.
        self.network.spread_shift += torch.tensor([float(each.quantile(share)) for share, each in over])
        done = super().export(parts)
        over = zip(QUANTILES, _measure_spread(self.network, parts.test, seed=2), strict=True)
        done.quality |= {f"within_{share:.0%}": float((each <= 0).float().mean()) for share, each in over}
        return done


def _measure_spread(network: PoseTransformerNetwork, corpus: Corpus, seed: int) -> list[Tensor]:
    """Measure by quantile the logarithm of errors over the spread."""
    generator, windows = make_generator(seed), PoseWindows(corpus)
    found: list[Tensor] = []
    for frames in _CALIBRATED_FRAMES:
        if frames * (1 + TEMPO) < int(windows.lengths.max()):
            truth = windows.draw(_CALIBRATED_WINDOWS, frames, generator, variation=PoseVariation())
            shown = hide(network, sample_known_parts(truth, generator))
            proposed = network(shown)
            distance = (proposed.poses(truth.offsets)[0] - truth.world_poses()[0]).norm(dim=-1)
            unknown = ~shown.known.positions
            found.append((torch.log(distance + 1e-4)[..., None] - proposed.log_spread)[unknown][::7])
    return list(torch.cat(found).unbind(dim=-1))


def hide(network: PoseTransformerNetwork, motion: PartialMotion) -> PartialMotion:
    """Interpolate what is not known, and forget contacts of toes that are not."""
    toes = motion.known.positions[..., list(TOE_JOINTS)]
    shown = replace(motion, contacts=torch.where(toes, motion.contacts, 0.5))
    return network.interpolate(shown)


def compute_losses(network: PoseTransformerNetwork, truth: PartialMotion, hidden: PartialMotion) -> dict[str, Tensor]:
    """Compute the loss, and in plain units the errors that add up to it.

    Distances, not squares, window by window divided by how many joints in how many frames are unknown: two lost joints
    count as much as a gap. They are the same however the motion is turned. Windows that interpolation nearly solves
    count for more, or the network learns to fidget where bodies stand still.
    """
    shown = hide(network, hidden)
    proposed = network(shown)
    losses = _compare(proposed, truth, shown)
    assert proposed.rough is not None, "two stages propose"
    return losses | {"loss": losses["loss"] + _compare(proposed.rough, truth, shown, spread_weight=0.0)["loss"]}


def _compare(
    proposed: ProposedPoses, truth: PartialMotion, shown: PartialMotion, spread_weight: float = 1.0
) -> dict[str, Tensor]:
    known = shown.known
    wanted, wanted_world = truth.world_poses()
    guess = shown.world_poses()[0]
    generated, generated_world = proposed.poses(truth.offsets)
    unknown, turned = ~known.positions, ~known.world_rotations
    count = unknown.sum(dim=(1, 2)).clamp_min(1)
    weight = _weigh_windows((guess - wanted).norm(dim=-1), unknown)
    wrong = generated - wanted
    distance = measure_lengths(wrong)
    positions = (distance * unknown).sum(dim=(1, 2)) / count
    slip = torch.diff(wrong, dim=1)
    slipping = unknown[:, 1:] | unknown[:, :-1]
    pace = (measure_lengths(slip) * slipping).sum(dim=(1, 2)) / count
    twist = measure_lengths((generated_world - wanted_world).flatten(-2))
    turns = (twist * turned).sum(dim=(1, 2)) / turned.sum(dim=(1, 2)).clamp_min(1)
    lost = unknown[..., 0]
    hips = (distance[..., 0] * lost).sum(dim=1) / lost.sum(dim=1).clamp_min(1)
    toes = list(TOE_JOINTS)
    planted = truth.contacts[:, 1:] * truth.contacts[:, :-1] * slipping[..., toes]
    feet = (measure_lengths(slip[..., toes, :]) * planted).sum(dim=(1, 2)) / planted.sum(dim=(1, 2)).clamp_min(1)
    unsure = unknown[..., toes]
    nats = cross_entropy(proposed.contacts, truth.contacts, reduction="none")
    contacts = (nats * unsure).sum() / unsure.sum().clamp_min(1)
    spread = _quantile_loss(proposed, distance.detach(), unknown)
    simple = ((guess - wanted).norm(dim=-1) * unknown).sum(dim=(1, 2)) / count
    harm = (positions - simple).clamp_min(0.0)
    terms = _POSITIONS * positions + _HARM * harm + _PACE * pace + _TURNS * turns + _HIPS * hips + _FEET * feet
    loss = (weight * terms).mean() + _CONTACTS * contacts + spread_weight * spread
    return {
        "loss": loss,
        "positions_cm": 100 * positions.mean(),
        "share": (positions / simple.clamp_min(1e-3)).mean(),
        "worse": (harm > 0.0015 + 0.05 * simple).float().mean(),
        "pace_cm": 100 * pace.mean(),
        "turns": turns.mean(),
        "feet_cm": 100 * feet.mean(),
        "contacts_nats": contacts,
        "spread": spread,
    }


def _weigh_windows(error: Tensor, unknown: Tensor) -> Float[Tensor, " batch"]:
    """Weigh windows by the mean error of the interpolation, metres: 1 at 5 cm."""
    mean = (error * unknown).sum(dim=(1, 2)) / unknown.sum(dim=(1, 2)).clamp_min(1)
    return ((0.05 + 0.01) / (mean + 0.01)) ** _EASE


def _quantile_loss(proposed: ProposedPoses, distance: Tensor, unknown: Tensor) -> Tensor:
    """Pinball loss of the logarithm of the error (Koenker and Bassett 1978)."""
    over = torch.log(distance + 1e-4)[..., None] - proposed.log_spread
    share = over.new_tensor(QUANTILES)
    loss = torch.maximum(share * over, (share - 1) * over).sum(dim=-1)
    return (loss * unknown).sum() / unknown.sum().clamp_min(1)


def _set_moments(network: PoseTransformerNetwork, windows: PoseWindows) -> None:
    """Set mean and spread to those of rotations and positions of the data and its mirror image."""
    batch = windows.draw(4000, 4, make_generator(0))
    both = [batch, batch.mirrored()]
    quats = torch.cat([each.quats for each in both]).flatten(0, 1)
    six = rotations.to_six(rotations.to_matrix(quats))
    mean = windows.mean_quats()
    network.mean_quats.copy_(mean)
    network.mean_rotation.copy_(six.mean(dim=0))
    network.std_rotation.copy_(six.std(dim=0).clamp_min(_MIN_STD_ROTATION))
    ahead = [replace(each, heading=torch.zeros_like(each.heading)) for each in both]
    positions = torch.cat([each.world_poses()[0] for each in ahead])
    ground = torch.cat([each.root_position for each in both]) * positions.new_tensor([1.0, 0.0, 1.0])
    positions = (positions - ground[..., None, :]).flatten(0, 1)
    network.mean_position.copy_(positions.mean(dim=0))
    network.std_position.copy_(positions.std(dim=0).clamp_min(_MIN_STD_POSITION))


def sample_known_parts(motion: PartialMotion, generator: torch.Generator) -> PartialMotion:
    """Return windows of which only a part is known; something is known in every window."""
    batch, frames = motion.heading.shape
    draw = Draws(generator, batch, frames)
    kind = draw.uniform()
    lossy, keyed = kind < _LOST, kind > 1 - _KEYS
    keys = draw.uniform(frames) < 1 / (2 + draw.uniform(1) * 60)  # here and there, the first frame among them
    keys[:, 0] = True
    poses = torch.where(keyed[:, None], keys, _sample_gaps(draw))
    poses = torch.where((lossy & (draw.uniform() < 0.8))[:, None], True, poses)
    known = KnownParts.whole(poses)
    lost = torch.where(lossy[:, None, None], _sample_lost_joints(draw), False)
    bowed = lossy & (draw.uniform() < _BOWED)
    lost = lost | (bowed[:, None, None] & lost.any(dim=-1, keepdim=True) & _TRUNK)
    given = ~lossy & (draw.uniform() < _GIVEN)
    motion, known = _give_parts(draw, motion, known, given)
    return replace(motion, known=replace(known, rotations=known.rotations & ~lost))


def _sample_gaps(draw: Draws) -> Bool[Tensor, "batch frames"]:
    """True where a pose is known: a run, a gap, a run, and so on; mostly one gap."""
    known = torch.zeros(draw.batch, draw.frames, dtype=torch.bool)
    numbers = draw.uniform(4).tolist()
    many = torch.rand(draw.batch, 40, generator=draw.generator).tolist()
    for row, (several, begin, end, scale) in enumerate(numbers):
        values = iter(many[row])

        def run(values=values) -> int:
            if next(values) < _BARE:
                return 1
            return 1 + math.ceil(next(values) * (_CONTEXT - 1))

        mask = [False] * draw.frames
        before = 0 if begin < _OPEN / 2 else min(run(), draw.frames - 2)
        after = 0 if end < _OPEN and before else min(run(), draw.frames - before - 1)
        mask[:before] = [True] * before
        mask[draw.frames - after :] = [True] * after
        if several < _SEVERAL:
            mean, at = 3 * (draw.frames / 6) ** scale, before
            for _ in range(8):
                at += max(1, round(mean * (0.3 + 1.4 * next(values))))
                length = run()
                if at + length >= draw.frames - after:
                    break
                mask[at : at + length] = [True] * length
                at += length
        known[row] = torch.tensor(mask)
    return known


def _sample_lost_joints(draw: Draws) -> Bool[Tensor, "batch frames joints"]:
    """1 to 3 joints, or one or two limbs, throughout or for a stretch; or any joint now and then."""
    joints = draw.joints(limbs=0.65)
    joints = joints | (draw.limb() & (draw.uniform(1) < 0.3))
    during = draw.stretch(6 + draw.uniform() * (draw.frames - 6)) | (draw.uniform(1) < 0.7)
    dropped = draw.uniform(draw.frames, _JOINTS) < 0.5 * draw.uniform(1, 1)
    return torch.where((draw.uniform() < 0.15)[:, None, None], dropped, joints[:, None] & during[..., None])


def _give_parts(
    draw: Draws, motion: PartialMotion, known: KnownParts, given: Bool[Tensor, " batch"]
) -> tuple[PartialMotion, KnownParts]:
    """Make something known in gaps: some joints, the hips throughout, roughly, or at single frames."""
    which = torch.where(given, draw.uniform(), 2.0)

    def chosen(low: float, high: float) -> Bool[Tensor, "batch 1"]:
        return ((which >= low) & (which < high))[:, None]

    joints = draw.joints(limbs=0.65)
    joints = torch.where(draw.uniform(1) < 0.4, ~joints, joints)
    stretch = draw.stretch(1 + draw.uniform() * (draw.frames - 1))
    rotations = known.rotations | (chosen(0.0, 0.2)[..., None] & joints[:, None] & stretch[..., None])
    # With joints often, else alone: where the hips go and face, as far as it is given.
    throughout = (chosen(0.0, 0.2) & (draw.uniform(1) < 0.6)) | chosen(0.2, 0.35)
    single = chosen(0.5, 0.72) & (draw.uniform(draw.frames) < draw.uniform(1) ** 2 * 0.15)
    hips = (throughout & stretch) | single
    heading = known.heading | (hips & (draw.uniform(1) < 0.7))
    rotations[..., 0] |= hips & heading & (draw.uniform(1) < 0.6)
    ground, height = (each | (hips & (draw.uniform(1) < 0.85)) for each in (known.ground, known.height))
    path = chosen(0.35, 0.5) & ~ground
    parts = KnownParts(rotations, heading, ground, height, path)
    return replace(motion, root_position=_roughen(draw, motion.root_position, path)), parts


def _roughen(draw: Draws, root: Float[Tensor, "batch frames 3"], path: Bool[Tensor, "batch frames"]) -> Tensor:
    """Smooth paths on the ground, and lead half of them a little astray."""
    if not bool(path.any()):
        return root
    rows = path.any(dim=1)
    ground = root[rows][..., ::2]
    smooth = gaussian.smooth(ground.transpose(0, 1), 8.0).transpose(0, 1)
    knots = 0.06 * draw.normal(2, 6)[rows] * (draw.uniform(1, 1)[rows] < 0.5)
    astray = torch.nn.functional.interpolate(knots, size=root.shape[1], mode="linear", align_corners=True)
    smooth = smooth + astray.transpose(1, 2)
    rough = root.clone()
    rough[rows] = torch.stack([smooth[..., 0], root[rows][..., 1], smooth[..., 1]], dim=-1)
    return torch.where(path[..., None], rough, root)
