"""Keys that tell no rotation, as the generator takes them: coordinates of some joints."""

from dataclasses import replace

import torch

from mapctl.inbetweening import PositionImage
from mapctl.inbetweening.loose_keys import LooseKeys
from mapctl.skeleton import CANONICAL


def show_loose_keys(image: PositionImage, loose: LooseKeys) -> PositionImage:
    """Show places over the ground, over which the reference of an image of one motion leads, and drawings in frames of
    which nothing else is known: from where the first of these is seen the reference then looks back, without turning.
    """
    axes, places = image.known_axes.clone(), image.places
    axes[0, loose.placed, 0, 0] = axes[0, loose.placed, 0, 2] = True
    seen = loose.see_from_one_side(CANONICAL)
    if seen is None:
        return replace(image, known_axes=axes)
    turned = replace(image, heading=torch.full_like(image.heading, seen.view))
    places = turned.from_world(image.to_world(places))
    open_frames = ~image.known[0].any(dim=-1) & loose.drawings
    shown = seen.known & open_frames[:, None, None]
    axes[0] |= shown
    places = torch.where(shown, seen.places.to(places), places[0])[None]
    return replace(turned, places=places, known_axes=axes)
