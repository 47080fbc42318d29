"""Candidate motions as terms see them: built once per evaluation, world poses computed at most once."""

from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.contacts import derive_heel_contacts
from mapctl.errors import MapctlError
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, integrate_root
from mapctl.kinematics import fast
from mapctl.pose import BodyPose
from mapctl.skeleton import CANONICAL, TOES, Skeleton, find_heel_drops


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
    """Unknowns with a standard normal prior: latents of a rollout, noise on the network's input, or whitened pose
    offsets; None for a motion that has none."""
    log_density: Float[Tensor, "batch frames"] | None = None
    """Nats of each frame given those before it, under the prior; None where no density scored the motion."""
    before: Float[Tensor, "past joints 3"] = field(default_factory=lambda: torch.zeros(0, CANONICAL.num_joints, 3))
    """World joint positions of the last frames before the window, metres, oldest first; the same for all."""
    contacts_before: Bool[Tensor, "*batch 2"] = field(default_factory=lambda: torch.zeros(2, dtype=torch.bool))
    """Left and right toe planted in the frame before the window; unbatched or with the batch's shape."""
    heels_before: Float[Tensor, "known 2 3"] = field(default_factory=lambda: torch.zeros(0, 2, 3))
    """World positions of the left and the right heel in the frame before the window, metres; none without a past."""
    heel_contacts: Bool[Tensor, "batch steps 2"] | None = None
    """Left and right heel planted in the frame before the window and in each of its frames; None: by `heel_plan`."""
    heel_plan: "Trial | None" = None
    """Trial of one candidate, or of as many, whose poses determine which heels are planted, so that they do not change
    during a solve; None: these very poses do."""
    skeleton: Skeleton = CANONICAL
    """Bones of the character."""
    fps: float = float(PRIOR_FPS)
    """Frames per second."""
    first_frame: int = 0
    """Frame of the whole motion that the window begins at, counted from 0."""
    world_poses: fast.WorldPoses | None = None
    """Roots and joints of the features in the world, where they are known already; they carry no gradient."""

    @staticmethod
    def of_features(features: Float[Tensor, "batch frames size"], *, skeleton: Skeleton = CANONICAL) -> "Trial":
        """Make the trial of a motion from the origin on, with the contacts of its features and without noise or
        density."""
        origin = GroundPose(features.new_zeros(len(features), 2), features.new_zeros(len(features)))
        before = features.new_zeros(0, skeleton.num_joints, 3)
        bits = LAYOUT.pick(features, "contacts") > 0.5
        return Trial(features, origin, contacts=bits, before=before, skeleton=skeleton)

    @property
    def seconds(self) -> Float[Tensor, " frames"]:
        """Time of each frame since the first frame of the whole motion, seconds."""
        return (self.first_frame + torch.arange(self.features.shape[1])) / self.fps

    def require_noise(self) -> Float[Tensor, "batch frames width"]:
        """Return the noise; MapctlError where there is none."""
        if self.noise is None:
            raise MapctlError("this motion has no noise with a prior")
        return self.noise

    def require_log_density(self) -> Float[Tensor, "batch frames"]:
        """Return the log density; MapctlError where no density scored the motion."""
        if self.log_density is None:
            raise MapctlError("no density scored this motion")
        return self.log_density

    @cached_property
    def _use_kernels(self) -> bool:
        return fast.is_supported(self.features, self.start, self.skeleton)

    @cached_property
    def _root(self) -> tuple[Tensor, Tensor]:
        if self.world_poses is not None:
            return self.world_poses.root_xz_world, self.world_poses.heading
        return self._compiled[:2] if self._use_kernels else integrate_root(self.features, self.start)

    @cached_property
    def _compiled(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Roots, headings, joints and heels by the compiled kinematics."""
        return fast.compute_world_poses(self.features, self.start, self.skeleton)

    @property
    def root_xz_world(self) -> Float[Tensor, "batch frames 2"]:
        """Ground projection of the hips, metres."""
        return self._root[0]

    @property
    def heading(self) -> Float[Tensor, "batch frames"]:
        """Heading of the hips, radians about +Y, not wrapped."""
        return self._root[1]

    @property
    def pose(self) -> BodyPose:
        """The poses of the body in the world."""
        return BodyPose.of_features_at(self.features, self.root_xz_world, self.heading)

    @property
    def joints_world(self) -> Float[Tensor, "batch frames joints 3"]:
        """World joint positions, metres, by forward kinematics of the whole body."""
        return self._points[0]

    @property
    def heels_world(self) -> Float[Tensor, "batch frames 2 3"]:
        """World positions of the left and the right heel (see `skeleton.find_heels`), metres."""
        return self._points[1]

    @cached_property
    def _points(self) -> tuple[Tensor, Tensor]:
        if self.world_poses is not None:
            return self.world_poses.joints_world, self.world_poses.heels_world
        if self._use_kernels:
            return self._compiled[2:]
        return self.pose.joints_and_heels(self.skeleton)

    def joint_world(self, name: str) -> Float[Tensor, "batch frames 3"]:
        """Return the world positions of one joint, metres."""
        return self.joints_world[..., self.skeleton.index(name), :]

    @cached_property
    def planted(self) -> Bool[Tensor, "batch steps 2"]:
        """Left and right toe planted in the frame before the window and in each of its frames."""
        past = self.contacts_before.to(self.contacts.device).expand(len(self.contacts), 2).unsqueeze(1)
        return torch.cat([past, self.contacts], dim=1)

    @cached_property
    def heels_planted(self) -> Bool[Tensor, "batch steps 2"]:
        """Left and right heel planted in the frame before the window and in each of its frames; no gradient."""
        if self.heel_contacts is not None:
            return self.heel_contacts
        if self.heel_plan is not None:
            return self.heel_plan.heels_planted.expand(len(self.features), -1, -1).contiguous()
        return self._derive_heel_contacts()

    def _derive_heel_contacts(self) -> Bool[Tensor, "batch steps 2"]:
        toes, heels = self.joints_world.detach()[..., self.skeleton.indices(TOES), :], self.heels_world.detach()
        known = len(self.before) > 0 and len(self.heels_before) > 0
        if known:
            past = torch.stack([self.last_before[0, self.skeleton.indices(TOES)], self.heels_before[-1].to(heels)])
            toes, heels = (
                torch.cat([was.expand(len(now), 1, 2, 3), now], dim=1)
                for was, now in zip(past, (toes, heels), strict=True)
            )
        drops = heels.new_tensor(find_heel_drops(self.skeleton))
        planted = derive_heel_contacts(self.planted[:, 0 if known else 1 :], toes, heels, drops, self.fps)
        return planted if known else torch.cat([torch.zeros_like(planted[:, :1]), planted], dim=1)

    @cached_property
    def last_before(self) -> Float[Tensor, "past joints 3"]:
        """World joint positions of the frame before the window, metres, as precise as features; none without a past."""
        return self.before[-1:].to(self.features.dtype)

    def step(self, joint: int) -> Float[Tensor, "batch frames 3"]:
        """Return the displacement of a joint since the frame before, metres; the first frame's needs a past, or is
        0."""
        positions = self.joints_world[..., joint, :]
        past = self.before[-1:, joint].to(positions.dtype) if len(self.before) else positions[:, :1].detach()
        return torch.diff(positions, dim=-2, prepend=past.expand(len(positions), 1, 3))

    @property
    def toes(self) -> tuple[int, int]:
        """Indices of the left and the right toe joint."""
        left, right = self.skeleton.indices(TOES)
        return left, right

    @cached_property
    def toe_speeds(self) -> Float[Tensor, "batch frames 2"]:
        """Speed of the left and the right toe over the ground since the frame before, m/s; its gradient exists at 0."""
        return self._speed(torch.stack([self.step(toe) for toe in self.skeleton.indices(TOES)], dim=-2))

    @cached_property
    def toe_accelerations(self) -> Float[Tensor, "batch frames 2"]:
        """Size of the acceleration of the left and the right toe from the two frames before, m/s^2; 0 in the first
        frames where those are not known."""
        toes = self.joints_world[:, :, list(self.toes)]
        past = self.before[-2:, list(self.toes)].to(toes.dtype).expand(len(toes), -1, -1, -1)
        second = torch.diff(torch.cat([past, toes], dim=1), n=2, dim=1)
        sizes = torch.sqrt(second.square().sum(-1) + 1e-9) * self.fps**2
        return torch.cat([sizes.new_zeros(len(toes), toes.shape[1] - sizes.shape[1], 2), sizes], dim=1)

    @cached_property
    def heel_speeds(self) -> Float[Tensor, "batch frames 2"]:
        """Speed of the left and the right heel over the ground since the frame before, m/s, likewise."""
        heels = self.heels_world
        past = self.heels_before[-1:].to(heels.dtype) if len(self.heels_before) else heels[:, :1].detach()
        return self._speed(torch.diff(heels, dim=-3, prepend=past.expand(len(heels), 1, 2, 3)))

    def _speed(self, steps: Float[Tensor, "batch frames 2 3"]) -> Float[Tensor, "batch frames 2"]:
        return torch.sqrt(steps[..., ::2].square().sum(-1) + 1e-12) * self.fps

    @property
    def toe_heights(self) -> Float[Tensor, "batch frames 2"]:
        """Height of the left and the right toe joint in the world, metres."""
        return self.joints_world[..., self.skeleton.indices(TOES), 1]
