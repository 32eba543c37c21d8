"""Metashape projects written by the documented schema: archives, projects and exports; hostile XML and archives."""

import zipfile

import numpy as np
import pytest

import baarda
from baarda.errors import InputError, MissingExtra
from baarda.formats import read, recognise
from baarda.geometry.tangent_frame import geocentric
from baarda.network import CHECK, CONTROL, State

W, H = 640, 480
K = {"f": 700.0, "cx": 4.0, "cy": -3.0, "k1": -0.08, "k2": 0.03, "k3": -0.01, "k4": 0.002, "p1": 1e-3, "p2": -5e-4, "b1": 1.5, "b2": -0.7}
SCALE, SHIFT = 2.5, np.array([100.0, 200.0, 30.0])
LOCAL = 'LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["Local Datum",0],UNIT["metre",1]]'
WGS84 = 'GEOGCS["WGS 84",DATUM["World Geodetic System 1984",SPHEROID["WGS 84",6378137,298.257223563]],AUTHORITY["EPSG","4326"]]'


def turn(v):
    t = np.linalg.norm(v)
    a = np.asarray(v) / t
    k = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
    return np.eye(3) + np.sin(t) * k + (1 - np.cos(t)) * k @ k


def project(transform, x):
    """The user manual, appendix on camera models: pixels of a point of the chunk."""
    c = transform[:3, :3].T @ (x - transform[:3, 3])
    assert c[2] > 0
    x, y = c[0] / c[2], c[1] / c[2]
    r2 = x * x + y * y
    d = 1 + K["k1"] * r2 + K["k2"] * r2**2 + K["k3"] * r2**3 + K["k4"] * r2**4
    xd = x * d + K["p1"] * (r2 + 2 * x * x) + 2 * K["p2"] * x * y
    yd = y * d + K["p2"] * (r2 + 2 * y * y) + 2 * K["p1"] * x * y
    return W / 2 + K["cx"] + xd * K["f"] + xd * K["b1"] + yd * K["b2"], H / 2 + K["cy"] + yd * K["f"]


def ply(columns):
    types = {"float32": "float", "float64": "double", "uint32": "uint"}
    n = len(next(iter(columns.values())))
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {n}"]
    head += [f"property {types[np.asarray(c).dtype.name]} {k}" for k, c in columns.items()]
    table = np.zeros(n, dtype=[(k, np.asarray(c).dtype) for k, c in columns.items()])
    for k, c in columns.items():
        table[k] = c
    return "\n".join([*head, "end_header\n"]).encode() + table.tobytes()


