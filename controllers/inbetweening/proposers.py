"""Proposers of motion in gaps: the in-betweeners behind --method.

- Interpolation (`SlerpInbetweener`), and a stitcher that fills gaps from both sides (`StitchedInbetweener`).
- Walks over keys that give positions alone: a density follows a curve through them in time (Wang et al. 2019, 5.2).
- Rollouts of a density, steered to the next known frames (Wang et al. 2019, Eq. 14-19, with the frames after a gap as
  the target): a swarm searches latent noise of the root, then L-BFGS all latent noise; the error left at arrival is
  distributed over the gap.
- Proposals through partial keys, which give only positions of hands, feet or hips. In-betweeners see those of the hips;
  then the smallest motion of the whole body meets what is left (`mapctl.inbetweening.whole_body`).
- The choice among them (`AutoInbetweener`). Rollouts have no part in it: their feet slide less as proposed, but the MAP
  stage plants the feet of either, and then the pose transformer's answer is nearer to mocap.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import scipy
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controllers.common.character import Character
from controllers.shots.walk import FollowSettings, walk_arcs
from mapctl import contacts, curves, rotations
from mapctl.curves import Curve
from mapctl.errors import RequestError
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, encode, integrate_root
from mapctl.inbetweening import GapQuery, Proposal
from mapctl.inbetweening.effector_targets import EffectorTargets
from mapctl.inbetweening.missing import blend_seams
from mapctl.inbetweening.query import INTERPOLATION, GapSource, estimate_contact_logits
from mapctl.inbetweening.whole_body import bend_limbs, reach_targets
from mapctl.kinematics import heading
from mapctl.metrics.body import measure_path_length, measure_peaks
from mapctl.motion import Motion
from mapctl.numerics import gaussian
from mapctl.numerics.intervals import last_observed, next_observed
from mapctl.numerics.smooth_offsets import interpolate_offsets, interpolate_turns
from mapctl.pose import decode
from mapctl.problem import density_selection
from mapctl.problem.receding_horizon import CommittedFrames, RecedingHorizonSolver, replay
from mapctl.problem.window_solvers import LatentNoiseSolver, SolvedWindow, SwarmProposal
from mapctl.protocols import Density, DensityState, Inbetweener
from mapctl.recording.masks import MissingMask
from mapctl.skeleton import CANONICAL, LIMBS, TOE_JOINTS, TOES
from mapctl.solver.budget import Budget
from mapctl.solver.lbfgs import LbfgsSettings
from mapctl.solver.swarm import SwarmSettings
from mapctl.terms import FootContact, Keyframe, LatentPrior

_MIN_ROOT_UNCERTAINTY = 0.02  # metres, of the position of a standing body
_ROOT_UNCERTAINTY_SHARE = 0.1  # of the distance travelled since the last known position
_STRETCH_SHARE = 0.985  # of a limb's length that it reaches
_MIN_LIMB_SECONDS, _LIMB_ACCELERATION = 0.15, 15.0
"""Least time in which a limb goes to its target, and its acceleration (m/s^2) beyond that: a sixth of what hands and
feet reach in walking."""
_MIN_TRUNK_SECONDS, _TRUNK_ACCELERATION = 0.25, 3.0
"""Least time and acceleration of hips and trunk."""
_ARMS = [
    joint
    for name, limb in LIMBS.items()
    if name.endswith("Hand")
    for joint in (CANONICAL.parents[limb.upper], limb.upper, limb.lower, limb.end)
]
_TRUNK = [joint for joint in range(CANONICAL.num_joints) if joint not in _ARMS]  # and legs
_FEET = tuple(limb.end for name, limb in LIMBS.items() if name.endswith("Foot"))


def propose_through_keys(
    query: GapQuery, inbetweener: Inbetweener, generator: torch.Generator | None
) -> tuple[Proposal, EffectorTargets | None]:
    """Propose a motion with hands and feet at their targets, and the hips at theirs in frames that give no more; also
    return the targets, moved within reach where they are not."""
    hips, targets = query.root_only_keys, query.effector_targets
    answer = inbetweener.propose(replace(query, effector_targets=None), generator=generator)
    posed, keys = _set_hips(answer.motion, query.motion, hips), hips
    if targets is not None:
        # The body moves where limbs alone do not reach, and no more than that.
        far = _find_out_of_reach(posed, targets)
        beyond = EffectorTargets(targets.positions, targets.wanted & far[:, None])
        turning, moving = query.missing.joints, query.missing.root
        stray, keys = _estimate_root_uncertainty(answer.motion, moving), hips | far
        posed = reach_targets(posed, beyond, turning=turning, moving=moving, stray=stray)
        reached = torch.where(beyond.wanted[..., None], posed.joint_positions(), targets.positions)
        targets = EffectorTargets(reached, targets.wanted)
    if not bool(keys.any()):
        return answer, targets
    return replace(answer, motion=_blend_key_poses(answer.motion, posed, keys, query.hide_partial_keys())), targets


def _find_out_of_reach(motion: Motion, targets: EffectorTargets) -> Bool[Tensor, " frames"]:
    """Find the frames in which a target is farther away than its limb is long."""
    positions, far = motion.joint_positions(), torch.zeros(motion.num_frames, dtype=torch.bool)
    for limb in LIMBS.values():
        away = (targets.positions[:, limb.end] - positions[:, limb.upper]).norm(dim=-1)
        far |= targets.wanted[:, limb.end] & (away > _STRETCH_SHARE * limb.length(motion.skeleton))
    return far


def _estimate_root_uncertainty(body: Motion, missing: Bool[Tensor, " frames"]) -> Float[Tensor, " frames"]:
    """Estimate the uncertainty of proposed hips, metres: by their speed and the time from the nearest known frame."""
    known, frame, fps = ~missing[None], torch.arange(len(missing)), float(body.fps)
    before, after = last_observed(known)[0], next_observed(known)[0]
    seconds = torch.minimum((frame - before).abs(), (after - frame).abs()) / fps
    path_length = (body.root_position[after] - body.root_position[before])[:, ::2].norm(dim=-1)
    return _MIN_ROOT_UNCERTAINTY + _ROOT_UNCERTAINTY_SHARE * seconds * path_length * fps / (after - before).clamp_min(1)


def _set_hips(body: Motion, known: Motion, frames: Bool[Tensor, " frames"]) -> Motion:
    """Set the hips to those of `known` in these frames; the body takes their heading, and their children keep their
    tilt."""
    quats, root = body.local_quat_xyzw.clone(), body.root_position.clone()
    facing = heading(known.local_quat_xyzw[:, 0]) - heading(quats[:, 0])
    turned = rotations.multiply(rotations.about_y(facing), quats[:, 0])
    tilted = rotations.multiply(rotations.inverse(known.local_quat_xyzw[:, 0]), turned)
    for child in body.skeleton.children(0):
        quats[:, child] = torch.where(frames[:, None], rotations.multiply(tilted, quats[:, child]), quats[:, child])
    quats[frames, 0], root[frames] = known.local_quat_xyzw[frames, 0], known.root_position[frames]
    return replace(body, local_quat_xyzw=quats, root_position=root)


def _blend_key_poses(body: Motion, posed: Motion, keys: Bool[Tensor, " frames"], query: GapQuery) -> Motion:
    """Blend `body` to the poses `posed` in the frames of keys and back, feet staying on their own trajectories."""
    fps = float(body.fps)
    positions, goals = body.joint_positions(), posed.joint_positions()
    distance = torch.where(keys[:, None], (goals - positions).norm(dim=-1), 0.0)
    limb = _compute_duration(distance[:, [limb.end for limb in LIMBS.values()]], _MIN_LIMB_SECONDS, _LIMB_ACCELERATION)
    trunk = _compute_duration(distance[:, :1], _MIN_TRUNK_SECONDS, _TRUNK_ACCELERATION)
    known = ~query.missing.joints | keys[:, None]
    wanted_quats = torch.where(keys[:, None, None], posed.local_quat_xyzw, body.local_quat_xyzw)
    quats = body.local_quat_xyzw.clone()
    for joints, seconds in ((_ARMS, limb), (_TRUNK, trunk)):
        there, firm = wanted_quats[:, joints], known[:, joints]
        quats[:, joints] = interpolate_turns(quats[:, joints], there, firm, seconds=seconds, fps=fps)
    offset = interpolate_offsets(
        (posed.root_position - body.root_position) * keys[:, None], ~query.missing.root | keys, seconds=trunk, fps=fps
    )
    generated = replace(body, root_position=body.root_position + offset, local_quat_xyzw=quats)
    goals_generated, wanted = generated.joint_positions(), torch.zeros_like(query.missing.joints)
    for foot in _FEET:
        firm = keys | ~query.missing.joints[:, CANONICAL.parents[foot]]
        goals_generated[:, foot] = positions[:, foot] + interpolate_offsets(
            (goals - positions)[:, foot] * keys[:, None], firm, seconds=limb, fps=fps
        )
    # Legs alone: arms that are to reach something would be turned back to where they were.
    turning = query.missing.joints.index_fill(1, torch.tensor(_ARMS), False)
    return bend_limbs(generated, body, goals_generated, wanted, turning)


def _compute_duration(distance: Float[Tensor, "frames parts"], least: float, calm: float) -> float:
    """Compute the seconds in which the farthest part goes to its target and back: a spring's of acceleration `calm`."""
    return max(least, math.sqrt(float(distance.max()) / calm))


