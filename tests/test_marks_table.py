"""Image marks of control points from a table, beside a source that has none."""

from dataclasses import replace

import numpy as np
import pytest

import baarda
from baarda.errors import InputError
from baarda.formats import read, write
from baarda.network import CONTROL, TIE
from networks import ring
from test_cli import run


def block(folder):
    """A COLMAP model without its last six points, whose marks and surveyed coordinates go to tables."""
    values = {"principal_distance": 1000.0, "principal_point_x": 505.0, "principal_point_y": 396.0, "k1": -0.05}
    network = ring(images=8, points=30, model="SIMPLE_RADIAL", values=values, free=("principal_distance", "k1"), seed=5)
    group = network.observations[0]
    mine = group.points >= 24
    rng = np.random.default_rng(0)
    truth = np.random.default_rng(5).uniform(-2.0, 2.0, (30, 3)) * [1.0, 1.0, 0.6]
    source = replace(network, observations=(group.selected(~mine),))
    write(source, folder / "m", "colmap")
    rows = np.flatnonzero(mine)
    lines = ["image,point,x,y,sigma"]
    lines += [f"photos/I{group.images[k]},{group.points[k] - 23},{float(group.xy[k, 0])!r},{float(group.xy[k, 1])!r},0.4" for k in rows]
    (folder / "marks.csv").write_text("\n".join([*lines, "absent.jpg,1,5,5,0.4"]) + "\n")
    control = ["point,role,X,Y,Z,sigma_X,sigma_Y,sigma_Z"]
    for k in range(24, 30):
        x, y, z = (truth[k] * 50 + 0.01 * rng.standard_normal(3)).tolist()
        control.append(f"{k - 23},{'check' if k == 29 else 'control'},{x!r},{y!r},{z!r},0.01,0.01,0.01")
    (folder / "control.csv").write_text("\n".join(control) + "\n")
    return folder


def test_marks_and_control_from_tables(tmp_path):
    block(tmp_path)
    marked = read(tmp_path / "m", marks=tmp_path / "marks.csv")
    group = marked.observations[1]
    assert len(group) == 48 and (group.sigmas == 0.4).all()
    assert marked.points.labels[-6:] == tuple(f"GCP {k}" for k in range(1, 7))  # COLMAP numbers its points, too
    assert (marked.points.roles == TIE).all() and np.isfinite(marked.points.coordinates[-6:]).all()
    assert any("absent.jpg" in a for a in marked.assumptions)
    network = read(tmp_path / "m", marks=tmp_path / "marks.csv", control=tmp_path / "control.csv")
    assert (network.points.roles[-6:] > 0).all() and (network.points.roles[:-6] == TIE).all()
    assert (network.points.roles == CONTROL).sum() == 5 and network.unit == "m"
    result = baarda.adjust(network)
    assert result.status == "converged" and result.datum.defect.count == 0 and 0.2 < result.sigma0 < 1.2


def test_the_command_line(tmp_path):
    block(tmp_path)
    tables = ("--marks", str(tmp_path / "marks.csv"), "--control", str(tmp_path / "control.csv"))
    done = run("convert", str(tmp_path / "m"), *tables, "--to", "project", "--out", str(tmp_path / "own"))
    assert done.returncode == 0, done.stderr
    assert (read(tmp_path / "own").points.roles == CONTROL).sum() == 5


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (",0.4\n", ",0\n", "must be positive"),
        (",0.4\n", ",-1\n", "must not be negative"),
        ("image,point", "image,pt", "point"),
        ("photos/I1,1,", "photos/I0,1,", "measured twice"),
        ("photos/I0,1,", "photos/I0,1,9e99,", "fields|columns"),
    ],
)
def test_damaged_tables_are_refused_with_the_line(tmp_path, old, new, words):
    path = block(tmp_path) / "marks.csv"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=words) as caught:
        read(tmp_path / "m", marks=path)
    assert caught.value.file == str(path) and caught.value.line >= 1
