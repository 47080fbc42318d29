"""The pages of README.md and docs/, the code and the commands that they show, and the files that those name."""

import re
import shlex
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import pytest
from acclaim import pair
from captures import on_rig
from character_maker import make_character_glb
from fbx_maker import make_fbx
from helpers import walk, write_corpus
from rig_maker import Make, make, names_of
from tiny_denoiser import save_tiny_denoiser
from tiny_infiller import save_tiny_infiller
from tiny_prior import save_tiny_prior

ROOT = Path(__file__).resolve().parents[1]
PAGES = ("README.md", *(str(page.relative_to(ROOT)) for page in sorted((ROOT / "docs").rglob("*.md"))))

_NO_INPUTS = ("*.png", "*.md", "*.py", "_build", "auto_gallery", "made")
"""What the commands of pages do not read."""
_SMALL = {"--seconds": "1", "--count": "1", "--jobs": "1"}
_TINY = {
    "follow": {"--prior": "prior.safetensors"},
    "generate": {"--prior": "prior.safetensors"},
    "steer": {"--prior": "prior.safetensors"},
    "measure": {"--prior": "prior.safetensors"},
    "denoise": {"--denoiser": "denoiser.safetensors"},
    "infill": {"--inbetweener": "infiller.safetensors", "--prior": "prior.safetensors"},
    "tween": {"--inbetweener": "infiller.safetensors", "--prior": "prior.safetensors"},
    "blend": {"--inbetweener": "infiller.safetensors"},
    "chain": {"--inbetweener": "infiller.safetensors"},
}
_NAMED_MODELS = ("--prior", "--init", "--density")
_TRAINING = {"lstm-gmm": "--steps 2 --batch 2 --window 20 --device cpu", "refiner": "--steps 1 --batch 2 --window 10"}


def import_extension(name: str) -> ModuleType:
    """Import an extension of the site; the test module is skipped where the site's packages are not installed."""
    if (folder := str(ROOT / "docs" / "extensions")) not in sys.path:
        sys.path.append(folder)
    return pytest.importorskip(name, reason="the site's packages are not installed")


@dataclass(frozen=True)
class Block:
    """Fenced lines of a page."""

    page: str
    number: int
    """Of those of its language on its page, from 0."""
    language: str
    text: str

    def __str__(self) -> str:
        return f"{self.page}-{self.language or 'plain'}-{self.number}"


def read_page(page: str) -> str:
    """Its text."""
    return (ROOT / page).read_text("utf-8")


def blocks(page: str, language: str) -> list[Block]:
    """The fenced blocks of a language; `` for none."""
    # Directives have fences, too: what closes one must not pass for what opens a plain block.
    found = re.findall(r"^```(\w*|\{[^\n]*)\n(.*?)^```", read_page(page), re.DOTALL | re.MULTILINE)
    return [Block(page, n, language, text) for n, text in enumerate(text for lang, text in found if lang == language)]


def commands(page: str) -> list[str]:
    """The lines of its fenced blocks that call mapctl."""
    lines = [line.split(" #")[0].strip() for block in blocks(page, "") for line in block.text.splitlines()]
    return [line for line in lines if line.startswith("mapctl ")]


def inline_commands(page: str) -> list[str]:
    """Those within its sentences that are whole: with an option, and words that are no names of alternatives."""
    prose = re.sub(r"^```.*?^```", "", read_page(page), flags=re.DOTALL | re.MULTILINE)
    found = [" ".join(line.split()) for line in re.findall(r"`(mapctl [^`]+)`", prose)]
    return [line for line in found if " -" in line and "|" not in line]


