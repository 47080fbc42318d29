"""What a viewer would mind of a filled gap, by which ways to fill it are compared."""

from dataclasses import replace

import torch
from helpers import walk

from controllers.shots.seams import compute_artefact_cost


def test_a_slide_costs_what_a_viewer_sees_and_a_walk_does_not():
    motion, up = walk(90), torch.zeros(90, 2, dtype=torch.bool)
    first = torch.zeros(90, dtype=torch.long)
    sliding = replace(motion, local_quat_xyzw=motion.local_quat_xyzw[first])
    walks, slides = (compute_artefact_cost(each, up, (1, 89)) for each in (motion, sliding))
    assert slides > walks + 0.3
    round_about = motion.root_position.clone()
    round_about[:, 0] += torch.sin(torch.arange(90) / 89 * torch.pi) * 1.5
    assert compute_artefact_cost(replace(motion, root_position=round_about), up, (1, 89)) > walks
