"""Single-photo space resection from Mikhail, Bethel, McGlone (2001), as recomputed in the data folder's README."""

import numpy as np
import pytest

import baarda
from baarda import cameras
from baarda.cameras import FIXED
from baarda.hypotheses.outliers import tau
from baarda.network import CONTROL, Images, Network, Points
from baarda.observations import ImagePoints


@pytest.fixture(scope="module", params=["given", "none"])
def result(request, data):
    folder = data("resection_mikhail")
    numbers = [float(t) for t in (folder / "cam.inp").read_text().split()]
    rows = [line.split() for line in (folder / "resect.inp").read_text().splitlines() if line.strip()]
    labels = [r[0] for r in rows]
    table = np.array([[float(t) for t in r[1:]] for r in rows])
    camera = cameras.create("1", cameras.model("pinhole"), {"principal_distance": numbers[8]}, unit="mm", y_down=False)
    from baarda.geometry.rotation import from_angles

    start = {"position": np.array([numbers[3:6]]), "rotation": from_angles(*numbers[:3])[None]} if request.param == "given" else {}
    points = Points.make(labels, table[:, 2:], np.full(5, CONTROL), np.full((5, 3), FIXED), table[:, 2:])
    network = Network((camera,), Images.make(["1"], **start), points, (ImagePoints.make(np.zeros(5), np.arange(5), table[:, :2]),))
    return baarda.adjust(network)


def test_values(result):
    row = next(result.images.rows())
    angles = [row["omega_rad"], row["phi_rad"], row["kappa_rad"]]
    np.testing.assert_allclose(angles, [-0.006507481143624, -0.008521803654879, -1.575322123689651], atol=2e-9)
    np.testing.assert_allclose([row[k] for k in ("X0", "Y0", "Z0")], [914260.4218627542, 575441.8355519563, 839.1304372341], atol=2e-6)


def test_precision(result):
    assert (result.count, result.numbering.count, result.redundancy) == (10, 6, 4)
    assert result.objective == pytest.approx(0.0007511048789734, rel=1e-9)
    assert result.sigma0 == pytest.approx(0.01370314634, rel=1e-9)
    row = next(result.images.rows())
    np.testing.assert_allclose([row[k] for k in ("sX0", "sY0", "sZ0")], [0.14479952, 0.11868323, 0.06161825], rtol=1e-6)
    arcsec = np.degrees([row[k] for k in ("somega_rad", "sphi_rad", "skappa_rad")]) * 3600
    np.testing.assert_allclose(arcsec, [32.1308, 37.8706, 14.5102], rtol=2e-6)


def test_residuals_redundancy_and_tau(result):
    v = [0.006870, 0.010089, -0.009280, 0.005391, 0.000131, 0.000505, 0.007896, 0.003551, -0.005600, -0.019503]
    np.testing.assert_allclose(result.residuals, v, atol=6e-7)
    r = [0.3181, 0.2043, 0.7119, 0.6181, 0.2076, 0.2104, 0.2777, 0.1246, 0.6456, 0.6816]
    np.testing.assert_allclose(result.redundancy_numbers, r, atol=6e-5)
    printed = [0.889, 1.629, -0.803, 0.500, 0.021, 0.080, 1.093, 0.734, -0.509, -1.724]
    e = result.evidence
    np.testing.assert_allclose(tau(e.pv, e.pqvvp, e.variance_factor), printed, atol=6e-4)


def test_correlations(result):
    q = result.image_cofactors[0]
    r = q / np.sqrt(np.outer(np.diag(q), np.diag(q)))
    np.testing.assert_allclose([r[0, 4], r[1, 3], r[0, 2], r[2, 4]], [0.9819, -0.9718, 0.5696, 0.6142], atol=6e-5)
