"""Curves in files: tables and drawings as people write them, and files that hold no curve."""

import math

import numpy as np
import pytest
import torch

from mapctl import curves
from mapctl.errors import FileFormatError


def write(folder, name, text):
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


@pytest.mark.parametrize(
    "text",
    [
        "x,z\n0,0\n1,2\n3,1\n",
        "0,0\n1,2\n3,1",
        "\ufeffX;Z\r\n0;0\r\n1,0;2,0\r\n3;1\r\n",
        "z\tx\n0\t0\n2\t1\n1\t3\n",
        "# drawn by hand\n\nx, z\n 0, 0\n1e0 ,2.  # here\n\n3,1\n",
        "0 0\n1   2\n3 1\n",
        '"x","z"\n"0","0"\n1,2\n3,1\n',
    ],
)
def test_csv_tables_are_read(tmp_path, text):
    curve = curves.read(write(tmp_path, "drawn.csv", text))
    expected = curves.from_points(np.array([[0.0, 0.0], [1.0, 2.0], [3.0, 1.0]]))
    torch.testing.assert_close(curve.points, expected.points)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("x,z\n0,0\n1,nan\n", 3),
        ("0,0\n1,2,3\n", 2),
        ("x,z\n0,0\n\n1,two\n", 4),
        ("x,z\n0,0\n1e300,1\n", 3),
        ("t,x,z,q\n", 1),
        ("0,0\n1,\n", 2),
    ],
)
def test_a_bad_csv_line_is_named(tmp_path, text, line):
    path = write(tmp_path, "bad.csv", text)
    with pytest.raises(FileFormatError) as error:
        curves.read(path)
    assert error.value.line == line
    assert str(error.value).startswith(f"{path}, line {line}: ")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.csv", ""),
        ("a.csv", "x,z\n1,1\n1,1\n"),
        ("a.csv", b"\x00\xff\x93"),
        ("a.svg", "<svg"),
        ("a.svg", "<svg><path d='M 0 0'/></svg>"),
        ("a.svg", "<svg><path d='M0,0 L5,5 Q nonsense'/></svg>"),
        ("a.svg", "<svg><path d='M0,0 L1e300,0'/></svg>"),
        ("a.svg", "<svg><path d='M0,0 Lnan,9'/></svg>"),
        ("a.svg", "<svg>" + "<g>" * 3000 + "</g>" * 3000 + "</svg>"),
    ],
)
def test_files_that_hold_no_curve_are_refused_in_one_line(tmp_path, name, content):
    path = write(tmp_path, name, content)
    with pytest.raises(FileFormatError) as error:
        curves.read(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("drawing", "length", "closed"),
    [
        ("<path d='M100,0 L100,300 L500,300'/>", 7.0, False),
        ("<path d='M0,0 h100 v100 h-100 z'/>", 4.0, True),
        ("<circle cx='50' cy='50' r='100'/>", 2 * math.pi, True),
        ("<path d='M-100,0 A100,100 0 0 1 100,0'/>", math.pi, False),
        ("<g transform='scale(2)'><path d='M0,0 L100,0' transform='translate(7,9)'/></g>", 2.0, False),
        ("<polyline points='0,0 100,0 100,100'/>", 2.0, False),
        ("<path d='M0,0 L100,0'/><path d='M100,0 L100,100'/>", 2.0, False),
        ("<rect x='0' y='0' width='900' height='900'/><path d='M0,0 L100,0'/>", 1.0, False),
    ],
)
@pytest.mark.parametrize("xmlns", ["", " xmlns='http://www.w3.org/2000/svg'"])
def test_svg_drawings_are_read(tmp_path, drawing, length, closed, xmlns):
    curve = curves.read(write(tmp_path, "drawn.svg", f"<svg{xmlns}>{drawing}</svg>"))
    assert curve.length == pytest.approx(length, rel=1e-4)
    assert curve.closed is closed


