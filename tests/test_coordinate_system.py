"""Control in coordinate systems (extra geo): against closed formulas, covariances there and back, geoid heights, whole adjustments."""

import importlib
import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import baarda
import test_format_opensfm
import test_format_opf
from baarda.errors import InputError, MissingExtra, UsageError
from baarda.formats import coordinate_system, read, write
from baarda.formats.camera_positions import with_camera_positions
from baarda.formats.control import with_control
from baarda.formats.coordinate_system import CoordinateSystem, Geoid
from baarda.geometry.tangent_frame import TangentFrame, geocentric
from networks import ring
from test_cli import run

A, F = 6378137.0, 1 / 298.257222101  # GRS 80


@pytest.fixture(autouse=True)
def _pyproj():
    pytest.importorskip("pyproj", reason="pyproj is not installed (extra 'geo')")


def krueger(latitude, longitude, centre=9.0, k0=0.9996):
    """Transverse Mercator by Krueger's series to n^4 (Karney 2011, eq. 35): easting, northing, convergence."""
    n = F / (2 - F)
    alpha = [
        n / 2 - 2 / 3 * n**2 + 5 / 16 * n**3 + 41 / 180 * n**4,
        13 / 48 * n**2 - 3 / 5 * n**3 + 557 / 1440 * n**4,
        61 / 240 * n**3 - 103 / 140 * n**4,
        49561 / 161280 * n**4,
    ]
    big = A / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    phi, lam = np.radians(latitude), np.radians(longitude - centre)
    e = np.sqrt(F * (2 - F))
    t = np.sinh(np.arctanh(np.sin(phi)) - e * np.arctanh(e * np.sin(phi)))
    xi, eta = np.arctan2(t, np.cos(lam)), np.arcsinh(np.sin(lam) / np.hypot(t, np.cos(lam)))
    z = xi + 1j * eta
    w = z + sum(a * np.sin(2 * (j + 1) * z) for j, a in enumerate(alpha))
    p = 1 + sum(2 * (j + 1) * a * np.cos(2 * (j + 1) * z) for j, a in enumerate(alpha))
    gamma = np.arctan(t / np.sqrt(1 + t**2) * np.tan(lam)) - np.angle(p)
    return 5e5 + k0 * big * w.imag, k0 * big * w.real, gamma


def ecef(lla):
    """Textbook formula of geocentric coordinates on GRS 80."""
    lat, lon, h = np.radians(lla[0]), np.radians(lla[1]), lla[2]
    e2 = F * (2 - F)
    nu = A / np.sqrt(1 - e2 * np.sin(lat) ** 2)
    return np.array([(nu + h) * np.cos(lat) * np.cos(lon), (nu + h) * np.cos(lat) * np.sin(lon), (nu * (1 - e2) + h) * np.sin(lat)])


