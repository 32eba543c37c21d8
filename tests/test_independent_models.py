"""Independent models: the chain to the bundle, refinement, strip polynomials, and the block adjustment by similarity transformations."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

import baarda
from baarda import adjust
from baarda.cameras import FIXED, FREE
from baarda.errors import Singular, UsageError
from baarda.formats.project import project
from baarda.geometry import refinement
from baarda.geometry import rotation as rot
from baarda.geometry.strip_polynomial import adjust_polynomials, connect_models
from baarda.network import CONTROL, TIE, Images, Network, Points, State
from baarda.observations import ImagePoints, ModelCoordinates, models
from baarda.procedures.independent_models import (
    Model,
    adjust_chain,
    block_of_models,
    bundle_of_models,
    simulate_strip,
)
from baarda.procedures.testing import analyse

# ---- refinement -----------------------------------------------------------------------------------------------------------------------


def grid(half=110.0, side=7):
    g = np.linspace(-half, half, side)
    return np.array([(x, y) for y in g for x in g])


MARKS = [[-106, -106], [106, -106], [106, 106], [-106, 106]]
SHRUNK = [[-106.1, -106], [106, -105.8], [106.2, 106], [-106, 106.1]]


def inverse(correct, xy):
    """Image coordinates that `correct` brings to xy, by Newton steps with numerical partials."""
    out = xy.copy()
    for _ in range(50):
        step = xy - correct(out)
        out += step
        if np.abs(step).max() < 1e-13:
            return out
    raise AssertionError


@pytest.mark.parametrize(
    "correct",
    [
        lambda xy: refinement.correct_radial(xy, [1e-7, -3e-12, 1e-17]),
        lambda xy: refinement.correct_decentring(xy, 2e-6, -1e-6, 1e-6),
        lambda xy: refinement.correct_refraction(xy, 152.4, 6000.0, 300.0),
        lambda xy: refinement.correct_earth_curvature(xy, 152.4, 6000.0),
        refinement.film_deformation(SHRUNK, MARKS).correct,
    ],
    ids=["radial", "decentring", "refraction", "curvature", "film"],
)
def test_corrections_undo_their_effect(correct):
    """Coordinates displaced by the inverse of a correction come back; the correction itself is not nothing."""
    xy = grid()
    measured = inverse(correct, xy)
    assert np.abs(measured - xy).max() > 1e-3
    assert correct(measured) == pytest.approx(xy, abs=1e-11)


def test_radial_and_decentring_are_those_of_brown():
    """The camera model `brown` corrects by the same formulas."""
    from baarda import cameras
    from baarda.cameras import Optics

    values = {"principal_distance": 152.4, "K1": 1e-7, "K2": -3e-12, "K3": 1e-17, "P1": 2e-6, "P2": -1e-6}
    camera = cameras.create("1", cameras.model("brown"), values, unit="mm", y_down=False)
    xy = grid()
    ideal, valid = Optics.of(camera).correct(xy, camera.values[None])
    assert valid.all()
    corrections = refinement.correct_radial(xy, [1e-7, -3e-12, 1e-17]) + refinement.correct_decentring(xy, 2e-6, -1e-6) - 2 * xy
    assert (ideal * 152.4 - xy) == pytest.approx(corrections, abs=1e-11)


def test_earth_curvature_on_a_sphere():
    """Points on a sphere, seen vertically: with the correction they are where map coordinates on a plane would be imaged."""
    radius, height, c = refinement.EARTH_RADIUS, 6000.0, 152.4
    s = np.linspace(500.0, 6000.0, 12)  # map distance from the nadir
    x, z = radius * np.sin(s / radius), radius * (np.cos(s / radius) - 1.0)
    seen = np.stack([c * x / (height - z), np.zeros(12)], axis=1)
    flat = c * s / height
    assert np.abs(seen[:, 0] - flat).max() > 0.02
    assert refinement.correct_earth_curvature(seen, c, height)[:, 0] == pytest.approx(flat, abs=2e-4)


@pytest.mark.parametrize(("flying", "ground"), [(2000.0, 0.0), (6000.0, 500.0), (9000.0, 1000.0), (14_000.0, 200.0)])
def test_refraction_by_tracing_rays(flying, ground):
    """Snell's law through thin layers of a standard atmosphere: a corrected image coordinate belongs to the straight line."""

    def density(z):  # hydrostatic, integrated from the temperature
        low = min(z, 11_000.0)
        pressure = 101_325.0 * (1.0 - 0.0065 * low / 288.15) ** (9.80665 / (287.053 * 0.0065))
        temperature = 288.15 - 0.0065 * low
        return pressure * np.exp(-9.80665 * (z - low) / (287.053 * temperature)) / (287.053 * temperature)

    n = [1.0 + 2.26e-4 * density(z) for z in np.linspace(ground, flying, 20_001)]
    middle, c = 0.5 * (np.array(n[1:]) + np.array(n[:-1])), 152.4
    for tangent in (0.2, 0.7, 1.1):
        sine = n[-1] * np.sin(np.arctan(tangent)) / middle
        straight = np.mean(sine / np.sqrt(1.0 - sine**2))  # horizontal distance over height difference
        found = refinement.correct_refraction([[c * tangent, 0.0]], c, flying, ground)[0, 0]
        assert c * tangent - c * straight > 1e-4
        assert found - c * tangent == pytest.approx(c * straight - c * tangent, rel=1e-2)


