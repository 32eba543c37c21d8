"""DBAT's camera calibration: eight variants against DBAT's reports, model 3 against an independent recomputation.

For its largest residuals the reference README names images one too high ("image 20 point 8"); in the script's own numbers they are 19, 5
and 11, as in DBAT's `top_residuals.txt`. Its y residuals count upwards, ours along the source's axis (downwards): the sign of y differs.
"""

import re
import shutil
from dataclasses import replace

import numpy as np
import pytest

import baarda
from baarda.errors import DatumDefect, Singular
from baarda.formats import read
from baarda.hypotheses.outliers import tau
from networks import control_table


@pytest.fixture(scope="session")
def script(camcal, tmp_path_factory):
    """A function that writes the script with another lens distortion model."""

    def make(model):
        folder = tmp_path_factory.mktemp(f"model{model}")
        shutil.copytree(camcal.parent, folder, dirs_exist_ok=True)
        text = camcal.read_text(encoding="utf-8")
        path = folder / "camcaldemo.xml"
        path.write_text(re.sub(r"<model>3</model>", f"<model>{model}</model>", text), encoding="utf-8")
        return path

    return make


@pytest.fixture(scope="module")
def model3(camcal):
    return baarda.adjust(read(camcal))


def to_printed(value, digits):
    return float(f"{value:.{digits}g}")


@pytest.mark.parametrize(
    ("model", "u", "r", "sigma0"),
    [
        ("1", 422, 3726, 1.68901),
        ("2", 422, 3726, 1.68901),
        ("3", 423, 3725, 1.6148),
        ("-1", 422, 3726, 1.62168),
        ("4", 423, 3725, 1.61247),
        ("5", 423, 3725, 1.6148),
    ],
)
def test_script_variants(script, model, u, r, sigma0):
    # DBAT estimates no affinity with model -1; ours has it and keeps it fixed
    camera = ("principal_distance", "principal_point_x", "principal_point_y", "K1", "K2", "K3", "P1", "P2")
    result = baarda.adjust(read(script(model)), camera=camera if model == "-1" else None)
    assert result.status == "converged"
    assert (result.count, result.numbering.count, result.redundancy) == (4148, u, r)
    assert to_printed(result.sigma0, 6) == pytest.approx(sigma0, abs=0 if len(str(sigma0)) > 6 else 5e-5)


def test_five_photographs(data, controlled):
    folder = data("dbat_camcal")
    network = read(folder / "pm" / "camcal-pmexport5.txt", control=controlled("camcal-fixed.txt"))
    result = baarda.adjust(network, camera=NINE)
    assert (result.count, result.numbering.count, result.redundancy) == (100, 57, 43)
    assert to_printed(result.sigma0, 6) == 2.80749


@pytest.mark.parametrize(("kind", "n", "u", "sigma0"), [("fixed", 4148, 414, 1.78095), ("weighted", 4160, 426, 1.60984)])
def test_prague(data, controlled, kind, n, u, sigma0):
    folder = data("dbat_camcal")
    control = controlled(f"prague-ctrlpts-{kind}.txt")
    result = baarda.adjust(read(folder / "pm" / f"prague-{kind}-pmexport.txt", control=control))
    assert (result.count, result.numbering.count, result.redundancy) == (n, u, 3734)
    assert to_printed(result.sigma0, 6) == sigma0


NINE = ("principal_distance", "principal_point_x", "principal_point_y", "K1", "K2", "K3", "P1", "P2", "B1")


@pytest.fixture
def controlled(data, tmp_path):
    """A function from the name of one of DBAT's control tables to a table of ours."""
    return lambda name: control_table(data("dbat_camcal") / "reference" / name, tmp_path / "control.csv")


def test_without_control_the_datum_is_missing(data):
    network = read(data("dbat_camcal") / "pm" / "camcal-pmexport.txt")
    with pytest.raises(DatumDefect, match="datum defect 7"):
        baarda.adjust(network, camera=NINE)
    assert baarda.adjust(network, camera=NINE, datum="inner").redundancy == 4148 - (126 + 300 + 9) + 7


def test_missing_marks_are_named(data, controlled):
    folder = data("dbat_camcal")
    network = read(folder / "pm" / "camcal-pmexport-missing-obs.txt", control=controlled("camcal-fixed.txt"))
    with pytest.raises(Singular) as caught:
        baarda.adjust(network, camera=NINE)
    # DBAT names the same six coordinates: points 13 and 60 (its numbers 12 and 59)
    assert set(caught.value.names) >= {f"point {p}: {a}" for p in missing_points(network) for a in "XYZ"}


def missing_points(network):
    group = network.observations[0]
    rays = np.bincount(group.points, minlength=len(network.points.labels))
    return [network.points.labels[i] for i in np.flatnonzero(rays < 2)]


