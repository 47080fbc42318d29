"""One candidate motion as the terms see it: built once per evaluation, world poses computed at most once."""

from dataclasses import KW_ONLY, dataclass, field, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.errors import MapctlError
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, integrate_root
from mapctl.kinematics import fast
from mapctl.pose import BodyPose
from mapctl.skeleton import CANONICAL, Skeleton


@dataclass(frozen=True, eq=False)
class Trial:
    """A batch of candidate windows, canonical joints, float32 or float64."""

    features: Float[Tensor, "batch frames size"]
    """Features of the frames, physical units."""
    start: GroundPose
    """Ground pose of the frame before the window; unbatched or with the batch's shape."""
    _: KW_ONLY
    contacts: Bool[Tensor, "batch frames 2"]
    """Left and right toe planted, by the prior's own bits; fixed during a solve."""
    noise: Float[Tensor, "batch frames width"] | None = None
    """The unknowns that have a standard normal prior: latents of a rollout, noise on the network's input, or whitened
    pose offsets; None for a motion that was made in no such way."""
    log_density: Float[Tensor, "batch frames"] | None = None
    """Nats of each frame given those before it, under the prior; None where no density scored the motion."""
    before: Float[Tensor, "past joints 3"] = field(default_factory=lambda: torch.zeros(0, CANONICAL.num_joints, 3))
    """World joint positions of the last frames before the window, metres, oldest first; the same for all."""
    contacts_before: Bool[Tensor, "*batch 2"] = field(default_factory=lambda: torch.zeros(2, dtype=torch.bool))
    """Left and right toe planted in the frame before the window; unbatched or with the batch's shape."""
    skeleton: Skeleton = CANONICAL
    """Bones of the character."""
    fps: float = float(PRIOR_FPS)
    """Frames per second."""
    first_frame: int = 0
    """Frame of the whole motion that the window begins at, counted from 0."""

    @staticmethod
    def of_features(features: Float[Tensor, "batch frames size"], *, skeleton: Skeleton = CANONICAL) -> "Trial":
        """A motion that no prior made, from the origin on, with the contacts that its features tell."""
        origin = GroundPose(features.new_zeros(len(features), 2), features.new_zeros(len(features)))
        before = features.new_zeros(0, skeleton.num_joints, 3)
        bits = LAYOUT.pick(features, "contacts") > 0.5
        return Trial(features, origin, contacts=bits, before=before, skeleton=skeleton)

    @property
    def seconds(self) -> Float[Tensor, " frames"]:
        """Time of each frame since the first frame of the whole motion, seconds."""
        return (self.first_frame + torch.arange(self.features.shape[1])) / self.fps

    def require_noise(self) -> Float[Tensor, "batch frames width"]:
        """The noise; MapctlError where there is none."""
        if self.noise is None:
            raise MapctlError("this motion was made without noise that has a prior")
        return self.noise

    def require_log_density(self) -> Float[Tensor, "batch frames"]:
        """The log density; MapctlError where no density scored the motion."""
        if self.log_density is None:
            raise MapctlError("no density scored this motion")
        return self.log_density

    @cached_property
    def _use_kernels(self) -> bool:
        return fast.is_supported(self.features, self.start, self.skeleton)

    @cached_property
    def _root(self) -> tuple[Tensor, Tensor]:
        places = fast.integrate_root_fast if self._use_kernels else integrate_root
        return places(self.features, self.start)

    @property
    def root_xz_world(self) -> Float[Tensor, "batch frames 2"]:
        """Ground projection of the hips, metres."""
        return self._root[0]

    @property
    def heading(self) -> Float[Tensor, "batch frames"]:
        """Facing angle about +Y, radians, not wrapped."""
        return self._root[1]

    @property
    def pose(self) -> BodyPose:
        """The poses of the body in the world."""
        height = LAYOUT.pick(self.features, "root_height")
        root = torch.cat([self.root_xz_world[..., :1], height, self.root_xz_world[..., 1:]], dim=-1)
        in_place = BodyPose.of_features_in_place(self.features)
        return replace(in_place, root_position=root, heading=self.heading)

    @cached_property
    def joints_world(self) -> Float[Tensor, "batch frames joints 3"]:
        """World joint positions, metres, by forward kinematics of the whole body."""
        if self._use_kernels:
            return fast.compute_joints_world(self.features, self.root_xz_world, self.heading, self.skeleton)
        return self.pose.joints_world(self.skeleton)

    def joint_world(self, name: str) -> Float[Tensor, "batch frames 3"]:
        """World positions of one joint, metres."""
        return self.joints_world[..., self.skeleton.index(name), :]

    def step(self, joint: int) -> Float[Tensor, "batch frames 3"]:
        """Displacement of a joint since the frame before, metres; the first frame's needs a past, or is 0."""
        places = self.joints_world[..., joint, :]
        past = self.before[-1:, joint].to(places.dtype) if len(self.before) else places[:, :1].detach()
        return torch.diff(places, dim=-2, prepend=past.expand(len(places), 1, 3))