class SlerpInbetweener(Inbetweener):
    """In-betweener that proposes the query's interpolation; before and after all known frames poses are held."""

    def propose(self, query: GapQuery, *, generator: torch.Generator | None = None) -> Proposal:
        """Propose the query's own motion, with contacts where its toes are low and slow."""
        return Proposal(query.motion, estimate_contact_logits(query.motion), "slerp")


@dataclass(frozen=True, eq=False)
class StitchedInbetweener(Inbetweener):
    """In-betweener that fills gaps between two whole poses from both sides (Ren et al. 2024), and leaves all others to
    another one."""

    stitcher: Inbetweener
    """In-betweener that leaves interpolated what it cannot fill, with the reason in its proposal."""
    load_fallback: Callable[[], Inbetweener]
    """Loader of the in-betweener for the rest, called where there is some."""

    def propose(self, query: GapQuery, *, generator: torch.Generator | None = None) -> Proposal:
        """Propose for each gap the stitcher's motion; gaps that it leaves are the other's, with the reason in the
        proposal."""
        stitched = self.stitcher.propose(query, generator=generator)
        sources = stitched.attribute(query.hide_partial_keys())
        left = [source for source in sources if source.by == INTERPOLATION]
        filled = [source for source in sources if source.by != INTERPOLATION]
        if not left:
            return stitched
        rest = self.load_fallback().propose(query, generator=generator)
        gaps = [(source.start, source.stop) for source in filled]
        named = {one.start: one for one in rest.others if not _is_within((one.start, one.stop), gaps)}
        for source in left:  # both reasons, where the other one left the gap, too
            own = named.get(source.start, GapSource(source.start, source.stop, rest.source))
            named[source.start] = replace(own, reason="; ".join(filter(None, (source.reason, own.reason))))
        named |= {source.start: source for source in filled}
        return replace(rest.take(stitched, gaps), others=tuple(named.values()))


