"""Rigs by commands: found and given ones, units, and every command on every kind of file a character comes in."""

import json
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
from character_maker import make_character_glb
from fbx_maker import make_fbx
from helpers import bandai_skeleton, generator, run, tiny_density
from PIL import Image
from rig_maker import Make, make, names_of, person
from strange_rigs import CASES

import controllers
import mapctl
import priors
from controllers.common.character import Character
from controllers.shots.shot import follow
from controllers.shots.walk import FollowSettings
from mapctl import contacts, curves, formats, retarget
from mapctl.commands.shared import inputs
from mapctl.motion import Motion
from mapctl.problem.receding_horizon import HorizonSettings
from mapctl.problem.window_solvers import LatentNoiseSolver
from mapctl.retarget.carry import RiggedCharacter, retarget_motion
from mapctl.skeleton import CANONICAL, TOE_REST_HEIGHT, Skeleton
from mapctl.solver.budget import Budget
from mapctl.terms import FootContact

QUICK = FollowSettings(
    liveliness=0.0,
    window=HorizonSettings(frames=10, overlap=4, past=12),
    method=LatentNoiseSolver(rounds=1, budget=Budget(evaluations=15)),
)
SIZE = 1.3


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """A tall performer, on a Z-up rig whose root travels and whose rest pose is an A."""
    result = make(Make(names_of("mixamo"), size=SIZE, zup=True, arms_down_deg=40, root="Reference"))
    path = tmp_path_factory.mktemp("rig") / "tall.bvh"
    result.motion(person(SIZE, 45)).save(path)
    return path


def test_info_prints_a_clips_rig(clip, capsys):
    assert run("info", clip, "--json") == 0
    printed = json.loads(capsys.readouterr().out)
    assert (printed["rig"], printed["up"], printed["facing"], printed["rest_pose"]) == ("mixamo", "z", "-y", "A")
    assert (printed["frames"], printed["fps"], printed["metres_per_unit"]) == (45, 30, 0.01)
    assert printed["score"] == 1
    assert printed["joints"]["leftUpperLeg"] == "mixamorig:LeftUpLeg"
    assert "Prop_sword" in printed["unmapped"]
    assert run("info", clip) == 0
    shown = capsys.readouterr().out
    assert all(word in shown for word in ("mixamo", "centimetres", "+z", "1.50", "mixamorig:LeftUpLeg", "Prop_sword"))


@pytest.mark.slow
def test_info_prints_a_sure_fit_and_draws_it(clip, tmp_path, capsys):
    assert run("info", clip, "-o", tmp_path / "rig.png") == 0
    assert "fit: sure\n" in capsys.readouterr().out
    with Image.open(tmp_path / "rig.png") as picture:
        assert picture.size == (1600, 960)
        colours = {colour for _, colour in picture.convert("RGB").getcolors(1 << 20)}
    assert {(0x4C, 0x78, 0xA8), (0xF5, 0x85, 0x18), (0x33, 0x33, 0x33)} <= colours  # left, right and middle
    assert run("info", clip, "--json") == 0
    printed = json.loads(capsys.readouterr().out)
    assert (printed["fit"], printed["doubts"]) == ("sure", [])
    assert set(printed["known_by"].values()) == {"list"}


@pytest.fixture
def odd(tmp_path):
    """A rig of which one joint has no telling name."""
    path = tmp_path / "odd.bvh"
    make(Make(names_of("mixamo") | {"leftHand": "a17"}, arms_down_deg=40)).motion(person(1.0, 20)).save(path)
    return path


@pytest.mark.slow
def test_info_prints_every_doubt_and_other_commands_the_first_once(odd, tmp_path, capsys):
    reason = "leftHand is known by its position alone (joint 'a17')"
    overrule = "--unit, --up and --rig overrule what was guessed"
    assert run("info", odd, "--out", tmp_path / "odd.png") == 0
    assert f"fit: doubtful\ndoubtful: {reason}\n{overrule}\n" in capsys.readouterr().out
    assert (tmp_path / "odd.png").stat().st_size > 10_000
    assert run("info", odd, "--json") == 0
    printed = json.loads(capsys.readouterr().out)
    assert (printed["fit"], printed["doubts"]) == ("doubtful", [reason])
    assert printed["known_by"]["leftHand"] == "position"
    assert run("convert", odd, tmp_path / "a.bvh", "--quiet") == 0
    assert capsys.readouterr().err == ""
    for _ in range(2):
        assert run("convert", odd, tmp_path / "a.bvh", "--rig", "canonical") == 0
    assert capsys.readouterr().err == f"mapctl: {odd}: {reason}; {overrule}, see mapctl info {odd}\n"