def test_refraction_approximation_of_textbooks():
    """K = 7.4e-4 (H - h) (1 - 0.02 (2 H + h)) degrees, km: the density as a parabola of the height."""
    for flying, ground in ((2.0, 0.0), (4.0, 1.0), (6.0, 0.5)):
        k = np.deg2rad(7.4e-4 * (flying - ground) * (1.0 - 0.02 * (2.0 * flying + ground)))
        assert refinement.refraction_constant(1000.0 * flying, 1000.0 * ground) == pytest.approx(k, rel=0.02)


def test_film_deformation_of_nothing_known():
    with pytest.raises(UsageError, match="at least 4 fiducial marks"):
        refinement.film_deformation(np.zeros((3, 2)), np.zeros((3, 2)))
    with pytest.raises(Singular, match="one line"):
        refinement.film_deformation([[0, 0], [1, 1], [2, 2], [3, 3]], [[0, 0], [1, 1], [2, 2], [3, 3]])
    with pytest.raises(UsageError, match="not above"):
        refinement.refraction_constant(100.0, 200.0)


# ---- strips ---------------------------------------------------------------------------------------------------------------------------


def test_polynomials_by_hand():
    """w^2 in plan and x^2 in height, by hand: X + iY = 100 + 10 w + w^2, Z = 10 z + 3 + x^2 / 10 for unit coefficients."""
    rng = np.random.default_rng(0)
    strip = {f"p{i}": x for i, x in enumerate(rng.uniform(-1, 1, (12, 3)) * [5.0, 1.0, 0.2])}

    def truth(x):
        w = complex(x[0], x[1])
        plan = 100.0 + 1000.0 * w + 3.0 * w * w
        return np.array([plan.real, plan.imag, 0.0])

    control = {k: truth(x) for k, x in list(strip.items())[:8]}
    control = {k: np.array([v[0], v[1], np.nan]) for k, v in control.items()} | {f"h{i}": np.array([np.nan, np.nan, 0.0]) for i in range(0)}
    heights = {k: 1000.0 * x[2] for k, x in strip.items()}
    control = {k: np.array([v[0], v[1], heights[k]]) for k, v in control.items()}
    found = adjust_polynomials([strip], control, 2)
    for k, x in strip.items():
        assert found.points[k][:2] == pytest.approx(truth(x)[:2], abs=1e-8)
    # heights: the scale of z in the model is that of the plan at the centre, which the quadratic term moves a little
    p = found.strips[0]
    local = abs(p.plan[1]) / p.scale
    w0 = complex(*np.mean(list(strip.values()), axis=0)[:2])
    assert local == pytest.approx(abs(1000.0 + 6.0 * w0), rel=1e-12)
    assert found.redundancy == 2 * 8 + 8 - (2 * 3 + 5)


