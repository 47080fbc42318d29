"""
Move a character
================

A skinned character in a GLB, VRM or USD file is a rig like any other. This one is a child on Mixamo's joints, made on
the spot. It gets the walk of an adult, and then walks as far by itself, in strides of its own.
"""

from dataclasses import replace

import torch

import controllers
import mapctl
import priors
from mapctl.retarget import load_rig
from mapctl.retarget.carry import retarget_motion
from mapctl.retarget.character import make_tpose_clip
from scenes import CameraSettings, Shot
from scenes.drawn_character import DrawnCharacter
from scenes.film import film

tpose = make_tpose_clip(load_rig("mixamo"))
small = replace(tpose.skeleton, offsets=0.65 * tpose.skeleton.offsets)
replace(tpose, skeleton=small, root_position=0.65 * tpose.root_position).save("child.glb")  # with a skinned mesh

child, prior = DrawnCharacter.load("child.glb"), priors.load("locomotion")
adult = controllers.follow(prior, mapctl.curves.line(length=4.0)).motion
moved = retarget_motion(adult, child.body).motion
beside = mapctl.curves.from_points(torch.tensor([[1.8, 0.0], [1.8, 4.0]]))
own = controllers.follow(prior, beside, skeleton=child.body.leveled).motion
child.body.on_rig(own).save("child-walk.glb")  # its mesh and skin with the new motion, for any engine

# %%
# In front the child by itself, then the child with the adult's walk, which takes it less far, and the adult.

moved = replace(moved, root_position=moved.root_position + torch.tensor([0.9, 0.0, 0.0]))
shots = [Shot(adult), Shot(moved, drawn=child.put_on(moved)), Shot(own, drawn=child.put_on(own))]
film(shots, "an-adult-and-a-child.webp", camera=CameraSettings(azimuth_deg=60), size=(480, 270), fps=15)
