"""A file of motion as training features, or why it cannot be used."""

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import retarget
from mapctl.errors import MapctlError
from mapctl.features import PRIOR_FPS, encode
from mapctl.formats import load
from priors.training.mocap.cuts import Cut, FrameCuts
from priors.training.mocap.leveling import stand_on_canonical


@dataclass(frozen=True)
class ClipReader:
    """Reads the clips of a folder."""

    data: Path
    """The folder."""
    skip_first: bool
    """Drop frame 0 of every clip."""
    cuts: FrameCuts
    """Which frames are motion."""
    level: bool = False
    """Put every clip on the canonical body and a level floor."""

    def name(self, file: Path) -> str:
        """The name of the clip: the file's path below the folder."""
        return file.relative_to(self.data).as_posix()

    def read(self, file: Path) -> Float[Tensor, "frames size"] | str:
        """The clip, or why there is none. What no reader foresaw is a reason too: one file must not end a run."""
        try:
            cut = self.cuts.find(self.name(file))
            return read_clip_features(file, skip_first=self.skip_first, cut=cut, level=self.level)
        except (MapctlError, OSError) as error:
            # The list has the name already.
            return " ".join(str(error).split()).removeprefix(str(file)).lstrip(":, ")
        except Exception as error:
            return f"{type(error).__name__}: {' '.join(str(error).split())}"


def read_clip_features(
    file: Path, *, skip_first: bool = False, cut: Cut | None = None, level: bool = False
) -> Float[Tensor, "frames size"]:
    """One file as features at 30 fps on the canonical joints; MapctlError, naming it, where that cannot be.

    The rig is told from all of the file: a T-pose that is cut off may be what shows it. Bones and floor are the
    performer's, or with `level` the canonical ones.
    """
    motion = load(file)
    try:
        rig = None if cut is None else retarget.as_rig(retarget.identify_rig(motion.skeleton, motion=motion))
        if cut is not None:
            motion = replace(cut, first=max(cut.first, int(skip_first))).apply(motion)
        elif skip_first and motion.num_frames > 2:
            motion = motion.slice(1, motion.num_frames)
        canonical, rigmap = retarget.to_canonical(motion, rig)
        canonical = canonical.resample(PRIOR_FPS)
        features = encode(stand_on_canonical(canonical, rigmap) if level else canonical)[0].float()
        if not bool(torch.isfinite(features).all()):
            raise MapctlError("its motion is not finite")
        return features
    except MapctlError as error:
        raise MapctlError(f"{file}: {error}") from error