def test_info_prints_what_is_known_of_a_refused_clip(tmp_path, capsys):
    CASES["a snake"].motion.save(tmp_path / "snake.bvh")
    assert run("info", tmp_path / "snake.bvh", "-o", tmp_path / "snake.png") == 2
    printed = capsys.readouterr()
    assert printed.err.count("\n") == 1
    assert "no joint is found for hips" in printed.err
    assert all(word in printed.out for word in ("fit: refused", "v17", "frames"))
    assert not (tmp_path / "snake.png").exists()
    assert run("info", tmp_path / "snake.bvh", "--json") == 2
    printed = json.loads(capsys.readouterr().out)
    assert (printed["fit"], printed["joints"], printed["frames"]) == ("refused", {}, 12)
    assert "no joint is found for hips" in printed["doubts"][0]
    assert run("convert", tmp_path / "snake.bvh", tmp_path / "a.bvh", "--rig", "canonical") == 2


def test_a_rig_that_is_given_wins(clip, tmp_path, capsys):
    (tmp_path / "mine.toml").write_text('unit = "in"\nup = "y"\n[joints]\nhips = "mixamorig:Hips"\n')
    assert run("info", clip, "--json", "--rig", tmp_path / "mine.toml") == 0
    printed = json.loads(capsys.readouterr().out)
    assert (printed["rig"], printed["up"], printed["metres_per_unit"]) == ("mine", "y", 0.0254)
    assert run("convert", clip, tmp_path / "a.bvh", "--rig", "canonical", "--source-rig", tmp_path / "mine.toml") == 0
    assert set(mapctl.load(tmp_path / "a.bvh").skeleton.names) == set(CANONICAL.names)
    assert run("info", clip, "--rig", clip) == 0


@pytest.fixture
def told_rig(request, tmp_path):
    """A rig by the name of a preset, in any case, or by a TOML file: Z up, metres, names of its own."""
    if request.param != "TOML":
        return request.param
    joints = "\n".join(f'{name} = "b_{name}"' for name in CANONICAL.names if name != "neck")
    (tmp_path / "ours.toml").write_text(f'up = "z"\nunit = "m"\n[joints]\n{joints}\n')
    return tmp_path / "ours.toml"


@pytest.mark.parametrize(
    ("job", "told_rig"),
    [
        *(("convert", rig) for rig in ("Bandai-Namco", "cmu-daz", "TOML", "rigify", "mmd")),
        *(pytest.param("follow", rig, marks=pytest.mark.slow) for rig in ("TOML", "daz-genesis", "mmd")),
        *(pytest.param(*pair, marks=pytest.mark.slow) for pair in (("steer", "mixamo"), ("run", "iclone"))),
        ("generate", "TOML"),
    ],
    indirect=["told_rig"],
)
def test_rigs_by_name_or_file_get_the_canonical_bones(job, told_rig, prior, tmp_path):
    jobs = words_of(tmp_path, prior)
    person(1.0).save(tmp_path / "in.bvh")
    jobs["convert"] = (tmp_path / "in.bvh", tmp_path / "a.bvh")
    quiet = () if job == "convert" else ("--quiet",)
    assert run(job, *jobs[job], "--rig", told_rig, *quiet) == 0
    rig = retarget.load_rig(told_rig)
    result = mapctl.load(tmp_path / ("generated_000.bvh" if job == "generate" else "a.bvh"))
    assert set(result.skeleton.names) == {*rig.joints.values(), *rig.trunk}
    canonical, rigmap = retarget.to_canonical(result, rig)
    own = [joint for joint in range(1, CANONICAL.num_joints) if CANONICAL.names[joint] in rig.joints]
    lengths = CANONICAL.offsets.norm(dim=-1)
    lower = [CANONICAL.index(side + "LowerLeg") for side in ("left", "right")]
    torch.testing.assert_close(rigmap.skeleton.offsets[lower].norm(dim=-1), lengths[lower], atol=1e-4, rtol=0)
    assert len(own) >= 18
    heights = canonical.joint_positions()[..., 1]
    assert 0.6 < float(heights[:, 0].mean()) < 1.0  # upright in its world, in its unit
    assert float(heights[:, CANONICAL.index("head")].min()) > float(heights[:, 0].max())


