"""`mapctl tween`: a motion through keyframes."""

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import arg

from mapctl.commands.shared import options
from mapctl.commands.shared.command import ModelCommand


@dataclass(frozen=True)
class Tween(ModelCommand, options.RigOptions):
    """Make the motion between keyframes: frames of a clip, or poses that a file sets in time and space. On any known
    rig."""

    source: options.InFile
    """A motion file; or a TOML file of [[key]] tables: a frame or seconds, a pose (a motion file and a pose_frame of
    it), a place = [x, z], height and facing_deg of the hips, and joints, reach, half = "upper" or "lower", or root_only
    = true or "place" where not all of it counts; or a drawing (a CSV of joint,x,y) and view_deg
    (docs/guides/keyframes.md)."""
    out: options.OutFile
    """Where the motion goes: as long as IN, or until the last key."""
    keyframes: Annotated[str | None, arg(metavar="F,F,...")] = None
    """Keyframes of a motion file, or seconds as in 1.5s; the first and the last one are whole poses."""
    joints: Annotated[str | None, arg(metavar="NAME,NAME")] = None
    """Keys between the first and the last give only the positions of these hands or feet: canonical names or the rig's
    own."""
    root_only: bool = False
    """Keys between the first and the last give only the position and the facing of the hips."""
    suggest_timing: bool = False
    """Print how many frames mocap takes from each whole pose to the next, beside what is given; the motion keeps the
    given timing."""
    timing: options.MaybeName = None
    """The file or run folder of a trained keyframe timing for --suggest-timing; the bundled one if not given."""
    method: options.Method = "auto"
    """Method that proposes. auto: the transformer, the stitcher where hands, feet or hips are told in up to 2 s, the
    tweener, if the set of weights has one, through gaps of more than 8 s and those of more than 6 s in which the
    transformer hardly moves, or a held pose where the body stands still; a note on each gap names it. transformer,
    infiller, tweener: that network alone. stitcher: gaps of up to 2 s between whole poses from both sides, led by
    hands, feet, hips or a trajectory told in them. rollouts: a density's rollouts, wherever nothing is known. slerp:
    interpolation."""
    dna: options.MaybeDna = None
    """Motion files of any known rig, or classes that `mapctl info tweener` lists, whose style the tweener takes: in all
    gaps with --method tweener, in those of 2 s and more between whole poses with auto. Several are mixed."""
    no_finish: bool = False
    """Leave the proposal as it is, on rigid bones and with exact keys: no MAP stage plants the feet."""
    inbetweener: options.MaybeName = None
    """The file or run folder of a trained transformer, infiller or tweener; the bundled one if not given. With auto a
    tweener is for long gaps, beside the bundled transformer."""
    stitcher: options.MaybeName = None
    """The file or run folder of a trained stitcher for --method stitcher, where --inbetweener fills what it leaves, and
    for auto; the bundled one if not given."""
    path: options.MaybeName = None
    """The file or run folder of the path predictor that the tweener was trained with; the bundled one if not given."""
    prior: options.MaybeName = None
    """A density whose likelihood joins the MAP stage: a bundled one, a file or a run folder; `auto` takes, window by
    window, the bundled one under which the motion is likelier."""
    variations: options.Count = 1
    """Number of different motions, as OUT_000.bvh, OUT_001.bvh, ...: the first is what a single one would be. With
    --dna the others are in one of its styles each, and when all were had by some of the poses of one; with --method
    tweener alone each is of a class; with --method stitcher they are its draws. Else they are rollouts of densities
    (--prior, or auto), steered from key to key."""
    best_of: options.Count = 1
    """Number of motions of which the one with the lowest energy is kept: from the network's proposal, slerp's, and
    rollouts of densities (--prior, or auto) that are steered from key to key; with --method stitcher from its calm
    answer and its draws."""
    seed: options.Count = 0
    """Seed of everything that is sampled; the first variations do not depend on their number."""
    report: options.MaybeFile = None
    """JSON with the keys, the errors at them, contacts, ledger, measures, compute and suggested timing."""
    video: options.MaybeFile = None
    """Film of the given motion and the new one side by side: .mp4, .gif, .webp or .png. Of variations a .png: a row of
    stills of each, under the name of its style."""
    strict: bool = False
    """Exit with status 3 where not all that was requested holds: keys too close in time, limbs out of reach."""
    quiet: bool = False
    """No summary and no progress bar."""
