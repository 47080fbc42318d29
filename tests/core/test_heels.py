"""Heels: where they are on any skeleton, and when they are planted."""

from dataclasses import replace

import pytest
import torch

from mapctl import rotations
from mapctl.contacts import HeelContactSettings, derive_heel_contacts, detect_contacts
from mapctl.skeleton import CANONICAL, TOES, Skeleton, find_heel_drops, find_heels

FPS = 30.0
DROPS = torch.tensor([0.02, 0.02]).double()


def roll():
    """A foot (both sides alike) that swings in, strikes with the heel, lies flat and rolls off over the toe: positions
    of toe and heel in two seconds, by the pitch of the sole and the place of what it stands on."""
    frames = round(2 * FPS)
    time = torch.arange(frames, dtype=torch.float64)
    pitch = 0.35 * ((20 - time) / 4).clamp(0, 1) - 0.8 * ((time - 40) / 8).clamp(0, 1)  # toes up, then heel up
    forward = 0.14 * torch.stack([torch.zeros(frames).double(), pitch.sin(), pitch.cos()], dim=-1)
    away = torch.stack([0 * time, 0.02 * (16 - time).clamp_min(0), -0.08 * (16 - time).clamp_min(0)], dim=-1)
    away += torch.stack([0 * time, 0.03 * (time - 50).clamp_min(0), 0.08 * (time - 50).clamp_min(0)], dim=-1)
    heel_stands = (pitch >= 0)[:, None]
    flat = torch.tensor([0.0, 0.0, 0.14]).double()
    heel = away + torch.where(heel_stands, 0.0, flat - forward)
    toe = heel + forward
    toe[:, 1] += 0.04
    heel[:, 1] += 0.02
    return toe[:, None].expand(-1, 2, -1), heel[:, None].expand(-1, 2, -1)


def by_loop(toe_contacts, toes, heels, reach=0.02, slow=0.35):
    """The definition frame by frame."""
    low = [[heels[t, k, 1] - toes[t, k, 1] + DROPS[k] < reach for k in range(2)] for t in range(len(toes))]
    flat = torch.tensor(low) & toe_contacts
    out = flat.clone()
    for t in range(1, len(toes) - 1):
        for k in range(2):
            near = heels[t, k, 1] - toes[t + 1, k, 1] + DROPS[k] < reach
            still = (heels[t, k] - heels[t - 1, k])[[0, 2]].norm() * FPS < slow
            if not toe_contacts[t, k] and flat[t + 1, k] and near and still:
                out[t, k] = True
    return out


def test_the_canonical_heel_is_where_it_was_measured():
    for offset in find_heels(CANONICAL):
        torch.testing.assert_close(offset, torch.tensor([0.0, -0.095, -0.05]).double(), atol=1e-4, rtol=0)
    assert find_heel_drops(CANONICAL) == pytest.approx((0.0201, 0.0201), abs=1e-5)


def test_heels_are_to_scale_and_behind_a_foot_that_points_anywhere():
    large = replace(CANONICAL, offsets=1.3 * CANONICAL.offsets)
    torch.testing.assert_close(find_heels(large), 1.3 * find_heels(CANONICAL))
    turn = rotations.about_y(torch.tensor(0.4).double())
    offsets = CANONICAL.offsets.clone()
    toes = CANONICAL.indices(TOES)
    offsets[toes] = rotations.rotate(turn.expand(2, 4), offsets[toes])
    outward = find_heels(Skeleton(CANONICAL.names, CANONICAL.parents, offsets))
    torch.testing.assert_close(outward, rotations.rotate(turn.expand(2, 4), find_heels(CANONICAL)))
    assert bool(torch.isfinite(find_heels(replace(CANONICAL, offsets=0 * CANONICAL.offsets))).all())


def test_a_heel_stands_from_its_strike_until_it_rolls_off():
    toes, heels = roll()
    bits = detect_contacts(toes, FPS)
    planted = derive_heel_contacts(bits, toes, heels, DROPS, FPS)
    assert torch.equal(planted, by_loop(bits, toes, heels))
    (stands,) = planted[:, 0].nonzero(as_tuple=True)
    assert torch.equal(stands, torch.arange(int(stands[0]), int(stands[-1]) + 1))
    first_toe = int(bits[:, 0].nonzero()[0])
    assert int(stands[0]) == first_toe - 1
    assert int(stands[-1]) < int(bits[:, 0].nonzero()[-1])
    agreement = (planted == detect_contacts(heels, FPS)).double().mean()
    assert float(agreement) > 0.95


def test_no_heel_has_struck_that_travels_or_hangs():
    toes, heels = roll()
    bits = detect_contacts(toes, FPS)
    first = int(bits[:, 0].nonzero()[0])
    for axis, by in ((2, 0.05), (1, 0.05)):
        moved = heels.clone()
        moved[first - 1, 0, axis] -= by if axis == 2 else -by
        planted = derive_heel_contacts(bits, toes, moved, DROPS, FPS)
        assert planted[first - 1].tolist() == [False, True]
    none = derive_heel_contacts(bits, toes, heels, DROPS, FPS, HeelContactSettings(strike=0.0))
    assert not bool(none[first - 1].any())
    assert bool(none[first].all())
