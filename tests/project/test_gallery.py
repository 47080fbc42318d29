"""Scripts of the example gallery: short, on public packages, and one for each subject. The site's build runs them."""

import ast
import sys
from importlib import import_module

import pytest
from public_names import PUBLIC
from source_files import ROOT

FOLDER = ROOT / "docs" / "gallery"
SCRIPTS = sorted(FOLDER.glob("*.py"))
MOST_LINES = 40
PACKAGES = {"mapctl", "priors", "controllers", "scenes"}
OTHERS = {"torch", "numpy", "matplotlib"} | set(sys.stdlib_module_names)
SUBJECTS = {
    "follow_a_curve": "controllers.follow(",
    "direct_a_shot": "solve_shot(",
    "steer_from_a_loop": "drive(",
    "clean_a_noisy_clip": "controllers.denoise(",
    "fill_a_gap": "controllers.infill(",
    "tween_keys_seconds_apart": "load_tweener(",
    "vary_a_transition": "load_stitcher(",
    "move_a_character": "retarget_motion(",
    "add_a_term": "terms=",
    "add_a_density": "MarkovGaussian",
    "search_with_a_swarm": "SwarmProposal",
    "plot_training_curves": ".card",
}
"""What the script of each subject must at least use, by its name."""

each_script = pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)


@each_script
def test_a_script_is_short_and_compiles(script):
    text = script.read_text("utf-8")
    assert len(text.splitlines()) <= MOST_LINES
    compile(text, str(script), "exec")


@each_script
def test_a_script_begins_with_a_title_and_says_what_it_shows(script):
    docstring = ast.get_docstring(ast.parse(script.read_text("utf-8")))
    assert docstring
    title, rule, empty, *text = docstring.splitlines()
    assert rule == "=" * len(title)
    assert not empty
    assert text


@each_script
def test_a_script_imports_what_anybody_may(script):
    nodes = [node for node in ast.walk(ast.parse(script.read_text("utf-8"))) if isinstance(node, ast.stmt)]
    taken = [(node.module, each.name) for node in nodes if isinstance(node, ast.ImportFrom) for each in node.names]
    whole = [each.name for node in nodes if isinstance(node, ast.Import) for each in node.names]
    assert {name.partition(".")[0] for name in [*whole, *(module for module, _ in taken)]} <= PACKAGES | OTHERS
    own = [(module, name) for module, name in taken if module.partition(".")[0] in PACKAGES]
    assert [f"{module}.{name}" for module, name in own if name not in PUBLIC.get(module, ())] == []


@pytest.mark.parametrize(("name", "used"), SUBJECTS.items(), ids=SUBJECTS)
def test_every_subject_has_its_script(name, used):
    assert used in (FOLDER / f"{name}.py").read_text("utf-8")


@pytest.fixture
def extension(monkeypatch):
    """The module that the site's configuration names."""
    pytest.importorskip("sphinx_gallery")
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "extensions"))
    return import_module("example_gallery")


def test_pages_are_in_the_order_of_a_reader(extension):
    assert sorted(extension.ORDER) == [script.stem for script in SCRIPTS]
    assert sorted([script.name for script in SCRIPTS], key=extension.ReadingOrder("gallery"))[0] == "follow_a_curve.py"


def test_pictures_go_to_the_page_and_nothing_is_left_in_the_folder(extension, tmp_path):
    image = pytest.importorskip("PIL.Image")
    folder, made = tmp_path / "gallery", tmp_path / "made"
    folder.mkdir()
    made.mkdir()
    for name in ("script.py", "notes.txt", "mine.png"):
        (folder / name).write_text("here before")
    settings = {"src_dir": str(tmp_path), "examples_dirs": "gallery"}
    extension.tidy_up(settings, "script.py", when="before")
    frames = [image.new("RGB", (8, 8), shade) for shade in ("black", "red", "white")]
    frames[0].save(folder / "a-walk.webp", save_all=True, append_images=frames[1:], lossless=True)
    frames[2].save(folder / "stills-of-it.png")
    (folder / "walk.bvh").write_text("HIERARCHY")
    numbered = iter([str(made / "1.png"), str(made / "2.png")])
    told = {"src_file": str(folder / "script.py"), "image_path_iterator": numbered}
    page = extension.show_pictures(None, told, settings)
    assert page.index("/made/1.webp\n   :alt: a walk\n") < page.index("/made/2.png\n   :alt: stills of it\n")
    assert {path.name for path in made.iterdir()} == {"1.webp", "1.png", "2.png"}
    assert extension.show_pictures(None, told, settings) == "", "each is shown once"
    extension.tidy_up(settings, "script.py", when="after")
    assert {path.name for path in folder.iterdir()} == {"script.py", "notes.txt", "mine.png"}
