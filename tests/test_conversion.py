"""From one program's files to another's: projections agree, half a pixel included, along every way that can be written."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import test_format_metashape
import test_format_opensfm
import test_format_opf
import test_format_pix4d
from baarda.errors import UsageError
from baarda.formats import formats, read, write
from baarda.network import State
from networks import ring
from test_cli import run


def opensfm(folder):
    test_format_opensfm.scene(folder, "brown")
    return folder


def colmap(folder):
    values = {"principal_distance": 1000.0, "principal_point_x": 505.0, "principal_point_y": 396.0, "k1": -0.05}
    network = ring(model="SIMPLE_RADIAL", values=values, free=("principal_distance", "k1"), seed=5, keep=0.8)
    write(network, folder / "source", "colmap")
    return folder / "source"


def metashape(folder):
    path, _ = test_format_metashape.psz(folder)
    return path


def opf(folder):
    return test_format_opf.scene(folder, gcps=0, checkpoints=0)


def pix4d(folder):
    test_format_pix4d.scene(folder)
    return folder


def residuals(network):
    """Misclosures of all image points by image and point, and the first pixel that the network states."""
    out = {}
    for g in network.observations:
        if hasattr(g, "images"):
            found = g.misclosures(network, State.of(network))
            out.update(
                {
                    (network.images.labels[i], network.points.labels[p]): tuple(v)
                    for i, p, v in zip(g.images, g.points, found.tolist(), strict=True)
                }
            )
    return out


def prepared(path):
    """Return a source with the cameras that other programs can hold: no skew, no r^8."""
    network = read(path)
    camera = network.cameras[0]
    if camera.model.name == "metashape":
        values = dict(zip(camera.model.order, camera.values.tolist(), strict=True)) | {"B2": 0.0, "K4": 0.0}
        camera = replace(camera, values=np.array([values[n] for n in camera.model.order]))
        network = replace(network, cameras=(camera,), observations=network.observations[:1])
    return network


@pytest.mark.parametrize("target", ["colmap", "opensfm", "project"])
@pytest.mark.parametrize("make", [opensfm, colmap, metashape, opf, pix4d])
def test_projections_agree_in_every_format(tmp_path, make, target):
    network = prepared(make(tmp_path))
    write(network, tmp_path / "out", target)
    again = read(tmp_path / "out")
    ours, theirs = residuals(network), residuals(again)
    assert len(ours) == len(theirs)
    # points may have other names: component by component
    np.testing.assert_allclose(np.sort(list(theirs.values()), axis=0), np.sort(list(ours.values()), axis=0), atol=1e-6)
    first = formats()[network.format].first_pixel
    assert again.settings["first_pixel"] == (first if target == "project" else formats()[target].first_pixel)
    shift = again.settings["first_pixel"] - first
    np.testing.assert_allclose(again.observations[0].xy.mean(axis=0), network.observations[0].xy.mean(axis=0) + shift, atol=1e-6)


def test_a_project_keeps_what_its_source_counts_from(tmp_path):
    """COLMAP to our project to OpenSfM moves by half a pixel, as COLMAP to OpenSfM does."""
    source = read(colmap(tmp_path))
    write(source, tmp_path / "own", "project")
    write(read(tmp_path / "own"), tmp_path / "a", "opensfm")
    write(source, tmp_path / "b", "opensfm")
    assert (tmp_path / "a" / "tracks.csv").read_text() == (tmp_path / "b" / "tracks.csv").read_text()
    write(read(tmp_path / "a"), tmp_path / "back", "colmap")
    np.testing.assert_allclose(read(tmp_path / "back").observations[0].xy, source.observations[0].xy, atol=1e-9)


def test_the_command_line(tmp_path):
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
    source, simple = opensfm(tmp_path / "a"), colmap(tmp_path / "b")
    for begin, target, name in (
        (source, "colmap", "c"),
        (source, "project", "p"),
        (source, "opensfm", "o"),
        (simple, "bal", "b.txt"),
        (simple, "bundler", "bundle"),
    ):
        done = run("convert", str(begin), "--to", target, "--out", str(tmp_path / name))
        assert done.returncode == 0, done.stderr
        ours, theirs = (np.sort(np.abs(list(residuals(read(p)).values())), axis=0) for p in (begin, tmp_path / name))
        np.testing.assert_allclose(theirs, ours, atol=1e-6)  # BAL and Bundler count y upwards
    refused = run("convert", str(source), "--to", "nvm", "--out", str(tmp_path / "x"))
    assert refused.returncode == 2 and "these can: " in refused.stderr


def test_adjusted_points_and_covariances_are_result_options(tmp_path):
    out = tmp_path / "out"
    source = colmap(tmp_path)
    done = run(
        "adjust", str(source), "--out", str(out), "--quiet", "--points", str(tmp_path / "p.csv"), "--covariance", str(tmp_path / "cov")
    )
    assert done.returncode == 0, done.stderr
    table = np.genfromtxt(tmp_path / "p.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    assert {"X", "sX", "corr_XY"} <= set(table.dtype.names) and len(table) == 24
    index = json.loads((tmp_path / "cov" / "index.json").read_text())
    assert index["schema"] == "baarda.covariance/1" and index["stored"] == "full"
    from scipy.io import mmread

    matrix = mmread(tmp_path / "cov" / "covariance.mtx").toarray()
    stored = np.load(tmp_path / "cov" / "covariance.npz", allow_pickle=False)["covariance"]
    np.testing.assert_array_equal(np.tril(matrix), np.tril(stored))
    names = list(np.load(tmp_path / "cov" / "covariance.npz", allow_pickle=False)["names"])
    at = names.index(f"point {table['point'][0]}: X")
    assert np.sqrt(stored[at, at]) == pytest.approx(table["sX"][0], rel=1e-9)


@pytest.mark.parametrize("key", ["half", True, 2.0])
def test_a_project_with_an_unknown_first_pixel_is_refused_on_the_way_out(tmp_path, key):
    network = read(colmap(tmp_path))
    network = replace(network, settings={"first_pixel": key})
    with pytest.raises(UsageError, match=r"first_pixel must be 0 or 0\.5"):
        write(network, tmp_path / "out", "opensfm")


def test_the_table_of_conventions_says_what_the_formats_do():
    """Every format of images has a row; its columns 'first pixel' and 'written' agree with the code."""
    text = (Path(__file__).parent.parent / "docs" / "conventions.md").read_text(encoding="utf-8")
    rows = [[c.strip() for c in re.split(r"(?<!\\)\|", line)[1:-1]] for line in text.splitlines() if line.startswith("| ")]
    said = {name.strip().lower(): row for row in rows if len(row) == 9 for name in row[0].split(",")}
    names = {"project": "our project", "nvm": "visualsfm nvm", "pix4d": "pix4d parameters"}
    for f in formats().values():
        if f.name in ("gama", "radar-csv"):  # no images
            continue
        row = said[names.get(f.name, f.name)]
        assert (row[7] == "yes") == (f.write is not None), f.name
        stated = "(0.5, 0.5)" if f.first_pixel == 0.5 else "(0, 0)"
        assert row[5].startswith(stated) if f.first_pixel is not None else not row[5].startswith("("), f.name
