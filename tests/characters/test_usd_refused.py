"""USD files that are not read: one line says why, and nothing is written."""

import re

import pytest

pytest.importorskip("pxr", reason="needs usd-core: pip install 'mapctl[usd]'")

from forked_readers import fork_readers
from usd_maker import make_character_usd

from mapctl import cli, formats
from mapctl.errors import FileFormatError
from mapctl.formats.usd import reader


@pytest.fixture(autouse=True)
def forked():
    with fork_readers():
        yield


def make(folder, **more):
    make_character_usd(folder / "hero.usda", **more)
    return folder / "hero.usda"


SCALED = 'float3 xformOp:scale = ({})\nuniform token[] xformOpOrder = ["xformOp:scale"]\nfloat3[] extent'
CLIPS = '(\nclips = {{ dictionary default = {{ string templateAssetPath = "{}" }} }} )'
BAD = {
    "no skeleton": (r"def SkelRoot.*", "}", "has no Skeleton"),
    "no usd": (r".*", "hello", "is no sound USD file"),
    "cut off": (r"def Mesh.*", "", "is no sound USD file"),
    "uneven scale": (r"float3\[\] extent", SCALED.format("1, 2, 1"), "not the same along all axes"),
    "negative scale": (r"float3\[\] extent", SCALED.format("-1, 1, 1"), "negative"),
    "missing layer": (r"\(\n", "(\nsubLayers = [@./gone.usda@]\n", "'./gone.usda', which is not there"),
    "outside": (r"\(\n", "(\nsubLayers = [@../out.usda@]\n", "not in its folder"),
    "absolute": (r"\(\n", "(\nsubLayers = [@/etc/hosts.usda@]\n", "not in its folder"),
    "web": (r"\(\n", "(\nsubLayers = [@https://host/a.usda@]\n", "not in its folder"),
    "clips": (r'(SkelRoot "\w+")', r"\1 " + CLIPS.format("../c.#.usda"), "not in its folder"),
    "no unit": (r"metersPerUnit = 1", "metersPerUnit = 0", "metersPerUnit is 0"),
    "joint order": (r'\["hips", "hips/spine",', '["hips/spine", "hips",', "comes before the joint above it"),
    "two joints": (r'\["hips", "hips/spine",', '["hips", "hips",', "names a joint twice"),
}
"""Pattern in a sound file, what stands in its place, and words of the message."""


class TestBadFiles:
    @pytest.mark.parametrize("fault", BAD)
    def test_one_line_says_what(self, fault, tmp_path, capfd):
        path = make(tmp_path, frames=2)
        pattern, instead, words = BAD[fault]
        path.write_text(re.sub(pattern, instead, path.read_text(), count=1, flags=re.DOTALL))
        (tmp_path.parent / "out.usda").write_text("#usda 1.0\n")
        out = tmp_path / "out.bvh"
        assert cli.main(["convert", str(path), str(out)]) == 2
        told = capfd.readouterr()
        assert told.err.count("\n") == 1, told.err
        assert words in told.err
        assert not told.out
        assert not out.exists()

    def test_a_link_that_leads_elsewhere(self, tmp_path):
        (tmp_path / "a").mkdir()
        make_character_usd(tmp_path / "body.usda")
        (tmp_path / "a" / "body.usda").symlink_to(tmp_path / "body.usda")
        (tmp_path / "a" / "hero.usda").write_text("#usda 1.0\n( subLayers = [@./body.usda@] )\n")
        with pytest.raises(FileFormatError, match="not in its folder"):
            formats.load(tmp_path / "a" / "hero.usda")

    def test_a_missing_package_is_named(self, tmp_path, monkeypatch):
        path = make(tmp_path)
        monkeypatch.setattr(reader, "is_installed", lambda: False)
        with pytest.raises(FileFormatError, match=r"pip install 'mapctl\[usd\]'"):
            formats.load(path)


def test_a_value_of_a_type_that_usd_does_not_know_is_none(monkeypatch):
    """A damaged .usdc may hold one; it has no length."""
    from pxr import Sdf, Usd

    from mapctl.isolated.usd.skeletons import read_value

    stage = Usd.Stage.CreateInMemory()
    attribute = stage.DefinePrim("/a").CreateAttribute("b", Sdf.ValueTypeNames.FloatArray)
    attribute.Set([1.0, 2.0])
    assert list(read_value(attribute)) == [1.0, 2.0]
    monkeypatch.setattr(Usd.Attribute, "Get", lambda *given: Sdf.UnregisteredValue("mystery"))
    assert read_value(attribute) is None