def test_convert_to_a_z_up_rig_stands_in_its_world(clip, tmp_path):
    walk = retarget.from_canonical(person(1.0), retarget.identify_rig(bandai_skeleton()))
    walk.save(tmp_path / "in.bvh")
    assert run("convert", tmp_path / "in.bvh", tmp_path / "out.bvh", "--rig", clip) == 0
    canonical, rigmap = retarget.to_canonical(mapctl.load(tmp_path / "out.bvh"))
    assert (rigmap.up, rigmap.rig.name) == ("z", "mixamo")
    hips = canonical.root_position[:, 1] / SIZE
    torch.testing.assert_close(hips, person(1.0).root_position[:, 1], atol=0.01, rtol=0)


def words_of(folder, prior):
    """By job, what asks for 0.4 s of motion in the file a.bvh or generated_000.bvh of a folder."""
    (folder / "c.csv").write_text("time_s,speed_mps,heading_deg\n0,1.2,0\n0.4,1.0,40\n")
    scene = f'prior = "{prior}"\noutputs = ["a.bvh"]\n[[actors]]\ncurve = "line:2"\nseconds = 0.4\n'
    (folder / "s.toml").write_text(scene)
    return {
        "follow": ("line:2", "-o", folder / "a.bvh", "--seconds", 0.4, "--prior", prior),
        "steer": (folder / "c.csv", "-o", folder / "a.bvh", "--prior", prior),
        "generate": ("-o", folder, "--seconds", 0.4, "--prior", prior, "--no-footing"),
        "run": (folder / "s.toml", "-o", folder),
    }


@pytest.mark.parametrize("job", ["follow", "steer", "generate", "run"])
def test_motion_is_written_on_the_clips_rig(job, clip, prior, tmp_path):
    out, words = tmp_path / "a.bvh", words_of(tmp_path, prior)[job]
    assert run(job, *words, "--rig", clip, "--quiet") == 0
    result = mapctl.load(tmp_path / "generated_000.bvh" if job == "generate" else out)
    rig = mapctl.load(clip)
    assert result.num_frames == 12
    assert result.skeleton.matches(rig.skeleton, 1e-4)
    canonical, rigmap = retarget.to_canonical(result)
    assert rigmap.up == "z"
    assert 0.8 < float(canonical.root_position[:, 1].mean()) / SIZE < 1.0


def test_twice_the_legs_make_twice_the_way():
    """The same walk, of everything twice as long: a prior cannot tell it from its own."""
    density, double = tiny_density(), Skeleton(CANONICAL.names, CANONICAL.parents, CANONICAL.offsets * 2)
    small = controllers.follow(
        density, curves.circle(radius=2.0), seconds=1.0, speed=1.0, settings=QUICK, generator=generator()
    )
    footing = FootContact(sigma_speed=0.06, sigma_height=0.02, sigma_below=0.01, rest_height=2 * TOE_REST_HEIGHT)
    twice = {
        name: 2 * getattr(QUICK, name)
        for name in ("path_sigma_slow", "path_free_sway", "path_sigma_raw", "path_sigma_progress")
    }
    large = controllers.follow(
        density,
        curves.circle(radius=4.0),
        seconds=1.0,
        speed=2.0,
        skeleton=double,
        settings=replace(QUICK, footing=footing, **twice),
        generator=generator(),
    )
    assert large.motion.skeleton is double
    positions = large.motion.joint_positions() / 2
    torch.testing.assert_close(positions, small.motion.joint_positions(), atol=0.02, rtol=0)
    residuals = [{entry.name: float(entry.residual.mean()) for entry in done.ledger.entries} for done in (small, large)]
    assert residuals[1]["path"] == pytest.approx(2 * residuals[0]["path"], rel=0.1)


@pytest.fixture(scope="module")
def zup_clip(tmp_path_factory):
    """A walk on a Z-up rig in centimetres."""
    path = tmp_path_factory.mktemp("rig") / "walk.bvh"
    make(Make(names_of("mixamo"), zup=True, arms_down_deg=40, root="Reference")).motion(person(1.0, 45)).save(path)
    return path


def test_a_body_that_travels_faster_than_people_do_has_a_doubtful_unit(zup_clip, tmp_path, capsys):
    motion = mapctl.load(zup_clip)
    travel = torch.zeros_like(motion.root_position)
    travel[:, 1] = torch.arange(motion.num_frames) * 24.0 / float(motion.fps)
    replace(motion, root_position=motion.root_position + travel).save(tmp_path / "fast.bvh")
    assert run("info", tmp_path / "fast.bvh", "--json") == 0
    assert "m/s for a second: the unit may be wrong" in json.loads(capsys.readouterr().out)["doubts"][0]