def test_linear_polynomial_of_four_points_by_hand():
    """A square, turned by 90 degrees, doubled, shifted: c0 and c1 can be read off."""
    strip = {"a": np.array([0.0, 0, 0]), "b": np.array([2.0, 0, 0]), "c": np.array([0.0, 1, 0]), "d": np.array([2.0, 1, 1])}
    control = {"a": np.array([10.0, 20, 5]), "b": np.array([10.0, 24, 5]), "c": np.array([8.0, 20, 5])}
    found = adjust_polynomials([strip], control, 1)
    assert found.points["d"] == pytest.approx([8.0, 24.0, 7.0], abs=1e-12)
    assert found.redundancy == 2 * 3 - 4 + 3 - 3
    assert found.sigma0 == pytest.approx(0.0, abs=1e-12)


def test_block_of_two_strips():
    """A strip without control of its own hangs on the other one by tie points."""
    rng = np.random.default_rng(3)
    ground = {f"p{i}": x for i, x in enumerate(rng.uniform(0, 1000, (30, 3)) * [4.0, 2.0, 0.05])}
    turn = rot.exp(np.array([0.0, 0.0, 0.4]))
    one = {k: x / 1000.0 for k, x in list(ground.items())[:20]}
    two = {k: turn @ (x - 500.0) / 700.0 for k, x in list(ground.items())[8:]}
    control = {k: ground[k] for k in list(ground)[:6]}
    found = adjust_polynomials([one, two], control, 1)
    for k, x in ground.items():
        assert found.points[k] == pytest.approx(x, abs=1e-6)
    with pytest.raises(Singular, match=r"not determined|do not determine"):
        adjust_polynomials([one], {k: control[k] for k in list(control)[:1]}, 2)
    with pytest.raises(UsageError, match="half of its plan"):
        adjust_polynomials([one], {"p0": np.array([1.0, np.nan, 2.0])}, 1)
    with pytest.raises(UsageError, match="order"):
        adjust_polynomials([one], control, 4)


def test_connection_of_models():
    made = simulate_strip(5)
    strip = connect_models([{**m.points, **m.centres} for m in made.models])
    assert strip.rms < 1e-12
    for k, m in enumerate(made.models):
        for label, x in m.points.items():
            assert strip.scales[k] * strip.rotations[k] @ x + strip.translations[k] == pytest.approx(strip.points[label], abs=1e-9)
    far = {label: x for label, x in made.models[3].points.items() if label.startswith(("6",))}
    with pytest.raises(Singular, match="model 4 cannot be connected"):
        connect_models([made.models[0].points, far], ["1", "4"])


# ---- the chain ------------------------------------------------------------------------------------------------------------------------


def test_exact_models_give_the_truth():
    made = simulate_strip(5)
    network = bundle_of_models(made.models, made.principal_distance, 0.01, made.control)
    for g in network.observations:
        x = np.array([made.truth[network.points.labels[i]] for i in g.points])
        u = np.einsum("nij,nj->ni", made.rotation[g.images], x - made.position[g.images])
        assert g.xy == pytest.approx(-made.principal_distance * u[:, :2] / u[:, 2:], abs=1e-9)
    chain = adjust_chain(made.models, made.control, made.principal_distance, 0.01)
    for i, label in enumerate(chain.adjustment.network.points.labels):
        assert chain.adjustment.network.points.coordinates[i] == pytest.approx(made.truth[label], abs=1e-5)
    assert chain.adjustment.network.images.position == pytest.approx(made.position, abs=1e-5)


@pytest.fixture(scope="module")
def noisy():
    return simulate_strip(6, noise=0.008, seed=5)


@pytest.fixture(scope="module")
def chain(noisy):
    return adjust_chain(noisy.models, noisy.control, noisy.principal_distance, 0.008)


def test_chain_recovers_truth_within_sigmas(noisy, chain):
    a = chain.adjustment
    assert a.status == "converged"
    # model coordinates have lost the y parallax of their own model, which neighbouring models do not share
    assert a.sigma0 < 1.2
    tie = np.flatnonzero(a.network.points.roles == TIE)
    e = np.array([a.network.points.coordinates[i] - noisy.truth[a.network.points.labels[i]] for i in tie])
    z = e / np.sqrt(np.einsum("nii->ni", a.point_cofactors[tie]))
    assert np.abs(z).max() < 4.5
    # the polynomials were only a start: metres, not centimetres
    start = np.array([chain.start_points[a.network.points.labels[i]] - noisy.truth[a.network.points.labels[i]] for i in tie])
    assert np.sqrt((e**2).mean()) < np.sqrt((start**2).mean())


