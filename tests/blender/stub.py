"""Stands for mapctl where its answers do not matter: python stub.py MODE FOLDER WORDS...

echo: what was sent comes back; of `follow` a random motion. old: too old. fail, crash: an error. sleep: no end.
"""

import os
import shutil
import sys
import time
from pathlib import Path

import numpy as np

FRAMES = 12


def main(mode: str, folder: Path, words: list[str]) -> int:
    """Answer in this mode."""
    if words == ["--version"]:
        print("mapctl 0.0.9" if mode == "old" else "mapctl 0.1.0")
        return 0
    if mode == "echo":
        with np.load(words[words.index("--rig") + 1] if words[0] == "follow" else words[1]) as archive:
            arrays = dict(archive)
        answer = tumble(arrays) if words[0] == "follow" else arrays
        np.savez(words[words.index("-o") + 1], **answer)
        np.savez(folder / "answer.npz", **answer)
        if words[0] == "follow":
            shutil.copy(words[1], folder / "curve.csv")
        np.savez(folder / "sent.npz", **arrays)
        (folder / "words.txt").write_text("\n".join(words))
        print("echoed")
        return 0
    print("a warning of some library\nprogress 1/4 walking", file=sys.stderr, flush=True)
    if mode == "sleep":
        (folder / "process.txt").write_text(f"{os.getpid()}\n{Path.cwd()}")
        time.sleep(100)
    print("mapctl: nobody walks here" if mode == "fail" else "Segmentation fault", file=sys.stderr)
    return 2


def tumble(arrays: dict) -> dict:
    """Some rotation of every joint, anywhere."""
    rng = np.random.default_rng(0)
    quats = 0.2 * rng.normal(size=(FRAMES, len(arrays["names"]), 4)) + (0, 0, 0, 1)
    return arrays | {
        "local_quat_xyzw": quats / np.linalg.norm(quats, axis=-1, keepdims=True),
        "root_position_world": rng.normal(size=(FRAMES, 3)),
        "moving_offsets": np.zeros((0, FRAMES, 3)),
    }


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], Path(sys.argv[2]), sys.argv[3:]))
