"""Generated motion beside the clips of a folder: how well a small classifier separates them, Frechet distance, feet.

`--model` is a density, `--refiner` a refiner of its samples, `--count` the number of clips of either side, of
`--seconds`, `--steps` those of the classifier's training. An accuracy of 50 % is perfect;
the floor is that of one half of the folder's clips against the other. A folder needs eight clips, and should hold the
motion that the density was trained on: else its content gives generated clips away.
"""

from argparse import Namespace
from collections.abc import Sequence
from dataclasses import replace

from common import Row, load_circles, parse, print_table, seeded
from follow import average_gait

import controllers
import priors
from controllers.generation.generate import SIGMA_PLANTED, sample_stratified_starts
from mapctl.errors import MapctlError
from mapctl.metrics import measure
from mapctl.metrics.realism import RealismSettings, cut_windows, measure_realism
from mapctl.motion import Motion
from mapctl.protocols import Density, Refiner


def generate_clips(
    prior: Density, settings: controllers.GenerateSettings, refiner: Refiner | None, given: Namespace
) -> list[Motion]:
    """Generate clips from initial states that cover those of the density."""
    starts = sample_stratified_starts(prior, given.count, seeded(given.seed))
    return [
        controllers.generate(
            prior,
            seconds=given.seconds,
            generator=seeded(given.seed, number),
            settings=replace(settings, start=start),
            refiner=refiner,
        ).motion
        for number, start in enumerate(starts)
    ]


def describe(name: str, circle: str, clips: Sequence[Motion]) -> Row:
    """Measure feet and jitter, and name the clip whose feet slide most."""
    found = [measure(clip) for clip in clips]
    sliding = max((each["contact_speed_cm_s"] for each in found if each["contact_speed_cm_s"] >= 0), default=None)
    return {"clips of": circle, "motion": name, "clips": len(clips), **average_gait(found), "worst, cm/s": sliding}


def main(words: list[str] | None = None) -> None:
    """Measure and print."""
    given = parse(__doc__, words, count=24, model="locomotion", seconds=6.0, steps=200, refiner="")
    circles = load_circles(given, shortest=2.0, longest=given.seconds, canonical=True, model=given.model)
    prior, usual = priors.load(given.model), controllers.GenerateSettings()
    bare = replace(usual, foot_cleanup=None)
    variants = {
        "samples": bare,
        "planted samples": replace(bare, sigma_planted=SIGMA_PLANTED),
        "mapctl generate": usual,
    }
    result = {name: generate_clips(prior, settings, None, given) for name, settings in variants.items()}
    if given.refiner:
        result["refined"] = generate_clips(prior, usual, priors.load_refiner(given.refiner), given)
    settings = RealismSettings(steps=given.steps)
    rows: list[Row] = []
    for circle in circles:
        clips = [clip.motion for clip in circle.clips]
        rows.append(describe("the clips themselves", circle.name, clips) if clips else {"clips of": circle.name})
        for name, motions in result.items():
            row = describe(name, circle.name, motions)
            try:
                windows = [list(map(cut_windows, one)) for one in (motions, clips)]
                found = measure_realism(*windows, generator=seeded(given.seed), settings=settings)
                row = {
                    **row,
                    "accuracy": f"{found.accuracy:.0%}",
                    "floor": f"{found.floor_accuracy:.0%}",
                    "Frechet": found.frechet,
                    "its floor": found.floor_frechet,
                }
            except MapctlError:  # fewer than eight clips
                pass
            rows.append(row)
    print_table(rows, circles)


if __name__ == "__main__":
    main()