def test_model_3_to_every_printed_digit(model3):
    assert model3.sigma0 == pytest.approx(1.61480435, abs=5e-9)
    assert model3.objective == pytest.approx(9713.28424, abs=5e-6)
    printed = {
        "principal_distance": (7.4569953411, 0.0010458272, 5e-11),
        "principal_point_x": (3.6154624127, 8.204913e-4, 5e-11),
        "principal_point_y": (2.6132927582, 9.795632e-4, 1e-10),  # 2.61329275828 at full convergence: the last printed digit is one low
        "K1": (4.5886067e-3, 2.210796e-5, 5e-11),
        "K2": (-4.513511e-5, 2.646258e-6, 5e-12),
        "K3": (-2.0525333e-6, 1.005935e-7, 5e-14),
        "P1": (-6.128034e-5, 3.520690e-6, 5e-12),
        "P2": (-4.411716e-5, 3.941014e-6, 5e-12),
        "B1": (3.8959753e-4, 2.077641e-5, 5e-12),
    }
    table = {row["name"]: row for row in model3.unknowns.rows() if row["group"] == "camera"}
    assert len(table) == 9
    for name, (value, sigma, half) in printed.items():
        row = table[f"camera 1: {name}"]
        assert row["value"] == pytest.approx(value, abs=half), name
        assert row["sigma"] == pytest.approx(sigma, rel=5e-7), name


def test_model_3_correlations(model3):
    def corr(a, b):
        c = model3.covariance([f"camera 1: {a}", f"camera 1: {b}"])
        return c[0, 1] / np.sqrt(c[0, 0] * c[1, 1])

    f, px, py = "principal_distance", "principal_point_x", "principal_point_y"
    printed = {(f, px): 0.2188, (f, py): -0.3843, (f, "K1"): 0.5845, (px, "P1"): -0.7154, (py, "P2"): 0.5037}
    printed |= {("K1", "K2"): -0.9327, ("K1", "K3"): 0.8666, ("K2", "K3"): -0.9786}
    for pair, value in printed.items():
        assert abs(corr(*pair)) == pytest.approx(abs(value), abs=6e-5), pair  # py counts downwards here as there


def test_model_3_redundancy_and_tau(model3):
    r = model3.redundancy_numbers
    assert r.sum() == pytest.approx(3725, rel=1e-9)
    assert r.min() == pytest.approx(0.6699, abs=5e-5)
    assert r.mean() == pytest.approx(0.8980, abs=5e-5)
    e = model3.evidence
    t = tau(e.pv, e.pqvvp, e.variance_factor)
    o = model3.observations
    order = np.argsort(-np.abs(t))
    found = [(o["image"][i], o["point"][i], o["component"][i], round(abs(float(t[i])), 2)) for i in order[:3]]
    assert found == [("19", "8", "x", 5.86), ("5", "1003", "y", 5.69), ("11", "1002", "y", 5.30)]
    assert r[order[0]] == pytest.approx(0.8387, abs=5e-5)
    assert model3.residuals[order[0]] == pytest.approx(-0.8667, abs=5e-5)
    assert int((np.abs(t) > 3.29).sum()) == 45


def test_model_3_residual_kurtosis(model3):
    v = model3.residuals * np.tile([1.0, -1.0], 2074)  # upwards, as the reference counts y
    z = v - v.mean()
    assert (z**4).mean() / (z**2).mean() ** 2 - 3 == pytest.approx(3.02, abs=0.005)
    assert (z**3).mean() / (z**2).mean() ** 1.5 == pytest.approx(-0.22, abs=0.005)


def test_model_3_exterior_orientation(model3, data):
    """DBAT's stations: angles in radians (its header says degrees), sigmas of positions multiplied by 180/pi (a slip of its output)."""
    printed = np.loadtxt(data("dbat_camcal") / "ref" / "camera_stations.txt", delimiter=",", usecols=range(2, 13))
    t = model3.images
    ours = np.stack([t[k] for k in ("X0", "Y0", "Z0", "omega_rad", "phi_rad", "kappa_rad")], axis=1)
    difference = ours - printed[:, :6]
    difference[:, 3:] = np.remainder(difference[:, 3:] + np.pi, 2 * np.pi) - np.pi
    assert np.abs(difference).max() < 2e-7  # DBAT stops at a relative step of 1e-6
    sigmas = np.stack([t[k] for k in ("sX0", "sY0", "sZ0", "somega_rad", "sphi_rad")], axis=1)
    np.testing.assert_allclose(np.degrees(sigmas), printed[:, 6:11], rtol=1e-4)


def test_nested_models(camcal):
    """F tests of nested lens models: the decrease of v'Pv per parameter over s0^2 of the larger model."""
    network = read(camcal)
    base = ["principal_distance", "principal_point_x", "principal_point_y"]
    steps = [
        ([], 3731, 870800.2687, 15.277302, None),
        (["K1"], 3730, 98316.3987, 5.134032, 29307.06),
        (["K2"], 3729, 12793.8403, 1.852270, 24927.12),
        (["K3"], 3728, 11585.4273, 1.762861, 388.85),
        (["P1", "P2"], 3726, 10629.3339, 1.689008, 167.57),
        (["B1"], 3725, 9713.2842, 1.614804, 351.30),
    ]
    before = None
    for more, r, vpv, s0, f in steps:
        base = base + more
        result = baarda.adjust(network, camera=tuple(base))
        assert result.redundancy == r
        assert result.objective == pytest.approx(vpv, abs=6e-5 * max(1, vpv / 1e5))
        assert result.sigma0 == pytest.approx(s0, abs=5e-7)
        if f is not None:
            assert (before - result.objective) / len(more) / result.variance_factor == pytest.approx(f, abs=0.005)
        before = result.objective


def test_the_start_does_not_matter(camcal, model3):
    moved = replace(model3.network, assumptions=())
    assert baarda.adjust(moved).objective == pytest.approx(model3.objective, rel=1e-12)
