"""What a viewer sees of motions, without the truth beside them."""

from collections.abc import Sequence

import torch

from controllers.benchmarks.shared.tables import Row
from mapctl.features import PRIOR_FPS
from mapctl.metrics import body, feet, worst_frame
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, TOES

_TOES = CANONICAL.indices(TOES)
_EFFECTORS = CANONICAL.indices(("leftHand", "rightHand", *TOES))


def measure_appearance(motions: Sequence[Motion]) -> Row:
    """Measure what a viewer sees: means over motions on canonical bones at PRIOR_FPS, and the worst frame of all.

    Planted toes' speed, cm/s; jitter, m/s^3; the largest step, cm, and acceleration, m/s^2, of a hand or a foot, seen
    from the hips.
    """
    planted, jitter, steps, accelerations = [], [], [], []
    for motion in motions:
        positions = motion.joint_positions()
        toes = feet.ToeMeasurements.of(positions[:, _TOES], PRIOR_FPS)
        planted.append(toes.speed[toes.planted[1:]])
        jitter.append(body.jitter(positions, PRIOR_FPS))
        peaks = worst_frame.measure_peaks(positions[:, _EFFECTORS], motion.root_position, PRIOR_FPS)
        steps.append(peaks.step)
        accelerations.append(peaks.acceleration)
    return {
        "planted_cm_s": 100 * float(torch.cat(planted).mean()),
        "jitter_m_s3": sum(jitter) / len(jitter),
        "step_cm": 100 * max(steps),
        "acceleration_m_s2": max(accelerations),
    }