def east_north_up(lla, origin):
    lat, lon = np.radians(origin[:2])
    axes = np.array([[-np.sin(lon), np.cos(lon), 0], [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
                     [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]])  # fmt: skip
    return axes @ (ecef(lla) - ecef(origin)), axes


PLACES = np.array([[53.51, 9.98, 30.0], [53.52, 10.01, 85.0], [53.49, 9.95, -5.0], [53.505, 11.4, 12.0]])


def test_a_projection_becomes_east_north_up():
    e, n, _ = krueger(PLACES[:, 0], PLACES[:, 1])
    system = CoordinateSystem.of("EPSG:25832")
    frame = TangentFrame(53.5, 10.0, 0.0, A, F)
    xyz = np.stack([e, n, PLACES[:, 2]], axis=1)
    want = np.array([east_north_up(p, (53.5, 10.0, 0.0))[0] for p in PLACES])
    np.testing.assert_allclose(system.to_local(xyz, frame), want, atol=1e-6)
    np.testing.assert_allclose(system.from_local(want, frame), xyz, atol=1e-6)


def test_partials_are_convergence_scale_and_height():
    """d(east, north, up at the point)/d(E, N, H): 1 / k turned by the convergence in plan, 1 + h / radius about, 1 in height."""
    system = CoordinateSystem.of("EPSG:25832")
    for place in PLACES:
        e, n, gamma = krueger(place[0], place[1])
        frame = TangentFrame(place[0], place[1], 0.0, A, F)
        local = system.to_local(np.array([[e, n, place[2]]]), frame)
        j = system.partials(local, frame)[0]
        step = 1e-4  # degrees: scale and convergence by differences of the series itself
        east, north = (
            np.array(krueger(place[0] + a, place[1] + b)[:2]) - np.array(krueger(place[0] - a, place[1] - b)[:2])
            for a, b in ((0, step), (step, 0))
        )
        at = lambda a, b, place=place: east_north_up((place[0] + a, place[1] + b, place[2]), (*place[:2], 0.0))[0]  # noqa: E731
        ground = [at(0, step) - at(0, -step), at(step, 0) - at(-step, 0)]
        grid_to_ground = np.column_stack(ground)[:2] @ np.linalg.inv(np.column_stack([east, north]))
        np.testing.assert_allclose(j[:2, :2], grid_to_ground, atol=2e-8)
        np.testing.assert_allclose(j[2], [0, 0, 1], atol=1e-6)
        assert np.arctan2(j[0, 1], j[0, 0]) == pytest.approx(gamma, abs=1e-8)


def test_geographic_and_geocentric_axes_only_turn():
    frame = TangentFrame(53.5, 10.0, 0.0, A, F)
    _, there = east_north_up(PLACES[3], PLACES[3])
    _, here = east_north_up(PLACES[3], (53.5, 10.0, 0.0))
    for name, axes in (("EPSG:4258", here @ there.T), ("EPSG:4936", here)):
        system = CoordinateSystem.of(name)
        xyz = PLACES[3:, [1, 0, 2]] if name == "EPSG:4258" else ecef(PLACES[3])[None]
        local = system.to_local(xyz, frame)
        np.testing.assert_allclose(local[0], east_north_up(PLACES[3], (53.5, 10.0, 0.0))[0], atol=1e-6)
        np.testing.assert_allclose(system.partials(local, frame)[0], axes, atol=1e-9)
        np.testing.assert_allclose(system.from_local(local, frame), xyz, atol=1e-6)


@pytest.mark.parametrize(
    "name", ["EPSG:31467", "EPSG:21781", "EPSG:2263", "EPSG:27572", "EPSG:2154+5720", "+proj=utm +zone=32 +datum=WGS84"]
)
def test_there_and_back(name):
    system = CoordinateSystem.of(name)
    lla = (
        np.array([[46.9, 7.4, 500.0], [46.91, 7.42, 550.0]])
        if name != "EPSG:2263"
        else np.array([[40.7, -74.0, 10.0], [40.71, -74.01, 20.0]])
    )
    xyz = system.coordinates(lla)
    frame = system.frame(xyz)
    local = system.to_local(xyz, frame)
    np.testing.assert_allclose(system.from_local(local, frame), xyz, atol=1e-5)
    length = np.linalg.norm(geocentric(lla[1], *system.ellipsoid) - geocentric(lla[0], *system.ellipsoid))
    assert np.linalg.norm(local[1] - local[0]) == pytest.approx(length, abs=1e-6)


# ---- geoid heights -------------------------------------------------------------------------------------------------------------------


def gtx(path, plane):
    """A grid of geoid heights: eight numbers in a header, rows from the south, big-endian."""
    lat0, lon0, step, rows, cols = 52.0, 8.0, 0.25, 13, 17
    lat, lon = lat0 + step * np.arange(rows), lon0 + step * np.arange(cols)
    values = plane(lat[:, None], lon[None, :]).astype(">f4")
    path.write_bytes(struct.pack(">ddddii", lat0, lon0, step, step, rows, cols) + values.tobytes())
    return path


def test_geoid_heights_from_a_number_a_plane_and_a_grid(tmp_path):
    plane = lambda lat, lon: 40.0 + 0.3 * (lat - 53.5) - 0.2 * (lon - 10.0)  # noqa: E731
    file = gtx(tmp_path / "n.gtx", plane)
    e, n, _ = krueger(PLACES[:, 0], PLACES[:, 1])
    for geoid in (Geoid(40.0), Geoid.through(PLACES[:, 1], PLACES[:, 0], plane(PLACES[:, 0], PLACES[:, 1])), Geoid(grid=str(file))):
        system = replace(CoordinateSystem.of("EPSG:25832+7837"), geoid=geoid)
        above = np.full(4, 40.0) if geoid.constant == 40.0 and not geoid.east else plane(PLACES[:, 0], PLACES[:, 1])
        xyz = np.stack([e, n, PLACES[:, 2] - above], axis=1)
        np.testing.assert_allclose(system.geographic(xyz), PLACES, rtol=0, atol=2e-5)
        np.testing.assert_allclose(system.coordinates(PLACES), xyz, atol=2e-5)
    outside = CoordinateSystem.of("EPSG:25832", str(file)).geographic(np.array([[500000.0, 5200000.0, 0.0]]))
    assert np.isnan(outside[0, 2])


def test_a_project_alone_leads_to_no_grid(tmp_path):
    settings = {"coordinate_system": "EPSG:25832", "reference_lla": (53.5, 10.0, 0.0), "geoid_height": "/etc/passwd"}
    with pytest.raises(UsageError, match="give it again by --geoid"):
        coordinate_system.system_of(settings)
    file = gtx(tmp_path / "n.gtx", lambda lat, lon: 40.0 + 0 * (lat + lon))
    chosen = CoordinateSystem.of("EPSG:25832", str(file))
    kept = chosen.settings(TangentFrame(53.5, 10.0, 0.0))
    assert coordinate_system.system_of(kept)[0].geoid.grid == str(file)


@pytest.mark.parametrize(
    "wrong",
    [{"reference_lla": "x"}, {"reference_lla": (1, 2)}, {"geoid_height": (1, 2)}, {"ellipsoid": 3}, {"coordinate_system": "EPSG:0"}],
)
def test_settings_that_do_not_fit_are_refused(wrong):
    settings = {"coordinate_system": "EPSG:25832", "reference_lla": (53.5, 10.0, 0.0), **wrong}
    with pytest.raises(UsageError):
        coordinate_system.system_of(settings)


def test_what_is_no_geoid_or_system(tmp_path):
    for name, geoid, words in (
        ("EPSG:999999", None, "is not known"),
        ("EPSG:5703", None, "neither projected"),
        ("nonsense", None, "is not known"),
        ("EPSG:25832", "no such file", "the geoid is a height"),
        ("EPSG:25832", "1e9", "must be metres"),
    ):
        with pytest.raises(UsageError, match=words):
            CoordinateSystem.of(name, geoid)


def test_without_pyproj(monkeypatch):
    def absent(name):
        raise ImportError(name)

    monkeypatch.setattr(coordinate_system, "import_module", absent)
    with pytest.raises(MissingExtra, match=r"'geo' extra"):
        CoordinateSystem.of("EPSG:25832")
    assert importlib.import_module("pyproj")


# ---- whole adjustments ---------------------------------------------------------------------------------------------------------------

ORIGIN = (53.5, 10.0)
SIGMA = np.array([0.004, 0.006, 0.009])
R = np.array([[1, 0.5, -0.2], [0.5, 1, 0.1], [-0.2, 0.1, 1.0]])


def block(noise=0.5, seed=1, size=100.0):
    """A ring in the frame (east, north, up) at ORIGIN, `size` metres wide, with the truth of its points."""
    network = ring(images=8, points=24, noise=noise, seed=seed)
    truth = np.random.default_rng(seed).uniform(-2.0, 2.0, (24, 3)) * [1.0, 1.0, 0.6] * size
    images = replace(network.images, position=network.images.position * size)
    return replace(
        network, images=images, points=replace(network.points, coordinates=network.points.coordinates * size), unit="model units"
    ), truth


def table(path, system, truth, rows, seed=0, sigma=SIGMA, geoid=None, header="", tail=lambda k: ""):
    """Write surveyed points with correlated errors along the axes of a system."""
    frame = TangentFrame(*ORIGIN, 0.0, *system.ellipsoid)
    xyz = system.from_local(truth, frame)
    rng = np.random.default_rng(seed)
    c = R * np.outer(sigma, sigma)
    metres = np.linalg.cholesky(c) @ rng.standard_normal((3, len(truth)))
    if system.kind == "geographic":  # along east, north, up at the point
        xyz = system.from_local(truth + np.einsum("nij,jn->ni", system.partials(truth, frame), metres), frame)
    else:
        xyz = xyz + metres.T
    lines = ["point,X,Y,Z,sigma_X,sigma_Y,sigma_Z,correlation_XY,correlation_XZ,correlation_YZ" + header]
    lines += [
        f"P{k},{xyz[k, 0]!r},{xyz[k, 1]!r},{xyz[k, 2]!r},{sigma[0]},{sigma[1]},{sigma[2]},0.5,-0.2,0.1{tail(k)}".replace(
            "np.float64(", ""
        ).replace(")", "")
        for k in rows
    ]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("name", ["EPSG:25832", "EPSG:31467", "EPSG:4258", "EPSG:4936"])
def test_a_block_in_a_coordinate_system_and_its_points_back(tmp_path, name):
    network, truth = block()
    system = CoordinateSystem.of(name)
    path = table(tmp_path / "c.csv", system, truth, range(8))
    network = with_control(network, path, system)
    assert network.unit == "m" and network.settings["coordinate_system"] == name
    result = baarda.adjust(network)
    assert result.status == "converged" and result.datum.defect.count == 0
    baarda.write_points(result, tmp_path / "p.csv")
    back = np.genfromtxt(tmp_path / "p.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    assert set(back["system"].tolist()) == {name}
    frame = TangentFrame(*ORIGIN, 0.0, *system.ellipsoid)
    want = system.from_local(truth, frame)
    found = np.stack([back[a] for a in "XYZ"], axis=1)
    axes = system.partials(truth, frame)
    difference = system.to_local(found, frame) - truth  # metres
    sigmas = np.stack([back[a] for a in ("sX", "sY", "sZ")], axis=1)
    along = np.einsum("nij,nj->ni", np.linalg.inv(axes), difference) if name != "EPSG:4936" else found - want
    # predicted sigmas cover the truth: 72 values, level 1e-6 each
    assert np.abs(along / sigmas).max() < 5.0 and 0.5 < np.sqrt(np.mean((along / sigmas) ** 2)) < 1.5


def test_the_frame_of_the_adjustment_makes_no_difference(tmp_path):
    """The same control, led to the frame by hand, gives the same block."""
    network, truth = block()
    system = CoordinateSystem.of("EPSG:25832")
    path = table(tmp_path / "c.csv", system, truth, range(6))
    mine = with_control(network, path, system)
    lat, lon, _ = mine.settings["reference_lla"]
    rows = np.genfromtxt(path, delimiter=",", names=True, dtype=None, encoding="utf-8")
    want, j = [], []
    for r in rows:
        # closed: the place by PROJ-free inversion of the series, the partials by its differences
        place = inverse_krueger(r["X"], r["Y"])
        want.append(east_north_up((*place, r["Z"]), (lat, lon, 0.0))[0])
        ground = [
            east_north_up((*inverse_krueger(r["X"] + a, r["Y"] + b), r["Z"]), (lat, lon, 0.0))[0]
            for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1))
        ]
        up = east_north_up((*place, r["Z"] + 1), (lat, lon, 0.0))[0] - want[-1]
        j.append(np.column_stack([(ground[0] - ground[1]) / 2, (ground[2] - ground[3]) / 2, up]))
    control = mine.points.roles == 1
    np.testing.assert_allclose(mine.points.given[control], want, atol=2e-6)
    c = np.array(j) @ (R * np.outer(SIGMA, SIGMA)) @ np.array(j).transpose(0, 2, 1)
    np.testing.assert_allclose(mine.points.covariance(np.flatnonzero(control)), c, rtol=1e-6, atol=1e-13)


