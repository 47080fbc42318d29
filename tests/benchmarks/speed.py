"""Cost of each job on one thread: seconds of processor time a second of motion, on the clips of a folder.

`denoise` cleans the clip; `infill` fills a second in its middle; `tween` keeps one pose a second; `follow`, `steer` and
`generate` take no clip and run once, on the canonical body. `--model` is the density of these three.
"""

import time
from collections.abc import Callable

import torch
from common import Row, average, load_circles, parse, print_table, seeded

import controllers
import priors
from controllers.steering import steer
from mapctl import curves
from mapctl.errors import MapctlError
from mapctl.intent.steering import Command
from mapctl.motion import Motion
from mapctl.recording.masks import ALL, Mask


def time_job(job: Callable[[], Motion]) -> float:
    """Measure the seconds that a second of motion takes."""
    began = time.process_time()
    motion = job()
    return (time.process_time() - began) / motion.seconds


def main(words: list[str] | None = None) -> None:
    """Measure and print."""
    torch.set_num_threads(1)
    given = parse(__doc__, words, count=5, model="locomotion", seconds=8.0)
    circles = load_circles(given, shortest=2.2, longest=given.seconds, model="transformer")
    prior, denoiser, transformer = priors.load(given.model), priors.load_denoiser(), priors.load_transformer()

    def steered() -> Motion:
        state, piece = steer.begin(prior, Command(1.2, 0.0), generator=seeded(given.seed))
        motion = piece.motion
        while motion.seconds < given.seconds:
            state, piece = steer.step(state, Command(1.2, 0.5 * motion.seconds))
            motion = motion.join(piece.motion)
        return motion

    def denoise(motion: Motion) -> Motion:
        return controllers.denoise(motion, denoiser, inbetweener=transformer).motion

    def infill(motion: Motion) -> Motion:
        middle, half = motion.num_frames // 2, round(float(motion.fps) / 2)
        return controllers.infill(motion, transformer, [Mask(ALL, middle - half, middle + half)]).motion

    def tween(motion: Motion) -> Motion:
        frames = range(0, motion.num_frames, round(float(motion.fps)))
        return controllers.tween(motion, controllers.Keys(tuple(frames)), transformer).motion

    single: dict[str, Callable[[], Motion]] = {
        "follow": lambda: (
            controllers.follow(
                prior, curves.circle(radius=4.0), seconds=given.seconds, generator=seeded(given.seed)
            ).motion
        ),
        "steer": steered,
        "generate": lambda: controllers.generate(prior, seconds=given.seconds, generator=seeded(given.seed)).motion,
    }
    denoise(circles[0].clips[0].motion.slice(0, 60))  # kernels are compiled or loaded, once a machine
    single["follow"]()
    rows: list[Row] = [{"clips of": "", "job": name, "s a second": time_job(job)} for name, job in single.items()]
    for circle in circles:
        for name, job in (("denoise", denoise), ("infill", infill), ("tween", tween)):
            costs = []
            for clip in circle.clips:
                try:
                    costs.append((time_job(lambda: job(clip.motion)), clip.name))  # noqa: B023 - called at once
                except MapctlError:
                    circle.skipped += 1
            worst, slowest = max(costs, default=(None, ""))
            mean = average([cost for cost, _ in costs])
            rows.append(
                {"clips of": circle.name, "job": name, "s a second": mean, "worst": worst, "worst clip": slowest}
            )
    print_table(rows, circles)


if __name__ == "__main__":
    main()
