"""Stands for mapctl in tests of the add-on: runs the words on small models and keeps the files that were exchanged.

python recorder.py FOLDER MODELS WORDS...: files go to FOLDER/COMMAND, the small models lie in MODELS (`-` for the
bundled ones).
"""

import shutil
import sys
from pathlib import Path

from mapctl import cli

TINY = {
    "follow": {"--prior": "prior"},
    "denoise": {"--denoiser": "denoiser", "--inbetweener": "infiller"},
    "infill": {"--inbetweener": "infiller"},
    "tween": {"--inbetweener": "infiller"},
}


def main(kept: Path, models: str, words: list[str]) -> int:
    """Run, then keep what is in the current folder."""
    command = words[0]
    if models != "-":
        for option, name in TINY.get(command, {}).items():
            words = [*words, option, str(Path(models) / f"{name}.safetensors")]
    status = cli.main(words)
    if not command.startswith("-"):
        shutil.copytree(".", kept / command, dirs_exist_ok=True)
        (kept / command / "words.txt").write_text("\n".join(words))
    return status


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), sys.argv[2], sys.argv[3:]))
