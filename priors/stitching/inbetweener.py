"""The stitcher as an in-betweener: short gaps between whole poses, in as many ways as are drawn."""

from collections.abc import Callable, Generator
from dataclasses import dataclass, field, replace
from fractions import Fraction

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mapctl import contacts, rotations
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, encode, mirror_features, reversed_features
from mapctl.inbetweening import GapQuery, Proposal
from mapctl.inbetweening.query import INTERPOLATION, GapSource
from mapctl.kinematics import forward_kinematics, heading
from mapctl.motion import Motion
from mapctl.numerics.gaussian import averaging_matrix
from mapctl.numerics.intervals import true_intervals
from mapctl.pose import BodyPose
from mapctl.protocols import Inbetweener
from mapctl.skeleton import CANONICAL, TOE_JOINTS
from priors import checkpoints
from priors.stitching.network import (
    DrawnLatents,
    Ends,
    Joined,
    StitcherConfig,
    StitcherNetwork,
    count_made,
    join_sides,
    walk_sides,
    walk_stepwise,
)

CHUNK = 16
"""Draws at once: batches of one size are rounded alike, so that the first draws do not depend on the count."""
_LARGEST_SEED = 2**63


@dataclass(eq=False)
class Draws:
    """Answers that are drawn, to as many pairs of poses as are asked for."""

    seed: int
    """Of the noise; each pair of poses has noise of its own."""
    temperature: float = 1.0
    """Standard deviation of the noise."""
    dropped: int = 0
    """Draws so far that were not finite, which nobody is given."""
    chunks: dict[tuple[bytes, int, int], Joined] = field(default_factory=dict)
    """Those made, by the ends, the frames from one to the other and the number of the chunk."""

    def seed_chunk(self, start: int, chunk: int) -> torch.Generator:
        """Return the generator of a chunk's noise, for the ends of a gap that starts at a frame."""
        seed = (self.seed + 1_000_003 * start + 7_919 * chunk) % _LARGEST_SEED
        return torch.Generator().manual_seed(seed)

    def pick(
        self, ends: Ends, start: int, frames: int, number: int, make: Callable[[torch.Generator, float], Joined]
    ) -> Joined | None:
        """Return the draw of a number for the ends of a gap that starts at a frame, made by `make` with the chunk that
        it is in if it is not there; the next finite one where it is not finite, and None where the whole chunk is not.
        """
        chunk, row = divmod(number, CHUNK)
        told = b"".join(part.numpy().tobytes() for part in (ends.features, ends.present, ends.place, ends.turn))
        if (made := self.chunks.get((told, frames, chunk))) is None:
            made = make(self.seed_chunk(start, chunk), self.temperature)
            self.chunks[told, frames, chunk] = made
            self.dropped += int((~made.finite).sum())
        good = made.finite.roll(-row).nonzero()
        return made.row((row + int(good[0])) % CHUNK) if len(good) else None


_ROUNDS, _DIFFERENCE = 2, 0.25  # the second in standard deviations of the prior
_SHARES = (0.25, 0.5, 0.75, 1.0, 1.25)  # of a step


def fit_shared(
    make: Callable[[Float[Tensor, "batch shared"]], Joined],
    measure: Callable[[Joined], Float[Tensor, "batch residuals"]],
    centre: Float[Tensor, " shared"],
    spread: float,
) -> Joined:
    """Fit what both sides share, in standard deviations of the prior, to residuals in theirs, by Gauss-Newton;
    with a sample as the centre, randomise-then-optimise (Bardsley et al. 2014).

    The energy counts distances from the `centre` in units of `spread`. Returns the motion with the least energy of all
    that were made, as a batch of one: that of the centre where no step helps, or where nothing finite is near it.
    """
    best, fitted = centre, make(centre[None])
    for _ in range(_ROUNDS):
        residuals = measure(make(torch.cat([best[None], best + _DIFFERENCE * torch.eye(len(best))])))
        here = residuals[0]
        jacobian = spread * ((residuals[1:] - here) / _DIFFERENCE).T
        away = (best - centre) / spread
        system = jacobian @ jacobian.T + torch.eye(len(here))
        # Of  |r + J d|^2 + |a + d|^2  the least is at  d = -a - J' (J J' + 1)^-1 (r - J a).
        step = -away - jacobian.T @ torch.linalg.solve(system, here - jacobian @ away)
        tried = best + spread * torch.tensor((0.0, *_SHARES))[:, None] * step
        if not bool(tried.isfinite().all()):
            break
        made = make(tried)
        energy = measure(made).square().sum(dim=1) + ((tried - centre) / spread).square().sum(dim=1)
        least = int(torch.where(energy.isfinite() & made.finite, energy, torch.inf).argmin())
        best, fitted = tried[least], made.row(least)
    return fitted