def inverse_krueger(e, n):
    """Latitude and longitude by Newton's method on the series."""
    place = np.array([53.5, 10.0])
    for _ in range(8):
        f = np.array(krueger(*place)[:2]) - [e, n]
        jac = np.column_stack(
            [
                (np.array(krueger(*(place + d))[:2]) - np.array(krueger(*(place - d))[:2])) / 2e-5
                for d in (np.array([1e-5, 0]), np.array([0, 1e-5]))
            ]
        )
        place = place - np.linalg.solve(jac, f)
    return place


def test_geoid_heights_of_the_table(tmp_path):
    network, truth = block()
    system = CoordinateSystem.of("EPSG:25832")
    path = table(tmp_path / "c.csv", system, truth, range(6), header=",geoid_height", tail=lambda k: f",{40 + 0.001 * k}")
    plain = with_control(network, table(tmp_path / "d.csv", system, truth, range(6)), system)
    raised = with_control(network, path, system)
    control = raised.points.roles == 1
    lift = raised.points.given[control][:, 2] - plain.points.given[control][:, 2]
    np.testing.assert_allclose(lift, 40 + 0.001 * np.arange(6), atol=1e-4)
    with pytest.raises(InputError, match="given by --geoid and by the column"):
        with_control(network, path, CoordinateSystem.of("EPSG:25832", 40.0))
    result = baarda.adjust(raised)
    baarda.write_points(result, tmp_path / "p.csv")
    back = np.genfromtxt(tmp_path / "p.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    z = dict(zip(back["point"].tolist(), back["Z"].tolist(), strict=True))
    rows = np.genfromtxt(path, delimiter=",", names=True, dtype=None, encoding="utf-8")
    assert max(abs(z[r["point"]] - r["Z"]) for r in rows) < 0.1


def test_camera_positions_in_a_coordinate_system(tmp_path):
    network, truth = block()
    system = CoordinateSystem.of("EPSG:25832")
    frame = TangentFrame(*ORIGIN, 0.0, *system.ellipsoid)
    xyz = system.from_local(network.images.position, frame)
    path = tmp_path / "gnss.csv"
    path.write_text(
        "image,X,Y,Z,sigma_X,sigma_Y,sigma_Z\n"
        + "".join(f"I{k},{x:.4f},{y:.4f},{z:.4f},0.02,0.03,0.05\n" for k, (x, y, z) in enumerate(xyz))
    )
    result = baarda.adjust(with_camera_positions(network, path, system=system))
    assert result.status == "converged" and result.datum.defect.count == 0
    found = system.from_local(
        result.network.images.position - result.network.offset, TangentFrame(*result.network.settings["reference_lla"], A, F)
    )
    assert np.abs(found - xyz).max() < 3.0  # start values of the ring are 2 m off
    both = with_camera_positions(with_control(network, table(tmp_path / "c.csv", system, truth, range(6)), system), path, system=system)
    assert np.abs(both.observations[-1].values.mean(axis=0)[:2]).max() < 500.0


def test_the_command_line(tmp_path):
    network, truth = block()
    write(network, tmp_path / "block", "project")
    path = table(tmp_path / "c.csv", CoordinateSystem.of("EPSG:25832"), truth, range(8))
    arguments = ("adjust", str(tmp_path / "block"), "--control", str(path), "--crs", "EPSG:25832+7837", "--geoid", "0", "--quiet")
    done = run(*arguments, "--out", str(tmp_path / "out"), "--points", str(tmp_path / "p.geojson"))
    assert done.returncode == 0, done.stderr
    assert '"FeatureCollection"' in (tmp_path / "p.geojson").read_text()
    again = read(tmp_path / "out" / "project")  # the adjusted project remembers its system
    assert again.settings["coordinate_system"] == "EPSG:25832+7837"
    for extra, words in ((("--crs", "EPSG:1"), "is not known"), (("--geoid", "3"), "belongs to --crs")):
        done = run("adjust", str(tmp_path / "block"), "--control", str(path), *extra)
        assert done.returncode == 2 and words in done.stderr


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (",0.004,", ",,", "sigma_X is missing"),
        ("P0,5", "P0,555555555", "lie outside the system"),
        ("P2,", "P1,", "appears twice|twice"),
    ],
)
def test_damaged_tables_are_refused_with_the_line(tmp_path, old, new, words):
    network, truth = block()
    system = CoordinateSystem.of("EPSG:25832")
    path = table(tmp_path / "c.csv", system, truth, range(6))
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=words) as caught:
        with_control(network, path, system)
    assert caught.value.line > 1


