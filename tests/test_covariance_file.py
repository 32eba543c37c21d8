"""Covariances and points as files: what is written is what the adjustment holds, and the files say what they are."""

import csv
import json

import numpy as np
import pytest
from scipy.io import mmread

import baarda
from baarda.errors import OutputError, UsageError
from baarda.formats.covariance_file import write_covariance
from baarda.geometry.tangent_frame import TangentFrame, geocentric
from networks import ring


@pytest.fixture(scope="module")
def result():
    return baarda.adjust(ring(control=4))


def index(folder):
    with (folder / "index.csv").open(newline="") as f:
        return list(csv.DictReader(f))


def test_full_matrix(result, tmp_path):
    baarda.write_covariance(result, tmp_path / "c")
    about = json.loads((tmp_path / "c" / "index.json").read_text())
    assert about["stored"] == "full"
    assert about["variance_factor"] == {"which": "aposteriori", "value": pytest.approx(result.variance_factor)}
    data = np.load(tmp_path / "c" / "covariance.npz", allow_pickle=False)
    expected = result.covariance(list(result.numbering.names))
    np.testing.assert_allclose(data["covariance"], expected, rtol=1e-9, atol=1e-18)
    np.testing.assert_array_equal(mmread(tmp_path / "c" / "covariance.mtx").toarray(), data["covariance"])
    rows = index(tmp_path / "c")
    assert [r["name"] for r in rows] == data["names"].tolist()
    np.testing.assert_allclose([float(r["sigma"]) for r in rows], np.sqrt(np.diag(expected)), rtol=1e-9)
    turned = [r for r in rows if r["parameter"].startswith("rotation_")]
    assert len(turned) == 18
    assert {r["value"] for r in turned} == {""}
    known = dict(zip(result.unknowns["name"], result.unknowns["value"], strict=True))
    assert all(float(r["value"]) == known[r["name"]] for r in rows if r["value"])


def test_blocks_of_nodes(result, tmp_path):
    write_covariance(result, tmp_path / "c", blocks="nodes", sigma="apriori")
    data = np.load(tmp_path / "c" / "covariance.npz", allow_pickle=False)
    names = list(result.numbering.names)
    expected = result.covariance(names, sigma="apriori")
    np.testing.assert_allclose(data["value"], expected[data["row"], data["column"]], rtol=1e-8, atol=1e-18)
    assert (data["row"] >= data["column"]).all()
    cameras, images, points = 4, 6, 24
    assert len(data["value"]) == cameras * 5 // 2 + images * 21 + points * 6
    stored = mmread(tmp_path / "c" / "covariance.mtx").toarray()
    np.testing.assert_array_equal(np.diag(stored), data["value"][data["row"] == data["column"]])


def test_an_earlier_covariance_is_replaced_and_nothing_else(result, tmp_path):
    write_covariance(result, tmp_path / "c", blocks="nodes")
    write_covariance(result, tmp_path / "c")
    (tmp_path / "d").mkdir()
    (tmp_path / "d" / "mine.txt").write_text("x")
    with pytest.raises(OutputError, match="not an empty folder"):
        write_covariance(result, tmp_path / "d")
    with pytest.raises(UsageError, match="blocks is auto"):
        write_covariance(result, tmp_path / "e", blocks="some")


def test_points_as_csv(result, tmp_path):
    baarda.write_points(result, tmp_path / "p.csv")
    with (tmp_path / "p.csv").open(newline="") as f:
        rows = list(csv.DictReader(f))
    np.testing.assert_array_equal([float(r["sZ"]) for r in rows], result.points["sZ"])
    with pytest.raises(OutputError, match="exists"):
        baarda.write_points(result, tmp_path / "p.csv")
    with pytest.raises(UsageError, match=r"\.csv or \.geojson"):
        baarda.write_points(result, tmp_path / "p.shp")
    with pytest.raises(UsageError, match="where on the earth"):
        baarda.write_points(result, tmp_path / "p.geojson")


def test_points_as_geojson(tmp_path):
    from dataclasses import replace

    place = (47.0, 8.5, 400.0)
    result = baarda.adjust(replace(ring(control=4), settings={"reference_lla": place}))
    baarda.write_points(result, tmp_path / "p.geojson")
    root = json.loads((tmp_path / "p.geojson").read_text())
    lon, lat, h = np.array([f["geometry"]["coordinates"] for f in root["features"]]).T
    back = TangentFrame(*place).local(np.stack([lat, lon, h], axis=1))
    np.testing.assert_allclose(back, result.network.points.coordinates, atol=2e-5)
    np.testing.assert_allclose([f["properties"]["sigma_up"] for f in root["features"]], result.points["sZ"])


def test_the_tangent_frame_and_back():
    lla = np.array([[-89.9, 10.0, -50.0], [0.0, -179.0, 9000.0], [52.5, 13.4, 35.0], [90.0, 0.0, 1.0]])
    frame = TangentFrame(52.0, 13.0, 40.0)
    back = frame.geographic(frame.local(lla))
    np.testing.assert_allclose(geocentric(back), geocentric(lla), atol=1e-7)
