"""The recurrent transition network: what it is given, what it goes by, and where it arrives."""

from dataclasses import replace

import pytest
import torch
from helpers import generator, walk
from tiny_infiller import CONFIG, network, save_tiny_infiller, shown, tiny_infiller

import priors
from controllers.common.canonical_clip import CanonicalClip
from mapctl.inbetweening.missing import MissingMask
from mapctl.inbetweening.position_image import PositionImage
from mapctl.skeleton import CANONICAL
from priors.infiller.network import ConvInfiller

RECURRENT = replace(CONFIG, architecture="recurrent")
FRAMES, START, STOP = 90, 30, 50


def net(drawn=0.5):
    return network(drawn=drawn, config=RECURRENT)


def recurrent():
    return tiny_infiller(drawn=0.5, config=RECURRENT)


def holed(motion=None, gaps=((START, STOP),), frames=FRAMES):
    """The image, in single precision, of a walk with gaps."""
    known = torch.ones(1, frames, CANONICAL.num_joints, dtype=torch.bool)
    for start, stop in gaps:
        known[:, start:stop] = False
    image = shown(walk(frames, turn_rate=0.4) if motion is None else motion, known)
    return replace(
        image, **{name: getattr(image, name).float() for name in ("places", "contacts", "ground", "heading")}
    )


def shaken(image: PositionImage, frames: slice) -> PositionImage:
    """The image with other poses in some known frames."""
    places = image.places.clone()
    places[:, frames, 1:] += 0.1 * torch.randn(places[:, frames, 1:].shape, generator=generator(3))
    return replace(image, places=places)


def made(image: PositionImage) -> torch.Tensor:
    return net()(image).places[:, START:STOP]


def test_it_is_given_20_frames_before_the_gap_and_two_behind_it_and_nothing_else():
    image = holed()
    usual = made(image)
    for frames in (slice(0, START - 20), slice(STOP + 2, FRAMES)):
        assert torch.equal(made(shaken(image, frames)), usual), frames
    for frame in (START - 20, START - 1, STOP, STOP + 1):
        assert not torch.equal(made(shaken(image, slice(frame, frame + 1))), usual), frame


def test_untrained_the_hips_go_on_at_their_pace():
    image = holed(walk(FRAMES))
    step = image.to_world(net(0.0)(image).places)[0, :, 0].diff(dim=0)
    assert torch.allclose(step[START - 1 : STOP - 1], step[START - 2].expand(STOP - START, 3), atol=1e-4)


def test_it_knows_how_long_is_left():
    """Of who stands still nothing else tells two gaps apart."""
    pose = walk(1)
    still = replace(
        pose,
        root_position=pose.root_position.expand(FRAMES, -1),
        local_quat_xyzw=pose.local_quat_xyzw.expand(FRAMES, -1, -1),
    )
    longer = holed(still, gaps=((START, STOP + 4),))
    assert not torch.equal(made(longer), made(holed(still)))


def test_wild_weights_do_not_lead_beyond_what_a_body_can_do():
    wild = network(drawn=30.0, config=RECURRENT)
    image = holed(walk(400), gaps=((START, 390),), frames=400)
    places = image.to_world(wild(image).places)[0, START:390]
    assert bool(places.isfinite().all())
    assert float(places[:, 0].diff(dim=0).abs().max()) < 0.36
    assert float((places - places[:, :1]).abs().max()) < 2.2
    assert float(places[:, 0].diff(dim=0).abs().max()) > 0.3  # or the bounds were not reached


def test_gaps_are_filled_from_left_to_right_each_by_what_was_made_before():
    image = holed(gaps=((20, 30), (31, 45)))
    other = shaken(image, slice(10, 11))
    assert torch.equal(image.places[:, 30], other.places[:, 30])
    one, two = (net()(each).places for each in (image, other))
    assert not torch.equal(one[:, 31:45], two[:, 31:45])


def test_a_single_pose_is_past_enough_and_open_ends_stay_as_they_were_shown():
    image = holed(gaps=((1, 40), (60, FRAMES)))
    proposed = net()(image)
    assert (proposed.places - image.places)[:, 1:40].abs().max() > 1e-2
    assert torch.equal(proposed.places[:, 60:], image.places[:, 60:])
    begun = holed(gaps=((0, 20),))
    assert torch.equal(net()(begun).places, begun.places)


def test_lost_joints_stay_as_they_were_shown_and_do_not_end_a_gap():
    known = torch.ones(1, FRAMES, CANONICAL.num_joints, dtype=torch.bool)
    known[..., 8] = False
    known[:, START:STOP] = False
    image = replace(holed(), known_axes=known[..., None].expand(*known.shape, 3))
    proposed = net()(image)
    assert torch.equal(proposed.places[image.known], image.places[image.known])
    assert (proposed.places - image.places)[:, START:STOP, 0].abs().max() > 1e-2


def test_where_it_arrives_is_not_where_it_should_but_the_gap_is_the_same():
    clip = walk(60)
    free = torch.zeros(60, dtype=torch.bool)
    free[25:40] = True
    query = CanonicalClip.of(clip, MissingMask.of_frames(free, clip.num_joints)).query()
    raw, true = recurrent().propose_raw(query), clip.joint_positions()
    off = (raw - true).norm(dim=-1).amax(dim=1)
    assert float(off[:25].max()) < 1e-4
    assert float(off[40:42].min()) > 0.01
    assert float(off[42:].max()) < 1e-4
    with pytest.raises(ValueError, match="no recurrent one"):
        tiny_infiller().propose_raw(query)


def test_it_is_not_averaged_with_its_mirror_image():
    image = holed()
    assert torch.equal(recurrent().complete(image).places, net()(image).places)


def test_it_loads_as_an_in_betweener_of_its_architecture(tmp_path):
    path = save_tiny_infiller(tmp_path / "run" / "model.safetensors", drawn=0.5, config=RECURRENT)
    found = priors.load_inbetweener(str(path.parent))
    assert isinstance(found, ConvInfiller)
    assert found.network.recurrent
    assert torch.allclose(found.complete(holed()).places, recurrent().complete(holed()).places, atol=2e-2)
