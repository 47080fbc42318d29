"""The jobs that bring motion of one rig to another all stand it on the other's floor."""

import torch
from helpers import bandai_skeleton, generator
from methods import UNFINISHED
from performers import TOES, Performer
from rig_maker import Make, make, names_of

from controllers.inbetweening.infill import ChainSettings, chain
from controllers.inbetweening.proposers import SlerpInbetweener
from mapctl import retarget
from mapctl.motion import Motion
from mapctl.skeleton import TOE_REST_HEIGHT

OTHER = Performer(size=1.2, toe_height=-0.06)


def own_walk() -> Motion:
    """On the Bandai Namco rig."""
    return retarget.from_canonical(Performer().walks(), retarget.identify_rig(bandai_skeleton()))


def others_walk() -> Motion:
    """On another rig, of somebody tall whose toes are below the floor."""
    return make(Make(names_of("mixamo"), size=1.2, extras=False)).motion(OTHER.walks())


def test_pieces_of_a_chain_stand_on_the_first_ones_floor():
    settings = ChainSettings(piece=40, gap=(10, 10))
    done = chain(
        [own_walk(), others_walk()], SlerpInbetweener(), settings=settings, filling=UNFINISHED, generator=generator()
    )
    toes = retarget.to_canonical(done.motion)[0].joint_positions()[:, TOES, 1]
    for piece in (slice(0, 40), slice(50, 90)):
        torch.testing.assert_close(toes[piece].amin(0), torch.full((2,), TOE_REST_HEIGHT).double(), atol=0.01, rtol=0)
