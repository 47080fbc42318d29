"""Joints of features whose root is known already: by compiled kernels on the processor, by torch on other devices."""

from jaxtyping import Float
from torch import Tensor

from mapctl.kinematics import fast
from mapctl.pose import BodyPose
from mapctl.skeleton import Skeleton


def place_joints(
    features: Float[Tensor, "batch frames size"],
    root_xz_world: Float[Tensor, "batch frames 2"],
    heading: Float[Tensor, "batch frames"],
    skeleton: Skeleton,
) -> Float[Tensor, "batch frames joints 3"]:
    """Place the joints of features in the world, metres, over these points of the ground, facing these headings.

    Features are of single precision; all tensors lie on one device.
    """
    if features.device.type == "cpu":
        return fast.compute_joints_and_heels(features, root_xz_world, heading, skeleton)[0]
    return BodyPose.of_features_at(features, root_xz_world, heading).joints_world(skeleton)