def test_bundle_of_the_chain_is_the_direct_bundle(noisy, chain):
    """The same image coordinates started from the truth: the same minimum."""
    a = chain.adjustment
    points = chain.network.points
    true = np.array([noisy.truth[label] for label in points.labels])
    direct = adjust(
        replace(
            chain.network,
            images=replace(chain.network.images, position=noisy.position, rotation=noisy.rotation),
            points=replace(points, coordinates=true),
        )
    )
    assert a.objective == pytest.approx(direct.objective, rel=1e-9)
    assert a.network.points.coordinates == pytest.approx(direct.network.points.coordinates, abs=1e-9)
    assert a.network.images.position == pytest.approx(direct.network.images.position, abs=1e-9)
    assert a.network.images.rotation == pytest.approx(direct.network.images.rotation, abs=1e-12)
    assert a.residuals == pytest.approx(direct.residuals, abs=1e-9)
    assert a.unknowns["sigma"] == pytest.approx(direct.unknowns["sigma"], rel=1e-9)
    assert a.redundancy_numbers == pytest.approx(direct.redundancy_numbers, abs=1e-9)
    without = adjust(chain.network.__class__(**{**vars_of(chain.network), "images": Images.make(chain.network.images.labels)}))
    assert without.objective == pytest.approx(direct.objective, rel=1e-9)


def vars_of(network):
    return {k: getattr(network, k) for k in ("cameras", "images", "points", "observations", "unit", "name", "settings", "declared")}


SYSTEMATIC = {
    "radial": lambda xy: refinement.correct_radial(xy, [2e-7, -3e-12]),
    "decentring": lambda xy: refinement.correct_decentring(xy, 2e-6, -1e-6),
    "refraction": lambda xy: refinement.correct_refraction(xy, 152.4, 1500.0),
    "curvature": lambda xy: refinement.correct_earth_curvature(xy, 152.4, 1500.0),
    "film": refinement.film_deformation(SHRUNK, MARKS).correct,
}


@pytest.mark.parametrize("name", [*SYSTEMATIC, "all"])
def test_refinement_undoes_what_was_simulated(name):
    """Systematic errors, alone and together: refined coordinates recover the truth to 1e-6 m, raw ones do not."""

    def correct(xy):
        for each in SYSTEMATIC.values() if name == "all" else [SYSTEMATIC[name]]:
            xy = each(xy)
        return xy

    def away(a, truth):
        labels = a.network.points.labels
        return max(np.abs(a.network.points.coordinates[i] - truth[label]).max() for i, label in enumerate(labels))

    # image coordinates as a camera with these errors measures them, raw and refined, in the bundle
    made = simulate_strip(5, seed=9)
    exact = adjust_chain(made.models, made.control, made.principal_distance, 0.005).network
    spoiled = [replace(g, xy=inverse(correct, g.xy)) for g in exact.observations]
    refined = [replace(g, xy=correct(g.xy)) for g in spoiled]
    raw, good = (away(adjust(replace(exact, observations=tuple(groups))), made.truth) for groups in (spoiled, refined))
    assert good < 1e-6
    assert raw > (1e-3 if name in ("refraction", "curvature") else 1e-1)
    # models that were formed of spoiled coordinates have lost the parallaxes these made: refined later, errors become smaller, not zero
    late = simulate_strip(5, distort=lambda xy: inverse(correct, xy), seed=9)
    settings = (late.models, late.control, late.principal_distance, 0.005)
    raw, good = (away(adjust_chain(*settings, refine=r).adjustment, late.truth) for r in (None, correct))
    assert good < 0.7 * raw


def test_residuals_of_the_chain_go_on_to_the_study(chain):
    """U: moments, laws of errors, and null laws through the adjustment."""
    study = analyse(chain.adjustment).study
    assert len(study.laws.laws) >= 3
    assert {"normal", "lineo"} <= {s.fit.law for s in study.laws.laws}
    assert study.laws.laws[0].test("anderson_darling").p_value > 0.001


