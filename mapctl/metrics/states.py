"""Statistics of the prior's own features that a long free run is compared with: speed, height and pose variation."""

from jaxtyping import Float
from torch import Tensor

from mapctl.features import LAYOUT, ground_speed


def summarise_states(features: Float[Tensor, "frames size"]) -> dict[str, float]:
    """Summarise mean speed (m/s), mean root height (m) and mean standard deviation of the joint rotations (rad)."""
    return {
        "speed": float(ground_speed(features).mean()),
        "height": float(LAYOUT.pick(features, "root_height").mean()),
        "pose": float(LAYOUT.pick(features, "joint_rotations").std(0).mean()),
    }
