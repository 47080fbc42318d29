"""Known rigs, one TOML each: which of their joints is which canonical one, and how they stand in a T-pose."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files

from mapctl.errors import RequestError
from mapctl.skeleton import CANONICAL, Skeleton


@dataclass(frozen=True)
class Rig:
    """What is known of a rig before a file of it is opened."""

    name: str
    """How users call it."""
    joints: Mapping[str, str]
    """Canonical joint name to the rig's own."""
    tpose: Mapping[str, Mapping[str, list[float]]] = field(default_factory=dict)
    """Canonical joint name to where the joint's local x and y axes point in the T-pose; the zero pose if absent."""
    straighten: tuple[str, ...] = ()
    """Canonical joints whose bone is turned to its canonical direction in the T-pose."""
    end_sites: tuple[str, ...] = ()
    """Canonical joints that the rig has only as the End Site of their canonical parent."""

    def fits(self, skeleton: Skeleton) -> bool:
        """Whether the skeleton has every joint that the rig names."""
        return set(self.joints.values()) <= set(skeleton.names)


@cache
def known() -> tuple[Rig, ...]:
    """Every rig in this folder, the canonical one first."""
    canonical = Rig("canonical", {name: name for name in CANONICAL.names})
    paths = sorted((p for p in files(__name__).iterdir() if p.name.endswith(".toml")), key=lambda p: p.name)
    return canonical, *(_read(path.read_text("utf-8")) for path in paths)


def recognise(skeleton: Skeleton) -> Rig:
    """The known rig that the skeleton's names fit; RequestError tells what is known if none does."""
    for rig in known():
        if rig.fits(skeleton):
            return rig
    some = ", ".join(skeleton.names[:6])
    names = ", ".join(rig.name for rig in known())
    raise RequestError(f"no known rig has the joints {some}, ...; known rigs: {names}")


def _read(text: str) -> Rig:
    table = tomllib.loads(text)
    return Rig(table["name"], table["joints"], table.get("tpose", {}),
               tuple(table.get("straighten", ())), tuple(table.get("end_sites", ())))  # fmt: skip