def scene(crs=LOCAL, settings=True, covariance=True, points=14, transform=True):
    """Return chunk XML, frame XML and the parts of the tie points."""
    rng = np.random.default_rng(3)
    xyz = rng.uniform(-2, 2, (points, 3)).astype(np.float32).astype(float)
    rotation = turn([0.3, -0.2, 0.5])
    matrices = []
    for i in range(4):
        m = np.eye(4)
        m[:3, :3] = turn([0.1 * i + 0.05, 0.1, -0.2 * i])
        m[:3, 3] = m[:3, :3] @ np.array([rng.uniform(-1, 1), rng.uniform(-1, 1), -8.0])
        matrices.append(m)
    world = xyz * SCALE @ rotation.T + SHIFT
    if crs != LOCAL:  # a geocentric world; the markers are given as longitude, latitude, height
        lla = np.array([[46.5, 8.0, 500.0]]) + np.stack([world[:, 1] * 1e-6, world[:, 0] * 1e-6, world[:, 2]], axis=1)
        world = geocentric(lla)
        centre = world.mean(axis=0)
        xyz = (world - centre) @ rotation / SCALE
        xyz32 = xyz.astype(np.float32).astype(float)
        world = xyz32 * SCALE @ rotation.T + centre
        xyz, shift = xyz32, centre
        for m in matrices:
            m[:3, 3] = m[:3, :3] @ np.array([0.0, 0.0, -60.0 * np.ptp(xyz)])
    else:
        shift, lla = SHIFT, None
    marked = {k: world[k] for k in range(4)}
    cov = f"<covariance><params>f cx cy k1 k2 p1</params><coeffs>{' '.join(['0'] * 36)}</coeffs></covariance>" if covariance else ""
    out = ['<?xml version="1.0" encoding="UTF-8"?>', "<CHUNK>"]
    out += ['<sensors next_id="1"><sensor id="0" label="unknown" type="frame">', f'<resolution width="{W}" height="{H}"/>']
    out += [
        '<property name="fixed" value="false"/>',
        '<calibration type="frame" class="adjusted">',
        f'<resolution width="{W}" height="{H}"/>',
    ]
    out += [f"<{k}>{v!r}</{k}>" for k, v in K.items()] + ["</calibration>", cov, "</sensor></sensors>", '<cameras next_id="6">']
    for i, m in enumerate(matrices):
        out.append(
            f'<camera id="{i}" sensor_id="0" label="I{i}"><transform>{" ".join(repr(float(v)) for v in m.ravel())}</transform></camera>'
        )
    out += ['<camera id="5" sensor_id="0" label="lost"/>', "</cameras>", '<markers next_id="4">']
    for k, x in marked.items():
        place = x if lla is None else _geographic(x)
        a, b, c = (repr(float(v)) for v in place)
        sigma = 'sxyz="0.02"' if k == 0 else ""
        out.append(
            f'<marker id="{k}" label="M{k}"><reference x="{a}" y="{b}" z="{c}" {sigma} enabled="{"false" if k == 3 else "true"}"/></marker>'
        )
    out += ["</markers>", "<FRAMES>"]
    if transform:
        r = " ".join(repr(float(v)) for v in rotation.ravel())
        t = " ".join(repr(float(v)) for v in shift)
        out.append(f"<transform><rotation>{r}</rotation><translation>{t}</translation><scale>{SCALE!r}</scale></transform>")
    out.append("<reference>" + crs.replace('"', "&quot;") + "</reference>")
    if settings:
        pairs = {"accuracy_tiepoints": 0.8, "accuracy_projections": 0.3, "accuracy_markers": 0.01}
        out.append("<settings>" + "".join(f'<property name="{k}" value="{v}"/>' for k, v in pairs.items()) + "</settings>")
    out.append("</CHUNK>")
    frame = ["<markers>"]
    for k in range(4):
        frame.append(f'<marker marker_id="{k}">')
        for i, m in enumerate(matrices):
            u, v = project(m, xyz[k])
            frame.append(f'<location camera_id="{i}" pinned="true" x="{float(u)!r}" y="{float(v)!r}"/>')
        frame.append('<location camera_id="5" pinned="true" x="1" y="1"/></marker>')
    frame[2] = frame[2].replace('pinned="true"', 'pinned="false"')
    frame.append("</markers>")
    parts = {"points0.ply": ply({"x": xyz[:, 0].astype(np.float32), "y": xyz[:, 1].astype(np.float32), "z": xyz[:, 2].astype(np.float32),
                                 "id": np.arange(points, dtype=np.uint32) + 10})}  # fmt: skip
    cloud = [f'<tracks path="tracks.ply" count="{points}"/>', f'<points path="points0.ply" count="{points}"/>']
    for i, m in enumerate(matrices):
        uv = np.array([project(m, x) for x in xyz] + [(1.0, 2.0)])
        ids = np.append(np.arange(points) + 10, 999).astype(np.uint32)
        parts[f"p{i}.ply"] = ply({"x": uv[:, 0], "y": uv[:, 1], "size": np.ones(len(uv), dtype=np.float32), "id": ids})
        cloud.append(f'<projections camera_id="{i}" path="p{i}.ply" count="{len(uv)}"/>')
    return "\n".join(out), "\n".join(frame), "\n".join(cloud), parts, world


def _geographic(x):
    """Longitude, latitude, height of geocentric coordinates by iteration."""
    a, e2 = 6378137.0, 0.0066943799901413165
    p = np.hypot(x[0], x[1])
    lat = np.arctan2(x[2], p * (1 - e2))
    for _ in range(20):
        n = a / np.sqrt(1 - e2 * np.sin(lat) ** 2)
        h = p / np.cos(lat) - n
        lat = np.arctan2(x[2], p * (1 - e2 * n / (n + h)))
    return np.degrees(np.arctan2(x[1], x[0])), np.degrees(lat), h


def zipped(path, files):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as z:
        for name, content in files.items():
            z.writestr(name, content)
    return path


def psz(folder, **options):
    chunk, frame, cloud, parts, world = scene(**options)
    body = chunk.split("\n", 1)[1].replace("<CHUNK>", '<chunk label="Chunk 1" enabled="true">').replace("</CHUNK>", "</chunk>")
    body = body.replace("<FRAMES>", f'<frames next_id="1"><frame id="0">{frame}<point_cloud>{cloud}</point_cloud></frame></frames>')
    doc = f'<?xml version="1.0" encoding="UTF-8"?>\n<document version="1.2.0">\n<chunks>\n{body}\n</chunks></document>'
    return zipped(folder / "block.psz", {"doc.xml": doc, **parts}), world