_LEAST_DISTANCE = 0.3  # metres from position to position, at the canonical size, that are walked and not stood


def lay_curve(query: GapQuery, fastest: float, ahead: int) -> tuple[Curve, Float[Tensor, " ahead"]] | None:
    """Lay a curve through the positions of a query that gives no pose, from its first frame to its last, metres at the
    canonical size; also return the arcs of the frames and of so many `ahead` of them, metres. None where there are
    drawings or poses, and where the body would stand, or be faster than `fastest`, m/s."""
    loose = query.loose
    if loose is None or bool(loose.drawn.any()):
        return None
    if not bool(query.nothing_known.all()):
        return None
    frames = loose.placed.nonzero()[:, 0]
    if len(frames) < 2 or int(frames[0]) > 0 or int(frames[-1]) < query.motion.num_frames - 1:
        return None
    positions = loose.ground[frames].double() / query.scale
    distances = torch.diff(positions, dim=0).norm(dim=-1)
    speeds = distances * PRIOR_FPS / torch.diff(frames)
    if float(distances.min()) < _LEAST_DISTANCE or float(speeds.max()) > fastest:
        return None
    curve = curves.through(positions)
    at = _find_arcs(curve, positions)
    if float(torch.diff(at).min()) <= 0:
        return None
    timed = scipy.interpolate.PchipInterpolator(frames.numpy(), at.numpy())
    inside = torch.as_tensor(timed(torch.arange(int(frames[-1]) + 1).numpy()))
    speed = float(inside[-1] - inside[-2])
    return curve, torch.cat([inside, inside[-1] + speed * torch.arange(1, ahead + 1)])


