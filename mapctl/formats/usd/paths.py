"""Names of joints as USD allows them: paths of letters, digits and _."""

import re

from mapctl.skeleton import Skeleton


def joint_paths(skeleton: Skeleton) -> list[str]:
    """Return each joint's USD path: the names from the root on, of letters, digits and _, unique among siblings."""
    found: list[str] = []
    for name, parent in zip(skeleton.names, skeleton.parents, strict=True):
        plain = re.sub(r"\W", "_", name, flags=re.ASCII) or "_"
        plain = f"_{plain}" if plain[0].isdigit() else plain
        above = f"{found[parent]}/" if parent >= 0 else ""
        again = (f"{plain}_{number}" for number in range(2, len(skeleton.names) + 2))
        word = plain if f"{above}{plain}" not in found else next(w for w in again if f"{above}{w}" not in found)
        found.append(above + word)
    return found
