"""What a REPL and a notebook show of what users hold: a line or a few, with units, and never tensors."""

import inspect
import pydoc
from dataclasses import replace
from fractions import Fraction

import pytest
import torch
from helpers import tiny_density
from tiny_tweener import tiny_tweener

import controllers
from controllers.denoising.result import DenoiseSolution
from controllers.inbetweening.solution import InbetweenSolution
from controllers.shots.shot import ShotSolution
from controllers.steering.steer import SteerFrames
from mapctl import curves
from mapctl.motion import Motion
from mapctl.problem.ledger import Ledger, LedgerEntry
from mapctl.problem.solution import Outcome, Solution, Status
from mapctl.skeleton import CANONICAL, Skeleton


def going(metres_a_second: float, frames: int = 150) -> Motion:
    """Who glides along +Z without a step."""
    still = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64).expand(frames, CANONICAL.num_joints, 4)
    root = torch.zeros(frames, 3, dtype=torch.float64)
    root[:, 2] = metres_a_second * torch.arange(frames) / 30
    return Motion(CANONICAL, Fraction(30), root, still)


def test_a_motion_prints_its_length_joints_and_way():
    motion = going(1.2)
    assert str(motion) == "Motion: 150 frames at 30 fps (5.0 s), 21 joints, travels 6.0 m"
    assert repr(motion) == f"<{motion}>"


def test_the_way_is_that_of_hips_below_a_root_that_stays():
    motion = going(1.2)
    below = replace(
        motion,
        skeleton=Skeleton(("ground", "hips"), (-1, 0), torch.zeros(2, 3, dtype=torch.float64)),
        root_position=torch.zeros_like(motion.root_position),
        local_quat_xyzw=motion.local_quat_xyzw[:, :2],
        moving_offsets={1: motion.root_position},
    )
    assert str(below).endswith("2 joints, travels 6.0 m")


def test_one_frame_and_broken_rates_print_too():
    still = replace(going(1.0, frames=1), fps=Fraction(24000, 1001))
    assert str(still) == "Motion: 1 frame at 23.976 fps (0.042 s), 21 joints, travels 0.0 m"


def test_jitter_hardly_counts_as_travel():
    motion = going(0.0)
    shaking = replace(
        motion, root_position=0.02 * torch.sin(3.0 * torch.arange(150.0).double())[:, None].expand(150, 3)
    )
    assert float(shaking.root_position.diff(dim=0).norm(dim=-1).sum()) > 5.0
    assert float(str(shaking).split()[-2]) < 0.5


def test_a_skeleton_prints_its_joints_and_its_size():
    assert str(CANONICAL) == "Skeleton: 21 canonical joints, root hips, 1.55 m across at rest"
    assert repr(CANONICAL) == f"<{CANONICAL}>"
    other = Skeleton(("a", "b"), (-1, 0), torch.tensor([[0.0, 0, 0], [0, 160, 0]]), {"b": (0.0, 20.0, 0.0)})
    assert str(other) == "Skeleton: 2 joints, root a, 180.00 m across at rest", "in centimetres by mistake, one sees it"


def test_a_curve_prints_its_length_and_where_it_is():
    assert str(curves.circle(radius=2)) == "Curve: closed, on the ground, 12.57 m from (0.00, 0.00)"
    space = curves.from_points(torch.tensor([[0.0, 1.0, 0.0], [0.0, 1.0, 3.0]]))
    assert repr(space) == "<Curve: open, in space, 3.00 m from (0.00, 1.00, 0.00)>"


def ledger() -> Ledger:
    """Of two terms and two frames."""
    zero = torch.zeros(2)
    return Ledger(
        (LedgerEntry("path", "m", zero, torch.tensor([0.01, 0.03])), LedgerEntry("noise", "rms", zero, zero + 0.5))
    )


def test_a_ledger_prints_what_is_missed_in_its_unit():
    assert str(ledger()) == "Ledger: path 0.02 m, noise 0.5 rms"
    assert repr(Ledger()) == "<Ledger: no terms>"


def test_a_solution_prints_how_it_ended_what_it_cost_and_every_note():
    solution = Solution(going(1.2), Status(Outcome.INFEASIBLE, ("the corner is sharp",)), ledger(), seconds=2.34)
    assert str(solution).splitlines() == [
        "Solution: the wishes cannot all hold",
        "150 frames at 30 fps (5.0 s), 21 joints, travels 6.0 m; took 2.3 s",
        "mean residuals: path 0.02 m, noise 0.5 rms",
        "the corner is sharp",
    ]
    assert repr(solution) == (
        "<Solution: the wishes cannot all hold; 150 frames at 30 fps (5.0 s), 21 joints, travels 6.0 m>"
    )


@pytest.mark.parametrize("kind", [DenoiseSolution, InbetweenSolution, ShotSolution, SteerFrames])
def test_every_job_prints_its_solution_so(kind):
    assert "__repr__" not in vars(kind)
    assert "__str__" not in vars(kind)
    assert issubclass(kind, Solution)


def test_models_print_one_line():
    assert repr(tiny_density()) == f"<{tiny_density()}>"
    assert str(tiny_density()).startswith("LstmGmmDensity: ")
    assert "\n" not in str(tiny_tweener())
    assert len(str(tiny_tweener().card)) < 80


@pytest.mark.parametrize("job", [controllers.follow, controllers.generate, controllers.steer.begin])
def test_help_shows_no_tensors(job):
    text = pydoc.plain(pydoc.render_doc(job))
    assert "tensor(" not in text
    assert "Skeleton = <Skeleton: 21 canonical joints" in text
    assert len(str(inspect.signature(job))) < 1000