def walk_over_positions(
    query: GapQuery, densities: Sequence[Density], generator: torch.Generator | None
) -> Proposal | None:
    """Propose a walk over positions by the first density, that of locomotion; None where it is not one that the density
    knows (see `lay_curve`)."""
    settings = FollowSettings()
    laid = lay_curve(query, densities[0].limits.fastest, settings.window.frames) if densities else None
    if laid is None:
        return None
    curve, arcs = laid
    frames = query.motion.num_frames
    motion, done, _ = walk_arcs(
        densities[0],
        curve,
        arcs,
        frames,
        character=Character(),
        settings=settings,
        generator=generator or torch.Generator().manual_seed(0),
    )
    root, source = motion.root_position * query.scale, f"walk of {densities[0].name}"
    planted = done.features[:, LAYOUT.slices["contacts"]] > 0.5
    return Proposal(
        replace(query.motion, root_position=root, local_quat_xyzw=motion.local_quat_xyzw),
        contacts.to_logits(planted),
        source,
        (GapSource(0, frames, source, "along a curve through the positions, which are all that keys give"),),
    )


def _find_arcs(curve: Curve, positions: Float[Tensor, "positions 2"]) -> Float[Tensor, " positions"]:
    """Find the arcs of the positions that a curve leads through, metres."""
    dense = torch.linspace(0, curve.length, max(2, round(100 * curve.length)), dtype=torch.float64)
    points, found, first = curve.ground_point(dense), [], 0
    for position in positions[:-1]:
        # A curve that crosses itself comes by twice.
        away = (points[first:] - position).norm(dim=-1)
        near = (away < float(away.min()) + 0.01).nonzero()[0, 0] if len(found) else away.argmin()
        first += int(near)
        found.append(float(dense[first]))
    return torch.tensor([*found, curve.length], dtype=torch.float64)


_PAST_FRAMES = 3  # frames before a gap that terms look back on


def select_likeliest_density(densities: Sequence[Density], motion: Motion) -> Density:
    """Select the density under which a canonical motion, with a proposal's observation noise, is likeliest."""
    if len(densities) == 1:
        return densities[0]
    blurred = [density.with_observation_noise(density_selection.proposal_sigma()) for density in densities]
    return densities[blurred.index(density_selection.select_density_for_motion(blurred, motion).density)]


def commit_before(
    body: Motion,
    contact_logits: Float[Tensor, "frames 2"],
    start: int,
    density: Density,
    state: DensityState | None = None,
    *,
    since: int = 0,
) -> CommittedFrames:
    """Commit a motion's frames before a gap, with their contacts, single precision; a density's `state` is advanced
    from frame `since` on."""
    features, before = encode(body.slice(0, max(2, start)))
    ground, heading = integrate_root(features, before)
    features[:, LAYOUT.slices["contacts"]] = (contact_logits[: len(features)] > 0).to(features)
    features = features[:start].float()
    ground_pose = GroundPose(ground[start - 1].float(), heading[start - 1].float())
    past = body.slice(max(0, start - _PAST_FRAMES), start).joint_positions().float()
    return CommittedFrames(replay(density, features, state, since=since), ground_pose, features, past)