@pytest.mark.parametrize("unit", ["in", "0.0254"])
def test_a_given_unit_is_obeyed_by_every_command(zup_clip, unit, tmp_path, capsys):
    assert run("convert", zup_clip, tmp_path / "out.npz", "--unit", unit) == 0
    own, converted = mapctl.load(zup_clip), mapctl.load(tmp_path / "out.npz")
    torch.testing.assert_close(converted.root_position, own.root_position * 2.54)
    assert run("convert", tmp_path / "out.npz", tmp_path / "again.npz", "--unit", unit) == 0  # whose metres are inches
    torch.testing.assert_close(mapctl.load(tmp_path / "again.npz").root_position, 0.0254 * converted.root_position)
    capsys.readouterr()
    heights = []
    for options in ((), ("--unit", unit)):
        assert run("measure", zup_clip, "--json", *options) == 0
        heights.append(json.loads(capsys.readouterr().out)["measures"]["hips_height_m"])
    assert heights[1] == pytest.approx(2.54 * heights[0], rel=1e-3)


def test_a_given_up_axis_is_obeyed(zup_clip, capsys):
    assert run("info", zup_clip, "--json", "--up", "-x") == 0
    printed = json.loads(capsys.readouterr().out)
    assert (printed["up"], printed["rig"], len(printed["joints"])) == (
        "-x",
        "mixamo",
        21,
    )  # its joints are recognised as before


def test_the_unit_is_that_of_a_body_too(zup_clip, prior, tmp_path):
    words = ("--seconds", 0.4, "--prior", prior, "--no-footing", "--quiet", "--to", ".npz")
    assert run("generate", "-o", tmp_path, *words, "--rig", zup_clip, "--unit", "in") == 0
    bones = [mapctl.load(path).skeleton.offsets for path in (tmp_path / "generated_000.npz", zup_clip)]
    torch.testing.assert_close(bones[0][1:], 2.54 * bones[1][1:], atol=1e-4, rtol=0)


_FEET, _TOES = ([CANONICAL.index(side + part) for side in ("left", "right")] for part in ("Foot", "Toes"))
_BVH = {
    "bandai-namco.bvh": Make(names_of("bandai-namco"), root="joint_Root"),
    "cmu-daz.bvh": Make(names_of("cmu-daz"), size=1.1),
    "cmu-asf.bvh": Make(names_of("cmu-asf"), bones_along_x=True, size=0.95),
    "lafan1.bvh": Make(names_of("lafan1"), bones_along_x=True),
    "mixamo.bvh": Make(names_of("mixamo"), arms_down_deg=45, zup=True),
    "iclone.bvh": Make(names_of("iclone"), arms_down_deg=30, size=1.2),
}
_CHARACTERS = {
    "mixamo.glb": {"pose": "A", "leaves": "joints"},
    "unreal.glb": {"names": "unreal", "root": "root", "pose": "A", "size": 1.2},
    "vroid.vrm": {"names": "vrm", "armature_scale": 1.0, "zup_armature": False, "size": 0.85},
    "old.vrm": {"names": "vrm0", "armature_scale": 1.0, "zup_armature": False},
}
RIGS = (*_BVH, *_CHARACTERS, "body.usda", "limbs.fbx")
COMMANDS = ("follow", "generate", "steer", "convert", "denoise", "infill", "tween")


@dataclass(frozen=True)
class Rig:
    """A rig's file, and a walk on it in a file of the same kind."""

    file: Path
    clip: Path
    body: RiggedCharacter


@pytest.fixture(scope="module")
def walked() -> Motion:
    """Three seconds of the bundled prior's walking, straight and round a bend."""
    generator = torch.Generator().manual_seed(1)
    return follow(priors.load("locomotion"), curves.circle(radius=3.0), seconds=3, generator=generator).motion


@pytest.fixture(scope="module")
def rigs(walked, tmp_path_factory):
    """Each rig's files, made when they are requested."""
    result: dict[str, Rig] = {}

    def find(name: str) -> Rig:
        if name not in result:
            folder = tmp_path_factory.mktemp(name.replace(".", "-"))
            file = clip = folder / name
            if name == "body.usda":
                pytest.importorskip("pxr")
                make_character_usd = import_module("usd_maker").make_character_usd
                make_character_usd(file, up="Z", unit=0.01)
                clip = folder / "walk.usda"
            elif name == "limbs.fbx":
                pytest.importorskip("ufbx")
                make_fbx(file, z_up=True)
                clip = folder / "walk.glb"
            elif name in _BVH:
                sized = replace(walked, root_position=walked.root_position * _BVH[name].size)
                make(_BVH[name]).motion(sized).save(file)
            else:
                make_character_glb(file, **_CHARACTERS[name])
                clip = folder / f"walk-{name}"
            body = RiggedCharacter.of(*inputs.read_rig_clip(str(file)))[1]
            if clip != file:
                body.on_rig(retarget_motion(walked, body).motion).save(clip)
            result[name] = Rig(file, clip, body)
        return result[name]

    return find


