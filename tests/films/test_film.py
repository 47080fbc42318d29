"""Films: every frame arrives at its time, left and right differ, and nothing is left half done."""

import logging
from fractions import Fraction

import numpy as np
import pytest
from helpers import moved
from scenes_walks import walk

from mapctl import curves
from mapctl.errors import RequestError
from mapctl.mesh import colours
from scenes import renderers
from scenes.cameras import CameraSettings
from scenes.film import film
from scenes.renderers import Painter, back_end, select_painter
from scenes.stage import Shot, Stage

av = pytest.importorskip("av")
Image = pytest.importorskip("PIL.Image")
SMALL = (96, 64)


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Films of stick figures, unless a test asks for more."""
    monkeypatch.setenv(renderers.RENDERER_VARIABLE, "stick")


def has_graphics() -> bool:
    try:
        return isinstance(select_painter("egl"), Painter)
    except renderers.NoGraphicsError:
        return False


RENDERERS = [
    pytest.param("egl", marks=pytest.mark.skipif(not has_graphics(), reason="no OpenGL without a window here")),
    "stick",
]


def read_mp4(path):
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        return frames, stream.average_rate, float(stream.duration * stream.time_base), stream.codec_context


def near(picture, colour: str, tolerance: float) -> np.ndarray:
    """Columns of the pixels whose hue is about the colour's."""
    pixels = picture.reshape(-1, 3) / 255
    chroma, wanted = (pixels - pixels.mean(axis=1, keepdims=True), colours.rgb(colour) - colours.rgb(colour).mean())
    cosine = chroma @ wanted / (np.linalg.norm(chroma, axis=1) * np.linalg.norm(wanted) + 1e-9)
    alike = (cosine > tolerance) & (np.linalg.norm(chroma, axis=1) > 0.25)
    return np.flatnonzero(alike) % picture.shape[1]


@pytest.mark.slow
@pytest.mark.parametrize("renderer", RENDERERS)
def test_an_mp4_has_every_frame_at_the_motions_rate(renderer, tmp_path, monkeypatch):
    monkeypatch.setenv(renderers.RENDERER_VARIABLE, renderer)
    motion, path = walk(18, fps=24), tmp_path / "walk.mp4"
    assert film([(motion, curves.line(length=2.0))], path, size=SMALL) == [path]
    frames, rate, seconds, codec = read_mp4(path)
    assert (len(frames), rate) == (18, Fraction(24))
    assert seconds == pytest.approx(motion.seconds)
    assert (codec.name, codec.pix_fmt, codec.width, codec.height) == ("h264", "yuv420p", *SMALL)
    assert (
        np.ptp([frame.mean() for frame in frames]) > 0
        or np.abs(np.diff(np.stack(frames).astype(int), axis=0)).max() > 20
    )


@pytest.mark.parametrize("renderer", RENDERERS)
def test_left_and_right_differ_in_their_pixels(renderer):
    stage = Stage([Shot(walk(3, speed=0.0))])
    # From the front the actor's left hand is on the right of the picture.
    view = stage.views(CameraSettings(azimuth_deg=0.0, elevation_deg=5.0), (128, 128))[0]
    picture = select_painter(renderer).paint(view, stage.content(0))
    left, right = near(picture, colours.LEFT, 0.97), near(picture, colours.RIGHT, 0.97)
    assert len(left) > 100
    assert len(right) > 100
    assert left.mean() > 64 + 8
    assert right.mean() < 64 - 8


@pytest.mark.parametrize("renderer", RENDERERS)
def test_the_curve_and_the_growing_trail_are_seen(renderer):
    stage = Stage([Shot(walk(24, speed=2.0), curves.line(length=4.0))])
    views, brush = stage.views(CameraSettings(kind="top", azimuth_deg=90.0), (400, 120)), select_painter(renderer)
    seen = [
        [len(near(brush.paint(views[k], stage.content(k)), c, 0.985)) for c in (colours.TARGET, colours.TRAIL)]
        for k in (1, 12, 23)
    ]
    target, trail = np.array(seen).T
    assert target[0] > 40
    assert trail[2] > trail[1] > trail[0]