def test_refinement_within_the_chain():
    """Film that shrank along the strip spoils the chain; corrected by refinement, it does not."""
    marks = np.array([[106.0, 106], [-106, -106], [-106, 106], [106, -106]])
    correct = refinement.film_deformation(marks * [0.998, 1.0], marks).correct

    made = simulate_strip(5, distort=lambda xy: inverse(correct, xy), seed=9)
    raw = adjust_chain(made.models, made.control, made.principal_distance, 0.005)
    refined = adjust_chain(made.models, made.control, made.principal_distance, 0.005, refine=correct)
    assert raw.adjustment.sigma0 > 3.0 * refined.adjustment.sigma0


def test_what_is_missing_is_named(noisy):
    m = noisy.models[2]
    lost = replace(m, centres={k: v for k, v in m.centres.items() if k != "photo 4"})
    for function in (
        lambda given: adjust_chain(given, noisy.control, noisy.principal_distance, 0.01),
        lambda given: block_of_models(given, noisy.control, 0.01),
    ):
        with pytest.raises(UsageError, match="model 3: the perspective centre of photograph photo 4 is missing"):
            function([*noisy.models[:2], lost, *noisy.models[3:]])
    with pytest.raises(UsageError, match="rotation of photograph photo 3 is missing"):
        replace(m, rotations={}).image_coordinates("photo 3", 150.0)
    with pytest.raises(UsageError, match="lies behind"):
        Model("1", ("a",), {"a": np.zeros(3)}, {"a": np.eye(3)}, {"p": np.array([0, 0, 1.0])}).image_coordinates("a", 1.0)
    two = noisy.control.labels[:2]
    few = Points.make(two, noisy.control.coordinates[:2], [CONTROL] * 2, np.full((2, 3), FIXED), noisy.control.given[:2])
    with pytest.raises(Singular, match=r"cannot be moved onto 2 control point"):
        adjust_chain(noisy.models, few, noisy.principal_distance, 0.01)


# ---- the block of independent models --------------------------------------------------------------------------------------------------


def measured_models(noise, seed=2, count=5, control_sigma=None):
    """Models of a strip whose coordinates have independent errors."""
    made = simulate_strip(count, seed=seed, control_sigma=control_sigma)
    rng = np.random.default_rng(seed)
    given = [
        replace(
            m,
            points={k: x + noise * rng.standard_normal(3) for k, x in m.points.items()},
            centres={k: x + noise * rng.standard_normal(3) for k, x in m.centres.items()},
        )
        for m in made.models
    ]
    return made, given


def test_partials_of_model_coordinates():
    """Against complex step for points and parameters, and numerically for rotation increments."""
    _, given = measured_models(1e-5)
    network = block_of_models(given, simulate_strip(5, seed=2).control, 1e-5)
    network = network.observations[0].with_start(network, np.zeros(len(network.points.labels), dtype=bool))
    group, state = network.observations[0], State.of(network)
    rows = group.linearize(network, state)[0]
    h = 1e-4
    for k in range(7):
        step = np.zeros((len(network.declared[0].labels), 7))
        size = h * (1e4 if k < 3 else 1.0)
        step[:, k] = size if k < 6 else 1e-7
        size = step[0, k]
        ahead, back = (replace(state, declared=(network.declared[0].moved(sign * step.ravel()),)) for sign in (1.0, -1.0))
        numeric = -(group.misclosures(network, ahead) - group.misclosures(network, back)) / (2.0 * size)
        assert rows.blocks[1].jacobian[:, :, k] == pytest.approx(numeric, rel=1e-6, abs=1e-8)