def foot_pitches(motion: Motion) -> np.ndarray:
    """Slope of the line from ankle to toe joint, degrees, of the left and right foot, while it lies flat."""
    canonical, _ = retarget.to_canonical(motion)
    positions = canonical.joint_positions()
    planted = contacts.detect_contacts(positions[:, _TOES], canonical.fps)
    found = []
    for side in range(2):
        ankle, toe = positions[:, _FEET[side]], positions[:, _TOES[side]]
        low = ankle[:, 1] < torch.quantile(ankle[planted[:, side], 1], 0.1) + 0.01
        along = (toe - ankle)[planted[:, side] & low]
        found.append(float(torch.rad2deg(torch.atan2(along[:, 1], along[:, ::2].norm(dim=-1))).median()))
    return np.array(found)


def standing_pitches(rig: Rig) -> np.ndarray:
    """The same in the pose in which a character stands, or as it lies in the rig's own clip."""
    if formats.load_rest(rig.file) is None:
        return foot_pitches(mapctl.load(rig.file))
    canonical, _ = retarget.to_canonical(inputs.read_rig_clip(str(rig.file))[0])
    along = canonical.joint_positions()[0, _TOES] - canonical.joint_positions()[0, _FEET]
    return torch.rad2deg(torch.atan2(along[:, 1], along[:, ::2].norm(dim=-1))).numpy()


def words_on(command: str, rig: Rig, out: Path, walked: Motion) -> list[object]:
    """A command on a rig that writes `out`."""
    folder = out.parent
    if command == "convert":
        walked.save(folder / "walked.npz")
    if command == "steer":
        (folder / "orders.csv").write_text("time_s,speed_mps,heading_deg\n0,1.2,0\n1.5,1.2,40\n3,1.2,40\n")
    return {
        "follow": ["follow", "circle:3", "-o", out, "--seconds", "3", "--rig", rig.file, "--quiet"],
        "generate": ["generate", "-o", folder, "--seconds", "3", "--rig", rig.file, "--to", out.suffix, "--quiet"],
        "steer": ["steer", folder / "orders.csv", "-o", out, "--rig", rig.file, "--quiet"],
        "convert": ["convert", folder / "walked.npz", out, "--rig", rig.file],
        "denoise": ["denoise", rig.clip, "-o", out],
        "infill": ["infill", rig.clip, "-o", out, "--gap", "30:55"],
        "tween": ["tween", rig.clip, "-o", out, "--keyframes", "0,15,30,45,60,75,89"],
    }[command]


def cells():
    """All rigs by all commands; quick ones on the diagonal."""
    for row, rig in enumerate(RIGS):
        for column, command in enumerate(COMMANDS):
            quick = column == row % len(COMMANDS)
            yield pytest.param(rig, command, marks=() if quick else pytest.mark.slow, id=f"{rig}-{command}")


@pytest.mark.slow
@pytest.mark.parametrize(("name", "command"), [*cells()])
def test_every_command_on_every_rig(name, command, rigs, walked, tmp_path, capsys):
    rig = rigs(name)
    out = tmp_path / f"out{rig.clip.suffix}"  # an FBX character comes back as .glb, with its mesh
    assert run(*words_on(command, rig, out, walked)) == 0, capsys.readouterr().err
    result = mapctl.load(tmp_path / f"generated_000{out.suffix}" if command == "generate" else out)
    expected = rig.body.rigmap.rig_skeleton
    assert (result.skeleton.names, result.skeleton.parents) == (expected.names, expected.parents)
    assert result.num_frames >= 89
    np.testing.assert_allclose(foot_pitches(result), standing_pitches(rig), atol=5.0)
    toes = retarget.to_canonical(result)[0].joint_positions()[:, _TOES, 1]
    low = torch.quantile(toes, 0.05, dim=0)
    torch.testing.assert_close(low, rig.body.stance.toe_height, atol=0.015, rtol=0)
    steps = result.joint_positions().diff(dim=0).norm(dim=-1)
    size = Character(retarget.to_canonical(result)[0].skeleton).scale
    assert float(steps.max()) * float(result.fps) < 9.0 * max(1.0, size)