def shorten(line: str) -> list[str]:
    """A command's words on small models and for short motions, where its options allow it."""
    words = shlex.split(line)[1:]
    name, tiny = words[0], dict(_TINY.get(words[0], {}))
    if name == "train":
        words = [*words, *_TRAINING[words[1]].split()]
    elif name == "follow" and not {"--seconds", "--loop"} & {*words}:
        words += ["--seconds", "1"]
    if name == "render":
        words += ["--size", "96x64"]
    for place, word in enumerate(words[:-1]):
        if word in _NAMED_MODELS:
            words[place + 1] = "prior.safetensors"
        elif word in _SMALL:
            words[place + 1] = _SMALL[word]
        tiny.pop(word, None)
        if word == "--method" and words[place + 1] == "tweener":
            tiny.clear()  # the bundled one is small, and without the MAP stage no density is asked
        if word == "--method" and words[place + 1] == "stitcher" and "--no-finish" in words:
            tiny.clear()  # likewise
        if word == "--variations" and "--method" not in words:
            tiny.pop("--prior", None)  # rollouts of a density that never saw a motion jump, and are left out
    if name == "measure" and "--curve" not in words:
        tiny.clear()
    return [*words, *(part for option in tiny.items() for part in option)]


def write_files(folder: Path) -> None:
    """All that the pages' code and commands name: clips, curves, folders of clips, and small models."""
    save_tiny_prior(folder / "prior.safetensors", labels=("run", "elderly", "walk"))
    save_tiny_denoiser(folder / "denoiser.safetensors", drawn=0.02)
    save_tiny_infiller(folder / "infiller.safetensors", drawn=0.02)
    ours = make(Make(names_of("lafan1")))
    for name, frames in (("take", 260), ("keys", 125), ("wave", 60)):
        frozen = [*range(30), *[30] * 15, *range(45, frames)]
        ours.motion(walk(frames))._map_frames(lambda values, kept=frozen: values[kept]).save(folder / f"{name}.bvh")
    ours.motion(walk(100)).save(folder / "walk.bvh")
    on_rig("cmu", 40).save(folder / "mine.bvh")
    walk(40).save(folder / "walk.npz")
    make_character_glb(folder / "hero.glb", animations=("Walk",))
    make_fbx(folder / "take.fbx")
    for seed, name in enumerate("abcd"):
        walk(150, seed=seed, cadence=0.8 + 0.05 * seed).save(folder / f"{name}.bvh")
    for name in ("takes", "mocap", "mine", "everything", "clips"):
        write_corpus(folder / name, count=3 if name == "takes" else 8, frames=100)
    (folder / "07").mkdir()
    pair(60).write(folder / "07", "07", "07_01")
    shutil.copytree(folder / "07", folder / "cmu" / "07")
    shutil.copy(folder / "07" / "07_01.amc", folder / "take.amc")
    shutil.copy(folder / "07" / "07.asf", folder / "take.asf")
    for name in ("drawn.csv", "way.csv"):
        (folder / name).write_text("x,z\n" + "".join(f"{0.1 * (k % 3)},{0.5 * k}\n" for k in range(20)))
    (folder / "logo.svg").write_text('<svg xmlns="http://www.w3.org/2000/svg"><path d="M0 0 L100 0 L200 100"/></svg>')
    (folder / "script.csv").write_text("time_s,speed_mps,heading_deg\n0,1.2,0\n0.5,1.0,30\n1,1.0,30\n")
    (folder / "lost.csv").write_text("joint,start,stop\nLeftHand,5,15\n")
    shutil.copytree(ROOT / "docs", folder / "docs", ignore=shutil.ignore_patterns(*_NO_INPUTS))
    (folder / "docs" / "inputs" / "poses").mkdir()
    (folder / "scenes").mkdir()
    for scene in (ROOT / "scenes").glob("*.toml"):
        shutil.copy(scene, folder / "scenes")
    walk(120).save(folder / "docs" / "inputs" / "poses" / "generated_000.bvh")
    shutil.copytree(folder / "docs" / "inputs" / "poses", folder / "poses")
    shutil.copy(ROOT / "docs" / "inputs" / "keys.toml", folder)