def insert_rollout(
    body: Motion,
    contact_logits: Float[Tensor, "frames 2"],
    window: SolvedWindow,
    ground_pose: GroundPose,
    gap: tuple[int, int],
) -> tuple[Motion, Float[Tensor, "frames 2"]]:
    """Insert a rollout in its gap, corrected so that it arrives at the frame after it, if there is one; also return the
    contact logits."""
    start, stop = gap
    generated = decode(
        window.trial.features[0], GroundPose(ground_pose.position_xz.double(), ground_pose.heading.double())
    )
    count, planted = stop - start, window.trial.contacts[0]
    root, quats, logits = body.root_position.clone(), body.local_quat_xyzw.clone(), contact_logits.clone()
    root[start:stop], quats[start:stop] = generated.root_position[:count], generated.local_quat_xyzw[:count]
    if count < len(generated.root_position):
        there, here = body.slice(stop, stop + 1), generated.slice(count, count + 1)
        root[start:stop], quats[start:stop] = _arrive(here, there, root[start:stop], quats[start:stop])
    new = torch.zeros(len(root), dtype=torch.bool)
    new[start:stop] = True
    logits[start:stop] = contacts.to_logits(planted[:count]).to(logits)
    filled = replace(body, root_position=root, local_quat_xyzw=quats)
    return blend_seams(filled, MissingMask.of_frames(new, body.num_joints)), logits


def _arrive(
    here: Motion, there: Motion, root: Float[Tensor, "frames 3"], quats: Float[Tensor, "frames joints 4"]
) -> tuple[Float[Tensor, "frames 3"], Float[Tensor, "frames joints 4"]]:
    """Spread what a rollout arrives `here` instead of `there` over all its frames: none of it in the two frames before,
    all of it in two after, so that it leaves and arrives at its own pace."""
    turn = rotations.turns_between(here.local_quat_xyzw, there.local_quat_xyzw)
    firm = torch.ones(len(root) + 4, dtype=torch.bool)
    firm[2:-2] = False
    miss = root.new_zeros(len(firm), 3 + 3 * quats.shape[1])
    miss[-2:] = torch.cat([there.root_position - here.root_position, turn.flatten(1)], dim=1)
    offsets = interpolate_offsets(miss, firm, seconds=math.inf, fps=PRIOR_FPS)[2:-2]
    turns = rotations.from_rotation_vector(offsets[:, 3:].unflatten(1, (-1, 3)))
    return root + offsets[:, :3], rotations.multiply(quats, turns)


EVERY_ROLLOUT_JUMPED = "every rollout jumped"
"""Why a gap is the fallback's that rollouts would take."""
_ENDS = CANONICAL.indices(("leftHand", "rightHand", *TOES))  # what a leg or an arm that is thrown over moves farthest


_TEMPERATURE, _SLOW = 0.5, 3.0
"""Standard deviation of a rollout's initial noise, the difference between samples; and frames (sigma) over which it is
smoothed, at the same deviation: samples then differ in motion, not in jitter."""
_SIGMA_NOISE = 2.0  # of the latent prior while steering: above 1 leaves more of the initial noise
_SIGMA_ARRIVAL = 0.03  # metres, of every joint from the known frames at which a rollout arrives
_SHORTEST, _LONGEST = 2, 180  # frames of gaps that are rolled through: shorter ones leave nothing to vary
_ATTEMPTS = 3  # rollouts through a gap, each from other noise, until one does not jump
_FOOTING = FootContact(0.1, 0.05, 0.05, heels=None)
ROLLOUT_SPAN = f"{(_SHORTEST + 1) / PRIOR_FPS:.2g} to {(_LONGEST + 1) / PRIOR_FPS:.2g} s"
"""Range of gaps that are rolled through, in words: seconds from key to key."""


ROLLOUT_SOLVER = LatentNoiseSolver(
    rounds=2,
    lbfgs=LbfgsSettings(max_iterations=24),
    budget=Budget(evaluations=96),
    proposal=SwarmProposal(SwarmSettings(particles=8, iterations=5)),
)
"""Search of rollouts: a swarm, and L-BFGS after it."""


