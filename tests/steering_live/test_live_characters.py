"""Characters in the live viewer: what a browser makes of what it is sent is the character's mesh in its pose."""

import time
from contextlib import ExitStack
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import viser
from character_maker import make_character_glb
from glb_viewer import GlbViewer
from helpers import walk
from rig_maker import Make, make, names_of
from stage import delivered

from controllers.common.character import Character
from mapctl import formats, rotations
from mapctl.commands import live
from mapctl.commands.live import Live
from mapctl.commands.shared.inputs import as_character, read_character
from mapctl.motion import Motion
from scenes.drawn_character import DrawnCharacter
from scenes.live.character import CharacterLook, ShownCharacter, SkinnedBody
from scenes.live.recording import encode_motion, join_chunks


@dataclass
class Bone:
    position: np.ndarray
    wxyz: np.ndarray


@dataclass
class SentMesh:
    """Skinned mesh as a browser draws it: linear blend skinning by its four main bones."""

    vertices: np.ndarray
    faces: np.ndarray
    weights: np.ndarray
    bind: np.ndarray
    color: tuple
    opacity: float | None
    bones: list[Bone]

    def drawn(self) -> np.ndarray:
        weights = np.where(self.weights >= np.sort(self.weights, axis=1)[:, -4:][:, :1], self.weights, 0)
        found = np.zeros_like(self.vertices)
        for number, bone in enumerate(self.bones):
            turn = rotations.to_matrix(torch.from_numpy(np.roll(bone.wxyz, -1))).numpy()
            found += weights[:, number, None] * ((self.vertices - self.bind[number]) @ turn.T + bone.position)
        return found


class Scene(viser.SceneApi):
    """Takes skinned meshes as viser's scene does."""

    def __init__(self):
        self.sent: list[SentMesh] = []

    def add_mesh_skinned(
        self, name, vertices, faces, *, bone_wxyzs, bone_positions, skin_weights, color, opacity, side
    ):
        assert (side, skin_weights.shape) == ("double", (len(vertices), len(bone_positions)))
        np.testing.assert_allclose(skin_weights.sum(axis=1), 1, atol=1e-6)
        bones = [Bone(position, turn) for position, turn in zip(bone_positions, bone_wxyzs, strict=True)]
        self.sent.append(SentMesh(vertices, faces, skin_weights, bone_positions, color, opacity, bones))
        return self.sent[-1]


MAKES = {
    "mixamo": {"pose": "A", "hat": True, "leaves": "joints"},
    "unreal": {"names": "unreal", "root": "root", "size": 1.3, "second_skin": True},
}


@pytest.fixture(params=MAKES)
def hero(request, tmp_path):
    return DrawnCharacter.load(make_character_glb(tmp_path / "hero.glb", **MAKES[request.param]).path)


def on_its_bones(hero, frames: int = 30):
    return replace(walk(frames), skeleton=hero.body.leveled)


def test_the_browser_draws_the_mesh_where_films_do(hero):
    scene = Scene()
    body = SkinnedBody(scene, "/hero", hero.mesh, hero)
    motion = on_its_bones(hero)
    poses = body.prepare(motion)
    assert len(poses) == 30
    for frame in (0, 14, 29):
        body.pose(poses[frame])
        placed = hero.put_on(motion).motion
        turns = rotations.to_matrix(placed.joint_rotations()[frame]).numpy()
        vertices, _ = hero.mesh.pose(placed.joint_positions()[frame].numpy(), turns)
        wanted = np.sort(vertices[hero.mesh.faces].mean(axis=1).round(4), axis=0)
        drawn = np.concatenate([sent.drawn()[sent.faces].mean(axis=1) for sent in scene.sent])
        np.testing.assert_allclose(np.sort(drawn.round(4), axis=0), wanted, atol=2e-4)


def recorded(look: CharacterLook, skeleton, frames: int) -> Motion:
    """Recording of so many frames delivered on these bones."""
    character = ShownCharacter.__new__(ShownCharacter)
    character.character, character.look = SimpleNamespace(skeleton=skeleton), look
    return join_chunks(character, [delivered(first) for first in range(0, frames, 3)])


@pytest.mark.parametrize("ending", ["glb", "bvh"])
def test_a_recording_is_of_the_character(hero, ending, tmp_path):
    look, path = CharacterLook(hero, as_character(hero.body).on_rig), tmp_path / f"recorded.{ending}"
    motion = recorded(look, hero.body.leveled, 12)
    assert motion.skeleton.names == hero.standing.skeleton.names
    path.write_bytes(encode_motion(motion, ending))
    if ending == "glb":
        own = on_its_bones(hero, 90).slice(0, 12)
        placed = hero.put_on(own).motion
        turns = rotations.to_matrix(placed.joint_rotations()[5]).numpy()
        vertices, _ = hero.mesh.pose(placed.joint_positions()[5].numpy(), turns)
        skinned = GlbViewer(path).skinned(0, 5 / 30)
        np.testing.assert_allclose(vertices[: len(skinned)], skinned, atol=1e-4)


@pytest.mark.slow
def test_a_character_moves_on_its_own_bones(prior, tmp_path):
    body = as_character(DrawnCharacter.load(make_character_glb(tmp_path / "child.glb", size=0.6).path).body)
    with ExitStack() as opened:
        (result,) = live._start_characters(Live(prior=prior), body, opened)
        assert result.skeleton.matches(body.skeleton)
        chunk = next(chunk for _ in range(200) for chunk in result.poll() or _wait())
        height = float(chunk.motion(result.skeleton).joint_positions()[0, 0, 1])
        assert height == pytest.approx(0.6 * 0.95, abs=0.08), "hips of a child"


def _wait() -> list:
    time.sleep(0.05)
    return []


def write_rig(preset: str, path: Path) -> None:
    """A clip on the joints of a preset, of a small person."""
    skeleton = make(Make(names=names_of(preset), size=0.8)).skeleton
    still = torch.zeros(2, skeleton.num_joints, 4, dtype=torch.float64)
    still[..., 3] = 1.0
    root = torch.tensor([[0.0, 0.8, 0.0]], dtype=torch.float64).repeat(2, 1)
    formats.save(Motion(skeleton, Fraction(30), root, still), path)


def test_with_a_rig_a_mannequin_moves_on_its_bones_and_recordings_are_on_it(tmp_path):
    file = tmp_path / "rig.bvh"
    write_rig("mixamo", file)
    body = read_character(str(file))
    assert body.scale == pytest.approx(0.8, abs=0.07)
    motion = recorded(CharacterLook(on_rig=body.on_rig), body.skeleton, 6)
    assert motion.skeleton.names == formats.load(file).skeleton.names
    plain = recorded(CharacterLook(on_rig=Character().on_rig), Character().skeleton, 6)
    assert plain.skeleton is Character().skeleton, "canonical joints stay"