_SIGMA_HAND, _SIGMA = 0.1, 0.02
"""Metres of a hand, and of a foot, the hips or a trajectory: what bends away without the rest of the body. Arms bend by
themselves: with less for hands the rest of the body comes farther from mocap that they were taken from."""
_HANDS = CANONICAL.indices(("leftHand", "rightHand"))
_FACING_ARM = 0.3  # metres by which a radian counts of how the hips face
_SWAY_FRAMES = 5.0  # frames at PRIOR_FPS, sigma, of the average in which the hips follow a trajectory
_TRAJECTORY_STRIDE = 6  # frames from one residual of a trajectory to the next


@dataclass(frozen=True, eq=False)
class Wishes:
    """Wishes about the frames of one gap, on the canonical skeleton, seen from the pose before it."""

    places: Float[Tensor, "frames joints 3"]
    """Positions that joints are to have, metres."""
    wanted: Bool[Tensor, "frames joints"]
    """Whether a joint is to have one."""
    facing: Float[Tensor, " faced"]
    """Headings that the hips are to have, radians."""
    faced: Int[Tensor, " faced"]
    """Frames in which they are to have them."""
    trajectory: Float[Tensor, "frames 2"] | None
    """Ground positions that the hips are to follow, metres; they may sway about them."""

    @staticmethod
    def of(query: GapQuery, start: int, stop: int) -> "Wishes | None":
        """See what a query tells between frames that are known on both sides; None where that is nothing."""
        part, targets = slice(start, stop), query.effector_targets
        hips = query.root_only_keys[part]
        told = query.keep_trajectory or bool(hips.any()) or (targets is not None and bool(targets.wanted[part].any()))
        if not told:
            return None
        body = query.to_unit_size(query.motion)
        facing = heading(body.local_quat_xyzw[start - 1, 0])
        origin = body.root_position[start - 1] * torch.tensor([1.0, 0.0, 1.0]).double()

        def see(positions: Tensor) -> Tensor:
            return rotations.rotate_about_y(positions - origin, -facing.expand(positions.shape[:-1]))

        places = torch.zeros(stop - start, CANONICAL.num_joints, 3)
        wanted = torch.zeros(places.shape[:2], dtype=torch.bool)
        root = see(body.root_position[part]).float()
        if targets is not None:
            places, wanted = see(targets.places[part] / query.scale).float(), targets.wanted[part].clone()
        places[:, 0], wanted[:, 0] = root, hips
        turned = rotations.wrap_angle(heading(body.local_quat_xyzw[part, 0]) - facing).float()
        faced = hips.nonzero()[:, 0]
        return Wishes(places, wanted, turned[faced], faced, root[:, ::2] if query.keep_trajectory else None)

    def measure(self, joined: Joined) -> Float[Tensor, "batch residuals"]:
        """Measure by how much motions miss each wish along each axis, in standard deviations."""
        places, facing, trajectory = self._measure(joined)
        hands = torch.isin(self.wanted.nonzero()[:, 1], torch.tensor(_HANDS))
        sigma = torch.where(hands, _SIGMA_HAND, _SIGMA)[:, None]
        parts = (places / sigma, facing / _SIGMA, trajectory / _SIGMA)
        return torch.cat([part.flatten(1) for part in parts], dim=1)

    def measure_farthest(self, joined: Joined) -> float:
        """Measure the largest distance of one motion to a wish, metres."""
        return max((float(part[0].norm(dim=-1).max()) for part in self._measure(joined) if part.numel()), default=0.0)

    def lay_along(self, joined: Joined) -> Joined:
        """Move motions along the trajectory, if there is one."""
        if self.trajectory is None:
            return joined
        root = joined.root_position - rotations.lift_ground(self._follow(joined.root_position, self.trajectory))
        return Joined(root, joined.quats, joined.contacts, joined.apart)

    def _measure(
        self, joined: Joined
    ) -> tuple[Float[Tensor, "batch places 3"], Float[Tensor, "batch faced 1"], Float[Tensor, "batch points 2"]]:
        """Measure by how much motions miss places, headings and points of the trajectory, metres."""
        root = joined.root_position
        positions, _ = forward_kinematics(CANONICAL.offsets.to(root), CANONICAL.parents, root, joined.quats)
        turned = rotations.wrap_angle(heading(joined.quats[:, self.faced, 0]) - self.facing)
        off = root[:, :0, ::2] if self.trajectory is None else self._follow(root, self.trajectory)
        points = off[:, _TRAJECTORY_STRIDE // 2 :: _TRAJECTORY_STRIDE]
        return (positions - self.places)[:, self.wanted], _FACING_ARM * turned[..., None], points

    @staticmethod
    def _follow(
        root: Float[Tensor, "batch frames 3"], trajectory: Float[Tensor, "frames 2"]
    ) -> Float[Tensor, "batch frames 2"]:
        """Measure how far the hips, averaged over their sway, are off the trajectory: by nothing in the frames before
        and after, which are known."""
        off = torch.nn.functional.pad(root[..., ::2] - trajectory, (0, 0, 1, 1))
        # Beyond the known frames it goes on turned round, so that its average there is nothing, too.
        turned, count = -off[:, 1:-1].flip(1), len(trajectory)
        whole = torch.cat([turned, off, turned], dim=1)
        return averaging_matrix(whole.shape[1], _SWAY_FRAMES, off.dtype)[count + 1 : 2 * count + 1] @ whole


SOURCE = "stitcher"
"""Name of the in-betweener in notes."""
MAX_CONTEXT = 10
"""Frames before a gap, and after it, that are looked at."""
_WIDENED = 1.25
"""By how much draws are wider than what training found, with which the best of eight is nearest to the truth: answers
differ by as much more, and the best of eight is hardly farther from the truth."""
_NOT_FINITE = "nothing finite came of it"
_FARTHEST = 0.3  # metres of unit size from a trajectory over which steps can be moved without breaking
_PARTNERS = CANONICAL.mirror_partners()


@dataclass(frozen=True, eq=False, repr=False)
class Stitcher(checkpoints.LoadedModel, Inbetweener):
    """A trained stitcher (Ren et al. 2024)."""

    name: str
    """Name under which it was loaded."""
    network: StitcherNetwork
    """Network in evaluation mode."""
    card: checkpoints.Card
    """Card of the weights."""
    draws: Draws | None = None
    """What it draws its answers from; without it gives the calm one, with the latent at its mean."""
    number: int = 0
    """Number of the draw that it proposes."""

    @property
    def longest(self) -> int:
        """Frames of the longest gap that it fills."""
        return self.network.config.longest - 1

    def drawing(self, seed: int = 0, temperature: float | None = None) -> "Stitcher":
        """Return the in-betweener that proposes the first draw with a seed, and by `numbered` the others. The
        `temperature` is the factor of the noise, a quarter more than that of the weights unless it is given; a higher
        one makes draws differ more, and come less near to what is likely."""
        return replace(self, draws=Draws(seed, self._pick_temperature(temperature)), number=0)

    def numbered(self, number: int) -> "Stitcher":
        """Return the in-betweener that proposes the draw of a `number`, an index from 0 on."""
        return replace(self, number=number)

    @torch.no_grad()
    def draw(
        self, ends: Ends, frames: int, *, count: int, generator: torch.Generator, temperature: float | None = None
    ) -> Joined:
        """Draw so many answers to one pair of poses, `frames` from the one to the other; the first ones do not depend
        on the count. The `temperature` is the factor of the noise that `drawing` takes."""
        heat = self._pick_temperature(temperature)
        rows = [self._draw_chunk(ends, frames, generator, heat) for _ in range(-(-count // CHUNK))]
        return Joined(
            *(torch.cat([getattr(row, name) for row in rows])[:count] for name in Joined.__dataclass_fields__)
        )

    def _pick_temperature(self, temperature: float | None) -> float:
        return _WIDENED * float(self.network.temperature) if temperature is None else temperature

    def _draw_chunk(self, ends: Ends, frames: int, generator: torch.Generator, temperature: float) -> Joined:
        return self._walk(ends, frames, self._draw_latents(frames, generator, temperature))

    def _draw_latents(self, frames: int, generator: torch.Generator, temperature: float) -> DrawnLatents:
        made = count_made(self.network, frames)
        return DrawnLatents.sample(self.network.config, CHUNK, made, generator).scale(temperature)

    def _walk(self, ends: Ends, frames: int, latents: DrawnLatents) -> Joined:
        return join_sides(walk_sides(self.network, _repeat(ends, len(latents.shared)), frames, latents))

    @torch.no_grad()
    def answer(self, ends: Ends, frames: int) -> Joined:
        """Return the calm answer to pairs of poses: the mean of that to them and that to their mirror image."""
        config, batch = self.network.config, len(ends.place)
        both = Ends(
            torch.cat([ends.features, mirror_features(ends.features)], dim=1),
            torch.cat([ends.present, ends.present], dim=1),
            torch.cat([ends.place, ends.place * ends.place.new_tensor([-1.0, 1.0])]),
            torch.cat([ends.turn, -ends.turn]),
        )
        calm = DrawnLatents.calm(config, 2 * batch, count_made(self.network, frames))
        joined = join_sides(walk_sides(self.network, both, frames, calm))
        return _average_mirrored(joined, batch)

    @torch.no_grad()
    def connect(
        self,
        before: Float[Tensor, "*batch before size"],
        after: Float[Tensor, "batch after size"],
        place: Float[Tensor, "batch 2"],
        turn: Float[Tensor, " batch"],
        frames: int,
        noise: torch.Generator | None = None,
    ) -> Generator[None, None, Float[Tensor, "batch frames size"]]:
        """Make, a frame at a time, the ways from the last frame of `before`, of one motion or of each, to the last of
        `after`, which are run backwards, as features from the next frame on to that one, `frames` later. Seen from the
        first, it is at `place`, metres, and its heading another by `turn`, radians. All others of these frames say how
        motion came here and goes on. The ways are the calm ones, or drawn if there is `noise`."""
        before = before[..., -1 - MAX_CONTEXT :, :].expand(len(after), -1, -1)
        after = after[:, -1 - MAX_CONTEXT :]
        context = max(before.shape[1], after.shape[1])
        sides, present = [], []
        for known in (before, after):
            lead = context - known.shape[1]
            sides.append(torch.cat([known[:, :1].expand(-1, lead, -1), known], dim=1))
            present.append((torch.arange(context) >= lead).float().expand(len(after), -1))
        ends = Ends(torch.stack(sides), torch.stack(present), place, turn)
        config, made = self.network.config, count_made(self.network, frames)
        latents = DrawnLatents.calm(config, len(place), made)
        if noise is not None:
            latents = DrawnLatents.sample(config, len(place), made, noise).scale(float(self.network.temperature))
        joined = join_sides((yield from walk_stepwise(self.network, ends, frames, latents)))
        origin = GroundPose(torch.zeros_like(place), torch.zeros_like(turn))
        first, last = _stand_at(before[:, -1], origin), _stand_at(after[:, -1], GroundPose(place, turn))
        root = torch.cat([first.root_position, joined.root_position, last.root_position], dim=1)
        quats = torch.cat([first.local_quat_xyzw, joined.quats, last.local_quat_xyzw], dim=1)
        planted = torch.cat([(joined.contacts > 0).float(), after[:, -1:, LAYOUT.slices["contacts"]]], dim=1)
        ways = [
            encode(Motion(CANONICAL, Fraction(PRIOR_FPS), one.double(), rotations.make_sign_continuous(two.double())))[
                0
            ][1:]
            for one, two in zip(root, quats, strict=True)
        ]
        return torch.cat([torch.stack(ways).float()[..., : LAYOUT.continuous], planted], dim=-1)

    @torch.no_grad()
    def propose(self, query: GapQuery, *, generator: torch.Generator | None = None) -> Proposal:
        """Propose motion for gaps between whole poses of up to `longest` frames; all else stays interpolated, and the
        proposal says so. Frames beside a gap that are wholly known, up to MAX_CONTEXT of them, are looked at. Draws
        have a seed of their own. What is told within a gap of hands, feet, hips or their trajectory leads the answer
        (see `priors.stitching.fitting`) and is met about as well as the motion of the data allows."""
        body = query.to_unit_size(query.motion)
        toes = body.joint_positions()[:, list(TOE_JOINTS)]
        root, quats = body.root_position.clone(), body.local_quat_xyzw.clone()
        logits = contacts.to_logits(contacts.detect_contacts(toes, PRIOR_FPS)).float()
        sources = []
        whole = query.hide_partial_keys()
        for start, stop in whole.enclosed_gaps:
            reason, remark, found, wishes = self._refuse(whole, start, stop), "", None, None
            if not reason:
                ends, wishes = see_ends(body, whole.missing.frames, start, stop), Wishes.of(query, start, stop)
                found = self._find(ends, start, stop) if wishes is None else self._fit(ends, start, stop, wishes)
            if found is not None and wishes is not None:
                off = wishes.measure_farthest(found)
                remark = f"led by what is told in it, of which it is {100 * query.scale * off:.1f} cm off unbent"
                if query.keep_trajectory and off > _FARTHEST:
                    reason = f"with steps that stay {query.scale * off:.2f} m off the trajectory"
                found = None if reason else wishes.lay_along(found)
            parts = [gap for gap in query.enclosed_gaps if start <= gap[0] and gap[1] <= stop] or [(start, stop)]
            if found is None:
                sources += [GapSource(*gap, INTERPOLATION, reason or _NOT_FINITE) for gap in parts]
                continue
            part = slice(start, stop)
            root[part], quats[part] = _place(found, body, start)
            logits[part] = found.contacts[0]
            apart = query.scale * float(found.apart[0])
            sources += [GapSource(*gap, SOURCE, apart=apart, remark=remark) for gap in parts]
        sources += _list_partly_known(whole)
        moved = replace(body, root_position=root, local_quat_xyzw=rotations.make_sign_continuous(quats))
        return Proposal(query.to_character(moved), logits, SOURCE, tuple(sources))

    def _find(self, ends: Ends, start: int, stop: int) -> Joined | None:
        """Find the answer to the ends of a gap; None where it is not finite."""
        frames = stop - start + 1
        if self.draws is not None:
            return self.draws.pick(
                ends, start, frames, self.number, lambda noise, heat: self._draw_chunk(ends, frames, noise, heat)
            )
        calm = self.answer(ends, frames)
        return calm if bool(calm.finite.all()) else None

    def _fit(self, ends: Ends, start: int, stop: int, wishes: Wishes) -> Joined | None:
        """Find the answer that meets the wishes about a gap, near the calm one or near the draw of this number; None
        where it is not finite."""
        frames, draws = stop - start + 1, self.draws
        if draws is None:
            spread = self._pick_temperature(None)
            around = DrawnLatents.calm(self.network.config, 1, count_made(self.network, frames))
        else:
            chunk, row = divmod(self.number, CHUNK)
            spread = draws.temperature
            around = self._draw_latents(frames, draws.seed_chunk(start, chunk), spread).rows(torch.tensor([row]))

        def make(shared: Float[Tensor, "batch shared"]) -> Joined:
            return self._walk(ends, frames, DrawnLatents(shared, around.slow.expand(-1, len(shared), -1, -1)))

        found = fit_shared(make, wishes.measure, around.shared[0], spread)
        return found if bool(found.finite.all()) else None

    def _refuse(self, query: GapQuery, start: int, stop: int) -> str:
        """Return why a gap is not stitched; empty where it is."""
        if stop - start > self.longest:
            return f"longer than the {self.longest} frames that the {SOURCE} fills"
        edges = query.missing.joints[[start - 1, stop]].any() | query.missing.root[[start - 1, stop]].any()
        if bool(edges) or query.loose is not None:
            return f"known in part, where the {SOURCE} takes whole poses"
        return ""


def see_ends(body: Motion, missing: Tensor, start: int, stop: int) -> Ends:
    """See the ends of a gap in a canonical motion of unit size, and whole frames beside it, of which `missing` has
    none."""
    features, present = [], []
    before, after = _count_known(missing, start - 1, -1), _count_known(missing, stop, 1)
    context = 1 + max(before, after)
    there = _encode(body, start - 1 - before, start)
    back = reversed_features(_encode(body, stop, stop + 1 + after))
    for rows, count in ((there[-1 - before :], before), (back[-1 - after :], after)):
        lead = context - 1 - count
        features.append(torch.cat([rows[:1].expand(lead, -1), rows])[None])
        present.append((torch.arange(context) >= lead).float()[None])
    heading = rotations.split_heading(body.local_quat_xyzw[[start - 1, stop], 0])[0]
    away = (body.root_position[stop] - body.root_position[start - 1])[[0, 2]]
    place = rotations.rotate_ground(away, -heading[0]).float()[None]
    turn = rotations.wrap_angle(heading[1] - heading[0]).float()[None]
    return Ends(torch.stack(features).float(), torch.stack(present), place, turn)


def _count_known(missing: Tensor, at: int, step: int) -> int:
    """Count whole frames beyond one, up to MAX_CONTEXT."""
    count = 0
    while count < MAX_CONTEXT and 0 <= at + step < len(missing) and not bool(missing[at + step]):
        at, count = at + step, count + 1
    return count


def _encode(body: Motion, start: int, stop: int) -> Float[Tensor, "frames size"]:
    """Encode frames; a single one stands still, which nobody looks at."""
    part = body.slice(start, stop)
    if stop - start == 1:
        part = replace(
            part, root_position=part.root_position.expand(2, -1), local_quat_xyzw=part.local_quat_xyzw.expand(2, -1, -1)
        )
    return encode(part)[0]


def _stand_at(features: Float[Tensor, "batch size"], at: GroundPose) -> BodyPose:
    """Return single poses at ground poses."""
    root = rotations.lift_ground(at.position_xz) + torch.nn.functional.pad(LAYOUT.pick(features, "root_height"), (1, 1))
    joints = LAYOUT.pick(features, "joint_rotations").unflatten(-1, (-1, 3))
    return BodyPose(root[:, None], at.heading[:, None], LAYOUT.pick(features, "root_tilt")[:, None], joints[:, None])


def _place(
    joined: Joined, body: Motion, start: int
) -> tuple[Float[Tensor, "frames 3"], Float[Tensor, "frames joints 4"]]:
    """Place an answer after the pose before a gap, double precision."""
    facing = rotations.split_heading(body.local_quat_xyzw[start - 1 : start, 0])[0]
    at = body.root_position[start - 1] * torch.tensor([1.0, 0.0, 1.0]).double()
    root, quats = joined.root_position[0].double(), joined.quats[0].double().clone()
    turn = rotations.about_y(facing).expand(len(root), 4)
    quats[:, 0] = rotations.multiply(turn, quats[:, 0])
    return rotations.rotate(turn, root) + at, quats


def _average_mirrored(joined: Joined, batch: int) -> Joined:
    """Average answers and, mirrored back, those to the mirror image."""
    flip, turned = joined.root_position.new_tensor([-1.0, 1.0, 1.0]), joined.quats.new_tensor([1.0, -1.0, -1.0, 1.0])
    root = (joined.root_position[:batch] + flip * joined.root_position[batch:]) / 2
    one, other = joined.quats[:batch], turned * joined.quats[batch:, :, _PARTNERS]
    quats = rotations.slerp(one, other, one.new_full(one.shape[:-1], 0.5))
    logits = (joined.contacts[:batch] + joined.contacts[batch:].flip(-1)) / 2
    return Joined(root, quats, logits, (joined.apart[:batch] + joined.apart[batch:]) / 2)


def _repeat(ends: Ends, count: int) -> Ends:
    """Repeat the one pair of poses."""
    return Ends(
        ends.features.expand(-1, count, -1, -1).contiguous(),
        ends.present.expand(-1, count, -1).contiguous(),
        ends.place.expand(count, -1).contiguous(),
        ends.turn.expand(count).contiguous(),
    )


def _list_partly_known(query: GapQuery) -> list[GapSource]:
    """List runs of frames that are known in part, or have nothing known on one side."""
    rest = query.missing.frames.clone()
    for start, stop in query.enclosed_gaps:
        rest[start:stop] = False
    reason = f"known in part or on one side alone, where the {SOURCE} takes whole poses"
    return [GapSource(start, stop, INTERPOLATION, reason) for _, start, stop in true_intervals(rest[:, None])]


def load(name: str = "stitcher") -> Stitcher:
    """Load the bundled stitcher, or a trained one by its file or run folder; CheckpointError for anything else."""
    with checkpoints.open_checkpoint(name, "stitcher") as (tensors, card):
        network = checkpoints.build_network(StitcherNetwork, StitcherConfig.of_card(card.config), tensors)
    return Stitcher(name, network, card)