def test_a_source_with_a_frame_of_its_own_stays_in_it(tmp_path):
    """OpenSfM names its frame: the control points come to it, nothing is carried over."""
    _, _, xyz = test_format_opensfm.scene(tmp_path)
    frame = TangentFrame(*test_format_opensfm.ORIGIN)
    system = CoordinateSystem.of("EPSG:4979")
    place = system.from_local(xyz, frame)
    path = tmp_path / "c.csv"
    path.write_text(
        "point,X,Y,Z,sigma_X,sigma_Y,sigma_Z\n"
        + "".join(f"{k},{x!r},{y!r},{z!r},0.01,0.01,0.02\n" for k, (x, y, z) in enumerate(place[:5].tolist()))
    )
    network = read(tmp_path, control=path, crs="EPSG:4979")
    control = network.points.roles == 1
    np.testing.assert_allclose(network.points.given[control], xyz[:5], atol=1e-6)
    assert network.settings["reference_lla"] == test_format_opensfm.ORIGIN and "moved_to_control" not in network.settings


def test_positions_of_a_source_that_was_moved_are_refused(tmp_path):
    test_format_opf.scene(tmp_path, gcps=0, checkpoints=0)
    path = tmp_path / "c.csv"
    rows = read(tmp_path).points
    path.write_text(
        "point,X,Y,Z\n"
        + "".join(f"{n},{x!r},{y!r},{z!r}\n" for n, (x, y, z) in zip(rows.labels[:6], rows.coordinates[:6].tolist(), strict=True))
    )
    network = read(tmp_path, control=path, crs="EPSG:32632")
    assert network.points.roles.sum() == 6
    with pytest.raises(UsageError, match="carried over to its control points"):
        with_camera_positions(network, "source")


@settings(max_examples=40, deadline=None, database=None, suppress_health_check=list(HealthCheck))
@given(
    st.lists(
        st.tuples(
            st.integers(0, 10**6),
            st.integers(0, 20),
            st.sampled_from([b"", b"9" * 30, b"-", b"nan", b",", b"\n", b'"', b"e99", b"\xff", b"P1"]),
        ),
        min_size=1,
        max_size=3,
    )
)
def test_broken_tables(tmp_path_factory, changes):
    folder = tmp_path_factory.mktemp("t")
    network, truth = block()
    system = CoordinateSystem.of("EPSG:25832")
    path = table(folder / "c.csv", system, truth, range(6), header=",geoid_height", tail=lambda k: f",{40 + k}")
    data = path.read_bytes()
    for at, cut, piece in changes:
        at %= len(data) + 1
        data = data[:at] + piece + data[at + cut :]
    path.write_bytes(data or b" ")
    try:
        with_control(network, path, system)
    except InputError as error:
        assert error.file == str(path)