@dataclass(frozen=True, eq=False)
class RolloutInbetweener(Inbetweener):
    """In-betweener that rolls the density under which the fallback's proposal is likeliest through unknown gaps, one
    after the other in time."""

    densities: Sequence[Density]
    """Densities to choose from, at least one."""
    fallback: Inbetweener
    """Proposes what is not rolled through, and what comes before and after."""
    ahead: int = 15
    """Frames after a gap that are rolled with it, of which the known ones are targets too."""
    jump: float = 1.5
    """A rollout jumps where a hand or a foot steps, relative to the hips, so many times as far as anywhere in the
    fallback's motion: an arrival that noise does not lead to is bought with a leg thrown over in one frame."""
    least_jump: float = 0.12
    """Metres in a frame that no jump stays under, however still the fallback's motion is; hands and feet of a walk step
    as far."""
    solver: LatentNoiseSolver = ROLLOUT_SOLVER
    """Search of one rollout."""

    @property
    def rough(self) -> Inbetweener:
        """Rough in-betweener of the fallback."""
        return self.fallback.rough

    def propose(self, query: GapQuery, *, generator: torch.Generator | None = None) -> Proposal:
        """Propose a different motion for each sample; gaps too short or too long are left to the fallback, and so are
        gaps in which every attempt jumps, and loose keys but for those that give positions alone, which are walked
        over."""
        if query.loose is not None:
            walked = walk_over_positions(query, self.densities, generator)
            return walked or self.fallback.propose(query, generator=generator)
        base = self.fallback.propose(query, generator=generator)
        if not query.enclosed_gaps:
            return base
        generator = generator or torch.Generator().manual_seed(0)
        body, logits, others = query.to_unit_size(base.motion), base.contact_logits.clone(), list(base.others)
        density = select_likeliest_density(self.densities, body)
        largest = max(self.least_jump, self.jump * _measure_largest_step(body))
        state, since = None, 0
        for start, stop in query.enclosed_gaps:
            if not _SHORTEST <= stop - start <= _LONGEST:
                others.append(GapSource(start, stop, base.source, f"rollouts take {ROLLOUT_SPAN}"))
                continue
            committed = commit_before(body, logits, start, density, state, since=since)
            assert not isinstance(committed.state, tuple), "one density has one state"
            state, since = committed.state, start
            for _ in range(_ATTEMPTS):
                rolled = self._roll(query, body, logits, density, committed, (start, stop), generator)
                if _measure_largest_step(rolled[0].slice(start - 1, stop + 1)) <= largest:
                    body, logits = rolled
                    others.append(GapSource(start, stop, f"rollout of {density.name}"))
                    break
            else:
                others.append(GapSource(start, stop, base.source, EVERY_ROLLOUT_JUMPED))
        return replace(base, motion=query.to_character(body), contact_logits=logits, others=tuple(others))

    def _roll(
        self,
        query: GapQuery,
        body: Motion,
        logits: Float[Tensor, "frames 2"],
        density: Density,
        committed: CommittedFrames,
        gap: tuple[int, int],
        generator: torch.Generator,
    ) -> tuple[Motion, Float[Tensor, "frames 2"]]:
        """Roll through a gap to all joints in the known frames after it; also return the contact logits."""
        start, stop = gap
        part = slice(start, stop + self.ahead)
        known = ~query.nothing_known[part]
        frames = int(known.nonzero()[-1]) + 1
        positions = body.joint_positions()[part][:frames]
        wanted = known[:frames, None].expand(-1, CANONICAL.num_joints)
        arrival = Keyframe(positions.float(), wanted, _SIGMA_ARRIVAL)
        white = torch.randn(frames, LAYOUT.continuous, generator=generator)
        noise = _TEMPERATURE * gaussian.unit_variance_matrix(frames, _SLOW, white.dtype) @ white
        window = RecedingHorizonSolver(density, method=self.solver).solve_window(
            replace(committed, warm_start=noise),
            (LatentPrior(_SIGMA_NOISE), _FOOTING, arrival),
            frames,
            generator=generator,
        )
        return insert_rollout(body, logits, window, committed.ground_pose, gap)


def _measure_largest_step(body: Motion) -> float:
    """Measure how far a hand or a toe steps at most from one frame to the next, relative to the hips, metres."""
    positions = body.joint_positions()
    return measure_peaks(positions[:, _ENDS], positions[:, 0], PRIOR_FPS).step


_MIN_KNOWN_FRAMES = 5  # fewest frames from which a motion is extrapolated


