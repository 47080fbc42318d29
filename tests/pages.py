"""The pages of README.md and docs/, the code and the commands that they show, and the files that the code names."""

import re
import shutil
from dataclasses import dataclass
from pathlib import Path

from character_maker import make_character_glb
from helpers import walk, write_corpus
from rig_maker import Make, make, names_of
from tiny_infiller import save_tiny_infiller

ROOT = Path(__file__).resolve().parents[1]
PAGES = ("README.md", *(str(page.relative_to(ROOT)) for page in sorted((ROOT / "docs").rglob("*.md"))))


@dataclass(frozen=True)
class Block:
    """Fenced lines of a page."""

    page: str
    number: int
    """Index among the blocks of its language on its page."""
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
    text = "".join(block.text for language in ("", "sh") for block in blocks(page, language)).replace("\\\n", "")
    lines = [line.split(" #")[0].strip() for line in text.splitlines()]
    return [line for line in lines if line.startswith("mapctl ")]


def inline_commands(page: str) -> list[str]:
    """Those within its sentences that are whole: with an option, and words that are no names of alternatives."""
    prose = re.sub(r"^```.*?^```", "", read_page(page), flags=re.DOTALL | re.MULTILINE)
    found = [" ".join(line.split()) for line in re.findall(r"`(mapctl [^`]+)`", prose)]
    return [line for line in found if " -" in line and "|" not in line]


def write_files(folder: Path) -> None:
    """Write all that README.md and the pages' Python name: clips, folders of clips, a character, and a small model."""
    save_tiny_infiller(folder / "infiller.safetensors", drawn=0.02)
    ours = make(Make(names_of("lafan1")))
    for name, frames in (("take", 260), ("keys", 125), ("wave", 60)):
        frozen = [*range(30), *[30] * 15, *range(45, frames)]
        ours.motion(walk(frames))._map_frames(lambda values, kept=frozen: values[kept]).save(folder / f"{name}.bvh")
    ours.motion(walk(100)).save(folder / "walk.bvh")
    walk(40).save(folder / "walk.npz")
    make_character_glb(folder / "hero.glb", animations=("Walk",))
    for seed, name in enumerate("abcd"):
        walk(150, seed=seed, cadence=0.8 + 0.05 * seed).save(folder / f"{name}.bvh")
    for name in ("takes", "clips"):
        write_corpus(folder / name, count=3 if name == "takes" else 8, frames=100)
    (folder / "drawn.csv").write_text("x,z\n" + "".join(f"{0.1 * (k % 3)},{0.5 * k}\n" for k in range(20)))
    (folder / "script.csv").write_text("time_s,speed_mps,heading_deg\n0,1.2,0\n0.5,1.0,30\n1,1.0,30\n")
    (folder / "lost.csv").write_text("joint,start,stop\nLeftHand,5,15\n")
    (folder / "poses").mkdir()
    walk(120).save(folder / "poses" / "generated_000.bvh")
    shutil.copy(ROOT / "docs" / "inputs" / "keys.toml", folder)