def test_an_svg_page_is_the_ground_seen_from_above(tmp_path):
    path = write(tmp_path, "drawn.svg", "<svg><path d='M10,20 C 10,60 50,60 50,120'/></svg>")
    curve = curves.read(path, metres_per_unit=0.1)
    torch.testing.assert_close(curve.points[[0, -1]], torch.tensor([[1.0, 2.0], [5.0, 12.0]], dtype=torch.float64))
    t = 0.3  # Bernstein form of the drawn Bezier curve
    weights = np.array([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3])
    on_it = torch.tensor(weights @ np.array([[1, 2], [1, 6], [5, 6], [5, 12]]), dtype=torch.float64)
    assert float((curve.point(curve.nearest(on_it)) - on_it).norm()) < 1e-4
    assert curve.start_heading == pytest.approx(0, abs=0.05)


# As Inkscape writes it: layers are groups with transforms, names are labels, clip paths and the like are in <defs>.
INKSCAPE = """<?xml version="1.0" encoding="UTF-8" standalone="no"?>
<svg width="210mm" height="297mm" viewBox="0 0 210 297" version="1.1" id="svg5" inkscape:version="1.2.2"
   xmlns:inkscape="http://www.inkscape.org/namespaces/inkscape" xmlns="http://www.w3.org/2000/svg"
   xmlns:sodipodi="http://sodipodi.sourceforge.net/DTD/sodipodi-0.dtd">
  <sodipodi:namedview id="namedview7" pagecolor="#ffffff" inkscape:document-units="mm" />
  <defs id="defs2"><clipPath id="clip9"><path id="path9" d="M 0,0 H 9" /></clipPath></defs>
  <g inkscape:label="Layer 1" inkscape:groupmode="layer" id="layer1" transform="translate(10,20)">
    <path style="fill:none;stroke:#000000" d="m 0,0 c 0,100 100,100 100,200" id="path234" inkscape:label="walk" />
    <g id="g12" transform="scale(2)"><path d="M 0,0 V 100" id="path345" inkscape:label="2"/></g>
  </g>
  <g inkscape:groupmode="layer" id="layer2" transform="rotate(90)"><path d="m 100,0 h 300" id="run" /></g>
</svg>"""


@pytest.mark.parametrize(
    ("name", "ends"),
    [
        ("walk", [[0.1, 0.2], [1.1, 2.2]]),
        ("path234", [[0.1, 0.2], [1.1, 2.2]]),
        ("1", [[0.1, 0.2], [1.1, 2.2]]),
        ("2", [[0.1, 0.2], [0.1, 2.2]]),  # a label before a number
        ("run", [[0, 1], [0, 4]]),
        ("3", [[0, 1], [0, 4]]),
    ],
)
def test_one_path_of_an_inkscape_drawing_is_named_by_id_label_or_number(tmp_path, name, ends):
    write(tmp_path, "drawing.svg", INKSCAPE)
    curve = curves.read(f"drawing.svg#{name}", folder=tmp_path)
    torch.testing.assert_close(curve.points[[0, -1]], torch.tensor(ends, dtype=torch.float64))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("", "holds paths that do not touch (2.24 m apart); join them, or add one of them to the file's name: "),
        ("#4", "holds no path '4'; choose one: "),
        ("#", "holds no path ''; choose one: "),
        ("#path9", "holds no path 'path9'; choose one: "),
    ],
)
def test_a_drawing_of_several_paths_names_what_to_choose_from(tmp_path, name, message):
    path = write(tmp_path, "drawing.svg", INKSCAPE)
    with pytest.raises(FileFormatError) as error:
        curves.read(f"{path}{name}")
    assert str(error.value) == f"{path}: {message}#path234 (walk), #path345 (2), #run"


def test_paths_without_names_are_numbered_in_the_order_of_the_drawing(tmp_path):
    layers = ("<path d='M0,0 H100'/>", "<path d=''/>", "<path d='M0,100 H200'/><path d='M9,9 H309 M0,0 H1'/>")
    path = write(tmp_path, "three.svg", f"<svg>{''.join(f'<g>{paths}</g>' for paths in layers)}</svg>")
    with pytest.raises(FileFormatError, match=r"name: #1, #2, #3$"):
        curves.read(path)
    assert [round(curves.read(f"{path}#{number}").length) for number in (1, 2)] == [1, 2]
    with pytest.raises(FileFormatError, match=r"do not touch \(3\.09 m apart\); join them$"):
        curves.read(f"{path}#3")
