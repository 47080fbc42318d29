"""Sequences of keys of held-out clips, laid out as in training (Zhou et al. 2020, appendix C)."""

import re
from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction

import torch

from controllers.benchmarks.shared.bones import scale_to_canonical_bones
from controllers.benchmarks.tweener.spliced_keys import KeySequence
from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS, encode
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL
from priors.training.augmentation.key_layouts import KeySequences, KeySettings, draw_splices
from priors.training.augmentation.key_parts import PartSettings
from priors.training.augmentation.pose_windows import PoseWindows
from priors.training.corpus import Corpus

_WHOLE = PartSettings(halves=0.0, places=0.0, drawings=0.0)
SINGLE_KEYS = KeySettings(runs=0.0, parts=_WHOLE)
"""Gaps of 0.3 to 16 s between single poses, in a sequence no shorter than 0.3 of the longest."""
LONG_GAPS = KeySettings(runs=0.0, shortest=300.0, parts=_WHOLE)
"""Gaps of 3 to 16 s between single poses."""
EVEN_GAPS = KeySettings(runs=0.0, shortest=120.0, longest=120.0, parts=_WHOLE)
"""Keys every 1.2 to 4 s, or 3 s later where a clip ends: about 23 in 2,048 frames."""
_LEAST_FRAMES = 32  # of a clip; shorter ones have no second to compare
_BATCH = 8  # sequences drawn at once


class HeldOutClips:
    """Clips that keys are drawn from, kinds alike."""

    def __init__(self, kinds: Mapping[str, Sequence[Motion]]):
        """RequestError where no clip is as long as a second."""
        scaled = [(kind, scale_to_canonical_bones(clip)) for kind, clips in kinds.items() for clip in clips]
        scaled = [(kind, clip) for kind, clip in scaled if clip.num_frames >= _LEAST_FRAMES]
        if not scaled:
            raise RequestError("no clip that was kept from training lasts a second")
        self.clips = [clip for _, clip in scaled]
        features = [encode(clip)[0].float() for clip in self.clips]
        names = tuple(f"{kind}/{number}" for number, (kind, _) in enumerate(scaled))
        corpus = Corpus(names, tuple(len(each) for each in features), torch.cat(features))
        patterns = [f"^{re.escape(kind)}/" for kind in kinds]
        self.windows = PoseWindows(corpus, kinds=patterns, evenness=1.0)

    def draw(self, count: int, frames: int, settings: KeySettings, *, seed: int) -> Iterator[KeySequence]:
        """Draw so many sequences of so many frames, one after the other."""
        generator = torch.Generator().manual_seed(seed)
        for first in range(0, count, _BATCH):
            batch = min(_BATCH, count - first)
            drawn = draw_splices(self.windows, batch, frames, settings, progress=1.0, generator=generator)
            yield from (_take(drawn, row) for row in range(batch))


def _take(drawn: KeySequences, row: int) -> KeySequence:
    """Take one of a batch."""
    motion = drawn.motion
    hips = rotations.multiply(rotations.about_y(motion.heading[row]), motion.quats[row, :, 0])
    quats = torch.cat([hips[:, None], motion.quats[row, :, 1:]], dim=1).double()
    quats = rotations.make_sign_continuous(torch.nn.functional.normalize(quats, dim=-1))
    made = Motion(CANONICAL, Fraction(PRIOR_FPS), motion.root_position[row].double(), quats)
    return KeySequence(made, drawn.known[row], drawn.truthful[row], drawn.clip[row])