def test_fps_resamples_and_keeps_the_duration(tmp_path):
    film([Shot(walk(13, fps=12))], tmp_path / "slow.mp4", size=SMALL, fps=6)
    frames, rate, *_ = read_mp4(tmp_path / "slow.mp4")
    assert (len(frames), rate) == (7, 6)


@pytest.mark.parametrize("ending", [".gif", ".webp"])
@pytest.mark.parametrize(("fps", "shown"), [(30, 12), (120, 4)])
def test_a_loop_keeps_the_motions_time(fps, shown, ending, tmp_path):
    path = tmp_path / f"walk{ending}"
    film([Shot(walk(12, fps=fps))], path, size=SMALL)
    with Image.open(path) as loop:
        delays = []
        for k in range(loop.n_frames):
            loop.seek(k)
            loop.load()  # without which a WebP says the delay of the picture before
            delays.append(loop.info["duration"])
        assert (loop.size, loop.n_frames, loop.info["loop"]) == (SMALL, shown, 0)
    assert sum(delays) == pytest.approx(1000 * 12 / fps, abs=10)
    assert min(delays) >= 20


@pytest.mark.parametrize("actors", [1, 2])
def test_a_contact_sheet_has_ghosts_over_a_row_of_stills(actors, tmp_path):
    shots = [Shot(moved(walk(24, speed=2.0), turn=0.0, shift=(float(k), 0.0))) for k in range(actors)]
    film(shots, tmp_path / "sheet.png", size=(192, 108))
    sheet = np.asarray(Image.open(tmp_path / "sheet.png"))
    assert sheet.shape[1] == 192
    assert sheet.shape[0] > 108 + 20
    assert len(near(sheet[:108], colours.LEFT, 0.97)) > 0
    assert len(near(sheet[110:], colours.LEFT, 0.97)) > 0


def test_a_late_actor_waits_in_its_first_pose_and_an_early_one_stays_in_its_last():
    stage = Stage([Shot(walk(6, fps=12)), Shot(walk(6, fps=12), start_seconds=0.5)])
    assert stage.num_frames == 12
    poses = [[figure.frame for figure in stage.content(k).figures] for k in range(12)]
    assert poses[3] == [3, 0]
    assert poses[8] == [5, 2]


def test_feet_that_stand_are_marked_and_others_are_not():
    still = Stage([Shot(walk(12, speed=0.0).slice(0, 1).join(walk(1)).join(walk(1)).join(walk(1)))])
    walking = Stage([Shot(walk(12, speed=3.0))])
    marked = len(still.content(2).ground) - len(walking.content(2).ground)
    assert marked == 1


@pytest.mark.parametrize(
    ("out", "size", "words"),
    [
        ("a.avi", SMALL, "allowed: .mp4, .gif, .webp, .png"),
        ("gone/a.mp4", SMALL, "does not exist"),
        ("a.mp4", (4, 4), "size"),
    ],
)
def test_impossible_outputs_are_refused_before_any_work(out, size, words, tmp_path):
    with pytest.raises(RequestError, match=words):
        film([Shot(walk(2))], tmp_path / out, size=size)
    assert list(tmp_path.iterdir()) == []


def test_a_film_that_fails_leaves_nothing_behind_and_an_older_one_alone(tmp_path):
    old = tmp_path / "old.mp4"
    old.write_bytes(b"precious")

    def stop(done: int, total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        film([Shot(walk(6))], [old, tmp_path / "new.gif"], size=SMALL, progress=stop)
    assert [path.name for path in tmp_path.iterdir()] == ["old.mp4"]
    assert old.read_bytes() == b"precious"


def test_without_opengl_there_are_stick_figures_and_a_note(monkeypatch, caplog):
    def missing():
        raise renderers.NoGraphicsError("no OpenGL without a window (libEGL.so.1 not found)")

    monkeypatch.setattr(renderers, "_open_graphics", missing)
    monkeypatch.delenv(renderers.RENDERER_VARIABLE, raising=False)
    with caplog.at_level(logging.WARNING, logger="mapctl.scenes"):
        brush = select_painter()
    assert brush.name.startswith("matplotlib")
    (record,) = caplog.records
    assert "libEGL.so.1" in record.getMessage()
    assert "\n" not in record.getMessage()
    assert "libEGL.so.1" in back_end()
    with pytest.raises(renderers.NoGraphicsError):
        select_painter("egl")