def psx(folder):
    chunk, frame, cloud, parts, world = scene()
    files = folder / "block.files"
    (files / "0" / "0" / "point_cloud").mkdir(parents=True)
    (folder / "block.psx").write_text('<document version="1.2.0" path="{projectname}.files/project.zip"/>')
    zipped(
        files / "project.zip",
        {"doc.xml": '<document version="1.2.0"><chunks next_id="1" active_id="0"><chunk id="0" path="0/chunk.zip"/></chunks></document>'},
    )
    body = chunk.replace("<CHUNK>", '<chunk version="1.2.0" label="Chunk 1">').replace("</CHUNK>", "</chunk>")
    zipped(
        files / "0" / "chunk.zip", {"doc.xml": body.replace("<FRAMES>", '<frames next_id="1"><frame id="0" path="0/frame.zip"/></frames>')}
    )
    inner = f'<frame version="1.2.0">{frame}<point_cloud id="0" path="point_cloud/point_cloud.zip"/></frame>'
    zipped(files / "0" / "0" / "frame.zip", {"doc.xml": inner})
    zipped(
        files / "0" / "0" / "point_cloud" / "point_cloud.zip", {"doc.xml": f'<point_cloud version="1.2.0">{cloud}</point_cloud>', **parts}
    )
    return folder / "block.psx", world


def xml(folder):
    chunk, frame, _, _, world = scene()
    body = chunk.split("\n", 1)[1].replace("<CHUNK>", '<chunk label="Chunk 1" enabled="true">').replace("</CHUNK>", "</chunk>")
    body = body.replace("<FRAMES>", f'<frames next_id="1"><frame id="0">{frame}</frame></frames>')
    (folder / "cameras.xml").write_text(f'<?xml version="1.0" encoding="UTF-8"?>\n<document version="1.5.0">\n{body}\n</document>')
    return folder / "cameras.xml", world


def misclosures(network):
    state = State.of(network)
    return np.concatenate([g.misclosures(network, state).ravel() for g in network.observations])


@pytest.mark.parametrize("make", [psz, psx, xml])
def test_the_documented_projection_gives_zero_residuals(tmp_path, make):
    path, world = make(tmp_path)
    assert recognise(path).name == "metashape"
    network = read(path)
    assert network.unit == "m"
    assert network.images.labels == ("I0", "I1", "I2", "I3")
    assert np.abs(misclosures(network)).max() < 2e-4 if make is xml else np.abs(misclosures(network)).max() < 1e-6
    ties = 0 if make is xml else 14
    assert len(network.points.labels) == ties + 4
    np.testing.assert_allclose(network.points.coordinates[ties:], world[:4], atol=1e-7)
    assert network.points.roles[ties:].tolist() == [CONTROL, CONTROL, CONTROL, CHECK]
    np.testing.assert_array_equal(network.points.sigmas[ties], 0.02)
    np.testing.assert_array_equal(network.points.sigmas[ties + 1], 0.01)
    marks = network.observations[-1]
    assert len(marks) == 15  # one projection was not pinned
    assert set(marks.sigmas.ravel()) == {0.3}
    if ties:
        assert set(network.observations[0].sigmas.ravel()) == {0.8}
    free = [n for n, s in zip(network.cameras[0].model.order, network.cameras[0].states, strict=True) if s]
    assert free == ["principal_distance", "principal_point_x", "principal_point_y", "K1", "K2", "P1"]


def test_what_is_assumed_is_said(tmp_path):
    network = read(psz(tmp_path, settings=False, covariance=False)[0])
    said = "\n".join(network.assumptions)
    for words in ("accuracy_tiepoints is not said: 1", "what was estimated is not said", "1 camera(s) that are disabled or not aligned",
                  "4 projection(s) of tracks without a tie point", "1 marker projection(s) that are not pinned"):  # fmt: skip
        assert words in said


def test_geographic_coordinates(tmp_path):
    path, world = psz(tmp_path, crs=WGS84)
    network = read(path)
    assert np.abs(misclosures(network)).max() < 1e-3
    distance = np.linalg.norm(network.points.coordinates[0] - network.points.coordinates[1])
    assert distance == pytest.approx(np.linalg.norm(world[0] - world[1]), abs=1e-6)
    assert any("touches the ellipsoid at latitude" in a for a in network.assumptions)