def extrapolate_end(query: GapQuery, proposal: Proposal, densities: Sequence[Density]) -> Proposal:
    """Extrapolate a proposal from the last known frame to its end, if nothing is known there.

    It stays unchanged where the first density (that of locomotion) does not find the frames before as likely as its own
    data: densities then stop or turn away. None runs backwards, so a beginning stays as well.
    """
    missing, stop = query.nothing_known, query.motion.num_frames
    start = stop - int(missing.flip(0).long().cumprod(0).sum())
    # Only frames since the gap before count, not what fills that.
    since = int(missing[:start].nonzero()[-1]) + 1 if bool(missing[:start].any()) else 0
    if start == stop or start - since < _MIN_KNOWN_FRAMES or not densities:
        return proposal
    body, logits = query.to_unit_size(proposal.motion), proposal.contact_logits
    known = body.slice(since, start)
    blurred = densities[0].with_observation_noise(density_selection.proposal_sigma())
    if density_selection.select_density_for_motion([blurred], known).weight < 1:
        return proposal
    density = select_likeliest_density(densities, known)
    solver = RecedingHorizonSolver(density, method=replace(ROLLOUT_SOLVER, proposal=None))
    for first in range(start, stop, _LONGEST):
        committed, count = commit_before(body, logits, first, density), min(_LONGEST, stop - first)
        terms = (LatentPrior(_SIGMA_NOISE), _FOOTING)
        window = solver.solve_window(committed, terms, count, generator=torch.Generator())
        body, logits = insert_rollout(body, logits, window, committed.ground_pose, (first, first + count))
    source = GapSource(start, stop, f"density {density.name}")
    return replace(proposal, motion=query.to_character(body), contact_logits=logits, others=(*proposal.others, source))


STANDING_STILL = "standing still"
"""Name of the source of a gap in which the pose before it is held."""
_PLANTED_HEIGHT = 0.025  # metres above the lowest toe
_LIVELY = 0.5
"""Path of the joints seen from the hips, over that of the tweener, from which on a long gap is the network's all the
same: walks it fills better, and outside its training data it hardly moves."""
_STYLED = 60  # frames of the shortest gap that is a tweener's that was given a style: in less there is no room for one
_HELD = 46  # frames of the shortest gap in which a pose is held
_ASTRAY = 0.03  # metres over the ground from which on standing hips are astray, and the pose is held
_SAME_POSE_DISTANCE = 0.06  # mean distance of the joints, metres, below which two poses count as one
_AT_REST = 0.15  # mean speed of the joints beside a gap, m/s, below which the body is at rest


@dataclass(frozen=True, eq=False)
class AutoInbetweener(Inbetweener):
    """In-betweener that takes a network's proposal, except in gaps that are a tweener's and where a pose is held; the
    end is extrapolated by a density."""

    network: Inbetweener
    """In-betweener that proposes first, and fills gaps in which something is known."""
    densities: Sequence[Density] = ()
    """Densities for the end, and for walks over positions; without any both are the network's or the tweener's."""
    long: int = 181
    """Frames of the shortest gap between whole poses, with partial keys in it or none, that can be a tweener's."""
    tweener: Inbetweener | None = None
    """In-betweener for long gaps between whole poses; without one they are the network's."""

    @property
    def rough(self) -> Inbetweener:
        """Rough in-betweener of the network."""
        return self.network.rough

    @property
    def has_style(self) -> bool:
        """Whether the tweener was given one."""
        return self.tweener is not None and self.tweener.has_style

    def propose(self, query: GapQuery, *, generator: torch.Generator | None = None) -> Proposal:
        """Propose for each gap what its length and the poses beside it ask for.

        Loose keys are the tweener's, if there is one; keys that give positions alone are walked over by a density
        where its training data hold such walks.
        """
        if query.loose is not None:
            walked = walk_over_positions(query, self.densities, generator)
            return walked or (self.tweener or self.network).propose(query, generator=generator)
        answer = self.network.propose(query, generator=generator)
        whole = query.hide_partial_keys().enclosed_gaps
        long = [gap for gap in whole if self._is_tweeners(query, *gap)]
        if long and self.tweener is not None:
            tweened = self.tweener.propose(query, generator=generator)
            long = [gap for gap in long if self.has_style or not _stays_networks(query, answer, tweened, gap)]
            answer = _fill_from(tweened, answer, query, long)
        for gap in query.enclosed_gaps:
            # A body that was given a style moves; tweeners let others tremble.
            held = not self.has_style if _is_within(gap, long) else _goes_astray(query, answer, gap)
            if held and _is_standing_still(query, *gap):
                answer = _hold_pose(query, answer, gap)
        if self.has_style:
            reason = "too short, or with partial keys, for a style"
            gaps = [gap for gap in query.enclosed_gaps if not _is_within(gap, long)]
            sources = [one for one in answer.attribute(query) if (one.start, one.stop) in gaps]
            unstyled = tuple(replace(one, reason=one.reason or reason) for one in sources)
            answer = replace(answer, others=(*answer.others, *unstyled))
        return extrapolate_end(query, answer, self.densities)

    def _is_tweeners(self, query: GapQuery, start: int, stop: int) -> bool:
        """Return whether a gap is the tweener's: long, or with room for the style that it was given."""
        if self.tweener is None or query.keep_trajectory:
            return False
        shortest = _STYLED if self.has_style else self.long
        return stop - start >= shortest and not _is_beside_part(query, start, stop)


