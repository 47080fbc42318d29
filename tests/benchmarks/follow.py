"""Following curves beside motion matching: path error, and the feet and jitter of walks beside those of mocap.

`--model` is a density. Motion matching (Clavet 2016) plays the clips of each folder, as they are and with feet planted
afterwards. Walks of at most 8 s; `--walks` is their number on each curve. Means are over walks.
"""

import time
from collections.abc import Callable

import torch
from common import Circle, Row, average, load_circles, parse, print_table, seeded
from motion_matching import MotionDatabase, follow_by_matching

import controllers
import priors
from mapctl import curves
from mapctl.curves import Curve
from mapctl.editing import plant_feet
from mapctl.errors import MapctlError
from mapctl.features import encode
from mapctl.metrics import measure
from mapctl.motion import Motion

COURSES = (("line:8", 1.2), ("circle:4", 1.2), ("figure8:2", 1.2), ("s:8", 1.2), ("wave:1x8", 1.2), ("circle:4", 2.4))
SECONDS = 8.0
Walker = Callable[[Curve, float, float, torch.Generator], Motion]  # a curve, seconds and m/s to a walk


def measure_walks(walker: Walker, walks: int, seed: int) -> Row:
    """Measure walks of all courses; the worst is the largest path error."""
    found: list[dict[str, float]] = []
    worst, spent, frames = (0.0, ""), 0.0, 0
    for course, speed in COURSES:
        curve = curves.read(course)
        for walk in range(walks):
            began = time.process_time()
            motion = walker(curve, min(SECONDS, curve.length / speed), speed, seeded(seed, walk))
            spent, frames = spent + time.process_time() - began, frames + motion.num_frames
            found.append(measure(motion, curve, speed=speed))
            worst = max(worst, (found[-1]["path_error_max_cm"], f"{course} at {speed} m/s"))
    return {
        "walks": len(found),
        "path error, cm": average([each["path_error_mean_cm"] for each in found]),
        "worst, cm": worst[0],
        "worst walk": worst[1],
        "progress": average([each["progress_ratio"] for each in found]),
        **average_gait(found),
        "ms a frame": 1000 * spent / frames,
    }


def average_gait(found: list[dict[str, float]]) -> Row:
    """Average what shows how a walk looks."""
    names = {"planted toes, cm/s": "contact_speed_cm_s", "skate, cm/s": "skate_cm_s", "jitter, m/s^3": "jitter_m_s3"}
    return {label: average([each[name] for each in found]) for label, name in names.items()}


def measure_mocap(circle: Circle) -> Row:
    """Measure the clips of a folder themselves."""
    return {"method": "the clips themselves", **average_gait([measure(clip.motion) for clip in circle.clips])}


def main(words: list[str] | None = None) -> None:
    """Measure and print."""
    given = parse(__doc__, words, count=60, model="locomotion", walks=2)
    circles = load_circles(given, shortest=2.0, longest=30.0, canonical=True, model=given.model)
    prior = priors.load(given.model)

    def follow(curve: Curve, seconds: float, speed: float, generator: torch.Generator) -> Motion:
        return controllers.follow(prior, curve, seconds=seconds, speed=speed, generator=generator).motion

    own = measure_walks(follow, given.walks, given.seed)
    rows: list[Row] = [{"clips of": "", "method": f"mapctl follow, {given.model}", **own}]
    for circle in circles:
        rows.append({"clips of": circle.name, **measure_mocap(circle)})
        try:
            database = MotionDatabase.of([encode(clip.motion)[0].float() for clip in circle.clips])
        except MapctlError:  # no clip is long enough to be searched
            continue

        def match(curve: Curve, seconds: float, speed: float, generator: torch.Generator, played=database) -> Motion:
            return follow_by_matching(played, curve, seconds=seconds, speed=speed, generator=generator)

        for name, walker in (
            ("motion matching", match),
            ("motion matching, feet planted", lambda *asked, match=match: plant_feet(match(*asked))),
        ):
            found = measure_walks(walker, given.walks, given.seed)
            rows.append({"clips of": circle.name, "method": name, **found})
    print_table(rows, circles)


if __name__ == "__main__":
    main()
