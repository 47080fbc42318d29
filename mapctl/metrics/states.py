"""What a long free run is held against: speed, height and pose variation of the prior's own features."""

from jaxtyping import Float
from torch import Tensor

from mapctl.features import LAYOUT, ground_speed


def summarise_states(features: Float[Tensor, "frames size"]) -> dict[str, float]:
    """Mean speed (m/s), mean root height (m) and mean spread of the joint rotations (rad)."""
    return {
        "speed": float(ground_speed(features).mean()),
        "height": float(LAYOUT.pick(features, "root_height").mean()),
        "pose": float(LAYOUT.pick(features, "joint_rotations").std(0).mean()),
    }