def _stays_networks(query: GapQuery, answer: Proposal, tweened: Proposal, gap: tuple[int, int]) -> bool:
    """Return whether a gap stays the network's: it fills the whole of it, and the body moves there."""
    by = {one.by for one in answer.attribute(query) if gap[0] <= one.start and one.stop <= gap[1]}
    if INTERPOLATION in by:
        return False
    path, other = (measure_path_length(one.motion.slice(gap[0] - 1, gap[1] + 1)) for one in (answer, tweened))
    return path >= _LIVELY * other


def _is_beside_part(query: GapQuery, start: int, stop: int) -> bool:
    """Return whether a frame beside a gap is known in part."""
    edges = [start - 1, stop]
    return bool(query.missing.joints[edges].any() | query.missing.root[edges].any())


def _is_within(gap: tuple[int, int], gaps: Sequence[tuple[int, int]]) -> bool:
    """Return whether a gap is one of others, or between partial keys in one of them."""
    return any(start <= gap[0] and gap[1] <= stop for start, stop in gaps)


def _fill_from(proposal: Proposal, generated: Proposal, query: GapQuery, gaps: Sequence[tuple[int, int]]) -> Proposal:
    """Fill gaps as another proposal has them."""
    sources = proposal.attribute(query)
    others = tuple(source for source in sources if _is_within((source.start, source.stop), gaps))
    return replace(generated.take(proposal, gaps), others=(*generated.others, *others))


def _is_standing_still(query: GapQuery, start: int, stop: int) -> bool:
    """Return whether the body rests in the same whole pose and position before and after a gap."""
    if stop - start < _HELD or query.keep_trajectory or _is_beside_part(query, start, stop):
        return False
    positions, unknown = query.motion.joint_positions(), query.missing.frames
    apart = float((positions[stop] - positions[start - 1]).norm(dim=-1).mean())
    speeds = [0.0]
    for one, other in ((start - 2, start - 1), (stop, stop + 1)):
        if one >= 0 and other < len(positions) and not bool(unknown[[one, other]].any()):
            speeds.append(float((positions[other] - positions[one]).norm(dim=-1).mean()) * PRIOR_FPS)
    return apart < _SAME_POSE_DISTANCE and max(speeds) < _AT_REST


def _goes_astray(query: GapQuery, generated: Proposal, gap: tuple[int, int]) -> bool:
    """Return whether a proposal takes the hips far from the straight line through a gap."""
    part = slice(*gap)
    off = (generated.motion.root_position - query.motion.root_position)[part, ::2].norm(dim=-1)
    return float(off.max()) > _ASTRAY * query.scale


def _hold_pose(query: GapQuery, generated: Proposal, gap: tuple[int, int]) -> Proposal:
    """Hold the pose, interpolated slowly to the next."""
    part, logits = slice(*gap), generated.contact_logits.clone()
    toes = query.motion.joint_positions()[part, list(TOE_JOINTS), 1]
    logits[part] = contacts.to_logits(toes < toes.amin() + _PLANTED_HEIGHT).to(logits)
    return _fill_from(Proposal(query.motion, logits, STANDING_STILL), generated, query, [gap])


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
    "auto": lambda models: AutoInbetweener(models.network("auto"), models.densities(), tweener=models.tweener()),
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
