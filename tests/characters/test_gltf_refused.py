"""Broken glTF characters are told in a line, and only files within the character's folder are read."""

import json
import shutil

import pytest
from character_maker import make_character_glb
from forged_characters import edit_glb

from mapctl import formats
from mapctl.errors import FileFormatError


def make(folder):
    return make_character_glb(folder / "hero.glb")


def hips_of(made):
    return made.nodes[made.names.index("mixamorig:Hips")]


BROKEN = {
    "no skin": (lambda t, m: t.pop("skins"), "has no skin"),
    "non-uniform scale": (lambda t, m: t["nodes"][0].update(scale=[0.01, 0.02, 0.01]), "not the same along all axes"),
    "negative scale": (lambda t, m: t["nodes"][0].update(scale=[-0.01, 0.01, 0.01]), "negative, which mirrors"),
    "no scale": (lambda t, m: t["nodes"][0].update(scale=[0, 0, 0]), "zero"),
    "draco": (lambda t, m: t.update(extensionsRequired=["KHR_draco_mesh_compression"]), "compressed .Draco"),
    "meshopt": (lambda t, m: t.update(extensionsRequired=["EXT_meshopt_compression"]), "compressed .meshopt"),
    "missing buffer": (lambda t, m: t["buffers"][0].update(byteLength=2**28), "should have 268435456 bytes, there are"),
    "file that is not there": (lambda t, m: t["buffers"][0].update(uri="gone.bin"), "'gone.bin', which is not there"),
    "file elsewhere": (lambda t, m: t["buffers"][0].update(uri="../x.bin"), "'../x.bin', which is not in its folder"),
    "absolute file": (lambda t, m: t["buffers"][0].update(uri="/etc/passwd"), "which is not in its folder"),
    "web address": (lambda t, m: t["buffers"][0].update(uri="https://host/x.bin"), "which is not in its folder"),
    "glTF 1": (lambda t, m: t["asset"].update(version="1.0"), "is glTF '1.0', expected 2.0"),
    "loop": (lambda t, m: t["nodes"][hips_of(m)].setdefault("children", []).append(0), "below itself"),
    "two parents": (lambda t, m: t["nodes"][0]["children"].append(hips_of(m) + 1), "has two parents"),
    "number as text": (lambda t, m: t["nodes"][0].update(translation=[0, "0", 0]), r"translation\[1\]: .* number"),
    "half a letter": (lambda t, m: t["nodes"][0].update(name="\ud800"), "its JSON cannot be read"),
    "joint beyond": (lambda t, m: t["skins"][0]["joints"].append(999), "names node 999"),
}


@pytest.mark.parametrize("fault", BROKEN)
def test_faults_are_told_in_a_line(fault, tmp_path):
    made = make(tmp_path)
    change, told = BROKEN[fault]
    edit_glb(made.path, lambda tree: change(tree, made))
    with pytest.raises(FileFormatError, match=told) as caught:
        formats.load(made.path)
    assert "\n" not in str(caught.value)
    assert str(made.path) in str(caught.value)


def test_a_cut_file_is_told(tmp_path):
    made = make(tmp_path)
    raw = made.path.read_bytes()
    for length in (3, 11, 19, 100, len(raw) - 1):
        made.path.write_bytes(raw[:length])
        with pytest.raises(FileFormatError):
            formats.load(made.path)


def test_neighbours_within_the_folder_are_read(tmp_path):
    made = make_character_glb(tmp_path / "hero.gltf")
    (tmp_path / "below").mkdir()
    tree = json.loads(made.path.read_text())
    name = tree["buffers"][0]["uri"]
    (tmp_path / name).rename(tmp_path / "below" / "the data.bin")
    tree["buffers"][0]["uri"] = "below/the%20data.bin"
    made.path.write_text(json.dumps(tree))
    assert formats.load_rest(made.path).num_joints > 20
    link = tmp_path / "out.bin"
    outside = tmp_path.parent / f"{tmp_path.name}.bin"
    shutil.move(tmp_path / "below" / "the data.bin", outside)
    link.symlink_to(outside)
    tree["buffers"][0]["uri"] = "out.bin"
    made.path.write_text(json.dumps(tree))
    with pytest.raises(FileFormatError, match="not in its folder"):
        formats.load(made.path)