def test_projected_coordinates_need_the_extra(tmp_path):
    path, _ = psz(tmp_path, crs='PROJCS["WGS 84 / UTM zone 32N",GEOGCS["WGS 84"]]')
    try:
        import pyproj  # noqa: F401
    except ImportError:
        with pytest.raises(MissingExtra, match="'geo' extra"):
            read(path)


def test_without_a_transform_the_markers_carry_the_model_over(tmp_path):
    network = read(psz(tmp_path, transform=False)[0])
    assert network.unit == "m"
    assert np.abs(misclosures(network)).max() < 1e-3


def test_adjustment(tmp_path):
    result = baarda.adjust(read(psz(tmp_path)[0]), camera="principal_distance")
    assert result.status == "converged"
    assert result.objective < 1e-6


def change(path, old, new, part="doc.xml"):
    with zipfile.ZipFile(path) as z:
        files = {n: z.read(n) for n in z.namelist()}
    assert old.encode() in files[part]
    files[part] = files[part].replace(old.encode(), new.encode(), 1)
    path.unlink()
    return zipped(path, files)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('type="frame">', 'type="fisheye">', "sensor type 'fisheye' is not supported"),
        ("<f>", "<fx>1</fx><f>", "fx and fy"),
        ("<p1>", "<p3>1</p3><p1>", "<p3>: this coefficient is not supported"),
        ("<f>700.0</f>", "<f>-700.0</f>", "must be positive"),
        ("<f>700.0</f>", "<f>nan</f>", "not finite"),
        ('sensor_id="0" label="I1"', 'sensor_id="7" label="I1"', "sensor '7' is not among"),
        ('label="I1"', 'label="I0"', "camera 'I0' appears twice"),
        ('label="I1"', 'label="I&#9;1"', "control character"),
        ('marker_id="2"', 'marker_id="9"', "marker '9' is not among"),
        ('path="p1.ply"', 'path="../p1.ply"', "the archive has no part"),
        ('camera_id="2" path="p2.ply"', 'camera_id="1" path="p2.ply"', "measured twice"),
        ("<document ", "<!DOCTYPE a [<!ENTITY b 'c'>]><document ", "document type"),
        ("</sensors>", "", "not well-formed"),
        ("<sensors", "<a>" * 50 + "<sensors", "nested more than"),
    ],
)
def test_damaged_archives_are_refused_with_the_line(tmp_path, old, new, words):
    path = change(psz(tmp_path)[0], old, new)
    with pytest.raises(InputError, match=words) as caught:
        read(path, format="metashape")
    assert caught.value.line is not None or "no part" in words


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("vertex 14", "vertex 140000", "truncated"),
        ("float x", "list x", "not supported"),
        ("ply\n", "plx\n", "not a PLY"),
        ("uint id", "uint no", "no property 'id'"),
    ],
)
def test_damaged_tie_points(tmp_path, old, new, words):
    path = change(psz(tmp_path)[0], old, new, "points0.ply")
    with pytest.raises(InputError, match=words):
        read(path, format="metashape")


def test_an_archive_that_unpacks_to_far_more_is_refused(tmp_path):
    path = zipped(tmp_path / "bomb.psz", {"doc.xml": b"<document version='1'><chunk " + b" " * 400_000_000})
    assert path.stat().st_size < 1_000_000
    with pytest.raises(InputError, match="the limit is"):
        read(path, format="metashape")


def test_an_archive_cut_short(tmp_path):
    path, _ = psz(tmp_path)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match="not a zip archive"):
        read(path, format="metashape")


def test_paths_of_a_project_stay_in_its_folder(tmp_path):
    path, _ = psx(tmp_path)
    for hostile in ("../../etc/chunk.zip", "/etc/passwd", "0/../../x.zip", "C:\\x.zip"):
        zipped(
            tmp_path / "block.files" / "project.zip",
            {"doc.xml": f'<document version="1"><chunks><chunk id="0" path="{hostile}"/></chunks></document>'},
        )
        with pytest.raises(InputError, match="not a plain path"):
            read(path)


def test_cameras_alone_have_no_image_points(tmp_path):
    path, _ = xml(tmp_path)
    text = path.read_text()
    path.write_text(text[: text.index("<frames")] + text[text.index("</frames>") + 9 :])
    with pytest.raises(InputError, match="an export of cameras alone has none"):
        read(path)
