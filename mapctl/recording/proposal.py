"""What a denoiser proposes for a capture."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from mapctl.pose import BodyPose


@dataclass(frozen=True, eq=False)
class CaptureProposal:
    """The motion behind a batch of captures, as a denoiser sees it, and its contacts."""

    pose: BodyPose
    """Poses of every frame, batched."""
    contact_logits: Float[Tensor, "batch frames 2"]
    """Log odds that the left and the right toe are planted."""
    log_spread: Float[Tensor, "batch frames columns"]
    """Logarithm of the standard deviation of the proposal's error: of each coordinate of the hips' position, metres,
    then of each of a joint's three angles, radians, the hips' first."""
