"""The example of OpenSfM: three photographs of Berlin, its own solution evaluated and adjusted."""

import json

import numpy as np
import pytest

import baarda
from baarda.formats import read, write
from baarda.network import CHECK, State


@pytest.fixture(scope="module")
def folder(data):
    return data("opensfm_berlin")


@pytest.fixture(scope="module")
def network(folder):
    return read(folder)


def test_counts_and_camera(network):
    assert len(network.images.labels) == 3
    assert len(network.points.labels) == 1430 + 3
    assert [len(g) for g in network.observations] == [3082, 5]
    assert any("137 of 3219 track observations" in a for a in network.assumptions)
    values = dict(zip(network.cameras[0].model.order, network.cameras[0].values, strict=True))
    assert values["principal_distance"] / 3264 == pytest.approx(0.8696658484855359, rel=1e-15)
    assert (values["k1"], values["k2"]) == (0.08851464962037196, -0.2324428377906099)


def test_residuals_of_its_solution_by_the_formula_of_its_documentation(folder, network):
    model = json.loads((folder / "reconstruction_example.json").read_text())[0]
    camera = next(iter(model["cameras"].values()))
    from scipy.spatial.transform import Rotation

    squares = []
    for line in (folder / "tracks_example.csv").read_text().splitlines()[1:]:
        shot, track, _, x, y, *_ = line.split("\t")
        if track in model["points"]:
            s = model["shots"][shot]
            p = Rotation.from_rotvec(s["rotation"]).apply(model["points"][track]["coordinates"]) + s["translation"]
            p = p[:2] / p[2]
            r2 = p @ p
            p = camera["focal"] * (1 + camera["k1"] * r2 + camera["k2"] * r2**2) * p
            squares += [*((3264 * (p - np.array([float(x), float(y)]))) ** 2)]
    state = State.of(network)
    own = network.observations[0].misclosures(network, state)
    assert np.sum(own**2) == pytest.approx(np.sum(squares), rel=1e-9)
    assert np.sqrt(np.mean(squares)) == pytest.approx(1.743, abs=5e-4)


def test_marks_of_control_lie_where_they_were_seen(network):
    state = State.of(network)
    marks = network.observations[1].selected([0, 1, 2, 3])  # the last point has one ray
    assert np.abs(marks.misclosures(network, state)).max() < 3.0
    assert network.points.labels[-3:] == ("GCP 0", "GCP 1", "GCP 3")
    assert network.points.roles[-3:].tolist() == [CHECK, 0, CHECK]
    assert any("the datum needs three" in a for a in network.assumptions)


def test_adjustment(network):
    result = baarda.adjust(network)
    assert result.status == "converged"
    assert (result.count, result.numbering.count, result.redundancy) == (6172, 4317, 1862)
    assert result.history[0].objective > 1.4 * result.objective  # its solution minimises a robust and differently weighted sum
    assert result.redundancy_numbers.sum() == pytest.approx(result.redundancy, rel=1e-9)


def test_round_trip(network, tmp_path):
    write(network, tmp_path / "out", "opensfm")
    again = read(tmp_path / "out")
    assert len(again.points.labels) == 1430 + 3
    np.testing.assert_allclose(again.images.position, network.images.position, atol=1e-9)
    np.testing.assert_allclose(again.observations[0].xy[:3082], network.observations[0].xy, atol=1e-9)