def test_one_model_is_align_vectors():
    """A single model with exact control: rotation of SciPy's align_vectors, scale and shift of Horn's closed form."""
    rng = np.random.default_rng(6)
    x = rng.uniform(-100, 100, (9, 3))
    turn = Rotation.from_rotvec([0.3, -0.2, 0.9])
    model = 0.002 * turn.apply(x - [10.0, 20.0, 30.0]) + 1e-4 * rng.standard_normal(x.shape)
    points = Points.make([str(i) for i in range(9)], x, np.full(9, CONTROL), np.full((9, 3), FIXED), x)
    o = ModelCoordinates(np.zeros(9, dtype=int), np.arange(9), model, np.full((9, 3), 1e-4))
    a = adjust(Network((), Images.make(()), points, (o,), declared=(models(["1"]),), settings={"min_rays": 0}))
    assert a.status == "converged"
    assert a.redundancy == 27 - 7
    found, _ = Rotation.align_vectors(model - model.mean(axis=0), x - x.mean(axis=0))
    assert a.network.declared[0].rotations[0] == pytest.approx(found.as_matrix(), abs=1e-9)
    d, m = x - x.mean(axis=0), model - model.mean(axis=0)
    scale = np.sum(m * (d @ found.as_matrix().T)) / np.sum(d * d)
    assert a.network.declared[0].values[6] == pytest.approx(scale, rel=1e-9)


def test_block_recovers_truth_and_statistics():
    made, given = measured_models(2e-5, count=6)
    network = block_of_models(given, made.control, 2e-5)
    a = adjust(network)
    assert a.status == "converged"
    assert 0.001 < stats.chi2.cdf(a.objective, a.redundancy) < 0.999
    assert a.redundancy_numbers.sum() == pytest.approx(a.redundancy, rel=1e-9)
    tie = np.flatnonzero(a.network.points.roles == TIE)
    true = made.truth | {f"perspective centre photo {i + 1}": p for i, p in enumerate(made.position)}
    e = np.array([a.network.points.coordinates[i] - true[a.network.points.labels[i]] for i in tie])
    chi = np.einsum("ni,nij,nj->n", e, np.linalg.inv(a.point_cofactors[tie]), e)
    assert 0.5 < chi.mean() / 3.0 < 2.0
    assert adjust(network, solver="block").redundancy_numbers == pytest.approx(a.redundancy_numbers, abs=1e-9)
    assert set(a.unknowns["group"]) == {"point", "model"}


def test_free_block_of_models():
    """Without control the block is a free network of defect 7 with inner constraints; residuals do not depend on the system."""
    made, given = measured_models(2e-5)
    none = Points.make(())
    a = adjust(block_of_models(given, none, 2e-5))
    assert a.status == "converged"
    assert a.datum.defect.count == 7
    assert a.redundancy == a.count - a.numbering.count + 7
    turned = [replace(m, points=dict(m.points)) for m in reversed(given)]
    b = adjust(block_of_models(turned, none, 2e-5))
    assert b.objective == pytest.approx(a.objective, rel=1e-8)
    assert made.control is not None


def test_block_agrees_with_the_bundle_of_the_same_geometry(noisy, chain):
    """Both recover the same points, within their sigmas."""
    a = adjust(block_of_models(noisy.models, noisy.control, 2e-5))
    index = {label: i for i, label in enumerate(a.network.points.labels)}
    bundle = chain.adjustment
    tie = np.flatnonzero(bundle.network.points.roles == TIE)
    for i in tie:
        j = index[bundle.network.points.labels[i]]
        d = a.network.points.coordinates[j] - bundle.network.points.coordinates[i]
        s = np.sqrt(np.diag(bundle.point_cofactors[i]) + a.variance_factor * np.diag(a.point_cofactors[j]))
        assert (np.abs(d) < 4.0 * s).all()


def test_models_in_project_files(tmp_path):
    made, given = measured_models(2e-5, control_sigma=0.1)
    network = block_of_models(given, made.control, 2e-5)
    project.write(network, tmp_path / "p")
    again = baarda.read(tmp_path / "p")
    assert adjust(again).objective == adjust(network).objective
    with pytest.raises(UsageError, match="free or fixed as a whole"):
        models(["1"], np.zeros((1, 7)), [[FREE, FREE, FREE, FIXED, FREE, FREE, FREE]])


def test_group_names_are_those_of_the_models(chain):
    assert [g.name for g in chain.network.observations] == [f"model {k + 1}" for k in range(6)]
    assert all(isinstance(g, ImagePoints) for g in chain.network.observations)
