"""Small sound files of every kind, to be broken."""

from base64 import b64encode
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from json import dumps
from pathlib import Path
from typing import Any

from acclaim import pair
from character_maker import make_character_glb
from fbx_binary import to_binary
from fbx_maker import make_fbx
from forged_characters import split_glb
from fuzz_checks import LOADERS
from helpers import random_motion
from tiny_infiller import save_tiny_infiller
from tiny_weights import save_tiny_weights
from usd_specimens import make_usd_specimens

from mapctl import formats
from mapctl.errors import RequestError
from mapctl.skeleton import CANONICAL

_ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Sample:
    """A sound file to be broken, with those that are read with it."""

    name: str
    raw: bytes
    beside: Mapping[str, bytes]
    """The other files by name."""


_CHARACTERS: tuple[dict[str, Any], ...] = (
    {"animations": ("walk",)},
    {"names": "vrm", "pose": "A", "second_skin": True, "hat": True, "interpolation": "CUBICSPLINE", "animations": "a"},
    {"names": "vrm0", "compact": True, "morphs": 1},
    {"matrices": True, "node_pose": "bent", "root": "root"},
)
_FBX: tuple[dict[str, Any], ...] = (
    {"skin": False},
    {"z_up": True, "parts": ("shoes",)},
    {"takes": ("a", "b"), "parts": ("shoes",), "scale": (2.0, 2.0, 2.0)},
)


def make_pairs(folder: Path, *, ending: str) -> Iterator[Sample]:
    """Make .asf and .amc files, each with the other beside it."""
    for seed in range(3):
        made = pair(3, seed=seed, degrees=seed != 1, missing=0.3 * (seed == 2))
        texts = {"x.asf": made.asf().encode(), "x.amc": made.amc().encode()}
        yield Sample(f"pair-{seed}{ending}", texts.pop(f"x{ending}"), texts)


def make_motions(folder: Path, *, ending: str) -> Iterator[tuple[str, bytes]]:
    """Make files of an ending of `formats.READERS`: of motions where it can be written, and of characters."""
    for number, motion in enumerate(
        (*(formats.load(pair(3, seed=k).write(folder)) for k in (0, 1)), random_motion(CANONICAL, 3))
    ):
        path = folder / f"x{ending}"
        if ending in formats.WRITERS:
            with suppress(RequestError):  # a .vrm needs a character, a .vrma bones by name
                motion.save(path)
        if path.exists():
            yield f"motion-{number}{ending}", path.read_bytes()
            path.unlink()
    if formats.READERS[ending] == "gltf":
        for number, look in enumerate(_CHARACTERS):
            made = make_character_glb(folder / "x.glb", **look, frames=5)
            yield f"character-{number}{ending}", made.path.read_bytes()
    elif ending == ".fbx" and find_spec("ufbx"):
        for number, look in enumerate(_FBX):
            make_fbx(folder / "x.fbx", **look, frames=3)
            raw = (folder / "x.fbx").read_bytes()
            yield from ((f"text-{number}.fbx", raw), (f"binary-{number}.fbx", to_binary(raw.decode())))
    elif formats.READERS[ending] == "usd":
        yield from (made for made in make_usd_specimens(folder) if made[0].endswith(ending))


def make_gltf(folder: Path) -> Iterator[tuple[str, bytes]]:
    """Make .gltf files that hold their own bytes."""
    for name, raw in make_motions(folder, ending=".glb"):
        tree, binary = split_glb(raw)
        for buffer in tree.get("buffers", ()):
            buffer["uri"] = f"data:application/octet-stream;base64,{b64encode(binary).decode()}"
        yield name, dumps(tree).encode()


def make_tables(_: Path, *, ending: str) -> Iterator[tuple[str, bytes]]:
    yield from ((f"{number}{ending}", text.encode()) for number, text in enumerate(_TABLES[ending]))


def make_copies(_: Path, *, pattern: str) -> Iterator[tuple[str, bytes]]:
    """Yield files of the project."""
    yield from ((path.name, path.read_bytes()) for path in sorted(_ROOT.glob(pattern)))


def make_models(folder: Path, *, ending: str) -> Iterator[Sample]:
    """Make weights and cards of every kind of model, each with the other beside it."""
    save_tiny_weights(folder)
    save_tiny_infiller(folder / "infiller.safetensors")
    path = {f"path{end}": (folder / f"path{end}").read_bytes() for end in (".json", ".safetensors")}
    for name in LOADERS:
        files = {f"x{end}": (folder / f"{name}{end}").read_bytes() for end in (".json", ".safetensors")}
        yield Sample(f"{name}{ending}", files.pop(f"x{ending}"), {**files, **path, "name": name.encode()})


_TABLES = {
    "steering.csv": (
        "time_s,speed_mps,heading_deg\n0,1.2,0\n2,0.5,90\n4.5,0,-90\n",
        "time_s,speed_mps,heading_deg,facing_deg,turn_deg_s,step_m,gait,style\n"
        "0,1,0,,,,walk,\n1,1,10,5,,0.6,,old\n3,2,20,,15,,run,\n",
        "time_s,speed_mps,heading_deg,goto_x_m,goto_z_m,within_s,pose,look_x,look_y,look_z\n0,1,0,1,2,3,,1,1,1\n",
    ),
    "curve.csv": (
        "x,z\n0,0\n1,0.5\n2,0.25\n3,1\n",
        "# drawn by hand\nz;y;x\n0,5;0;1\n1;0;2,5\n",
        "0 0\n1 1\n2 4\n3 9\n",
        "0\t0\t0\n1\t0\t1\n2\t0\t4\n",
    ),
    "masks.csv": (
        "joint,start,stop\nhips,0,10\nleftFoot,20,25\n*,40,50\n",
        "start,stop,joint\n3,9,root position\n10,12,head\n",
    ),
    "drawing.csv": ("joint,x,y\nhips,0,0\nhead,0,60\nleftHand,-30,10\nrightFoot,10,-80\n",),
    "cuts.csv": (
        "file,first,last\na,0,99\nb/c*,5,\nd,3,8\n",
        "STYLE_NAME,FW_START,FW_STOP,BW_START,BW_STOP\nOld,10,90,N/A,N/A\nProud,0,5,7,9\n",
    ),
    "curve.svg": (
        '<svg xmlns="http://www.w3.org/2000/svg"><path d="M0 0 L100 0 C150 0 200 50 200 100 Z"/></svg>',
        '<svg><g transform="translate(10 20) rotate(30)"><path d="M0,0 Q50,50 100,0 T200,0"/></g></svg>',
        '<svg><polyline points="0,0 10,10 20,0"/></svg>',
        '<svg><circle cx="0" cy="0" r="200" transform="scale(2)"/></svg>',
    ),
    "shot.toml": (
        'weights = "free"\n[[key]]\nseconds = 3.1\nreach = { leftHand = [0.42, 0.9, 2.6] }\ntolerance = 0.1\n'
        "[[key]]\nframe = 90\nlook_at = [-2.5, 1.5, 6.5]\nhold_seconds = 0.5\n"
        '[[key]]\nframe = 99\npose = "a.bvh"\njoints = ["leftHand"]\ntolerance = { leftHand = 0.1 }\n',
    ),
}
