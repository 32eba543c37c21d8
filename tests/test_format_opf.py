"""OPF projects written by pyopf, the library of the format's makers: projection, control, positions, hostile paths, damaged buffers."""

import datetime
import json

import numpy as np
import pytest

import baarda
from baarda.errors import InputError
from baarda.formats import read, recognise, write
from baarda.formats.camera_positions import with_camera_positions
from baarda.network import CHECK, CONTROL, State
from baarda.observations import CameraPositions, Distances

W, H = 4000, 3000
F, CENTRE = 3100.0, (2010.5, 1490.25)
RADIAL, TANGENTIAL = (-0.11, 0.08, -0.02), (1e-3, -7e-4)
SHIFT = np.array([-450000.0, -5400000.0, -250.0])  # of the scene reference frame


def angles_to_scene(omega, phi, kappa):
    """R_x(omega) R_y(phi) R_z(kappa), as the specification of the camera formats states it."""
    so, co, sp, cp, sk, ck = (f(v) for v in (omega, phi, kappa) for f in (np.sin, np.cos))
    x = np.array([[1, 0, 0], [0, co, -so], [0, so, co]])
    y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    z = np.array([[ck, -sk, 0], [sk, ck, 0], [0, 0, 1]])
    return x @ y @ z


def project(rotation, centre, point):
    """The projection of pyopf's example compute_reprojection_error."""
    right_down_front = np.diag([1.0, -1.0, -1.0]) @ rotation.T @ (point - centre)
    assert right_down_front[2] > 0
    x, y = right_down_front[:2] / right_down_front[2]
    r = x * x + y * y
    d = 1.0 + r * RADIAL[0] + r**2 * RADIAL[1] + r**3 * RADIAL[2]
    t1, t2 = TANGENTIAL
    return [
        F * (d * x + 2 * t1 * x * y + t2 * (r + 2 * x * x)) + CENTRE[0],
        F * (d * y + 2 * t2 * x * y + t1 * (r + 2 * y * y)) + CENTRE[1],
    ]


def truth():
    """Points and poses in the processing system (recentred)."""
    rng = np.random.default_rng(8)
    xyz = np.stack([rng.uniform(-40, 40, 40), rng.uniform(-35, 35, 40), rng.uniform(-4, 4, 40)], axis=1).astype(np.float32).astype(float)
    poses = []
    for i in range(6):
        angles = np.array([rng.uniform(-0.1, 0.1), rng.uniform(-0.1, 0.1), 0.3 + np.pi * (i // 3)])
        poses.append((angles, np.array([-20.0 + 20.0 * (i % 3), -12.0 + 24.0 * (i // 3), 60.0 + i])))
    return xyz, poses


def scene(folder, noise=0.0, gcps=4, checkpoints=1, tracks=True, with_gps=True):
    """Write a project by pyopf; return its file."""
    pytest.importorskip("pyopf", reason="the oracle pyopf is not installed")
    from pyopf.cameras import CalibratedCamera, CalibratedCameras, CalibratedSensor, CameraData, CameraList, InputCameras
    from pyopf.cameras.input_cameras import (
        BandInformation,
        Camera,
        Capture,
        ModelSource,
        PixelType,
        RigModelSource,
        Sensor,
        ShutterType,
        StaticPixelRange,
    )
    from pyopf.cameras.projected_input_cameras import ProjectedCapture, ProjectedGeolocation, ProjectedInputCameras
    from pyopf.cameras.sensor_internals import PerspectiveInternals
    from pyopf.cps import Constraints, InputControlPoints, ProjectedControlPoints
    from pyopf.cps.constraints import ScaleConstraint
    from pyopf.cps.input_control_points import Gcp, Mark
    from pyopf.cps.projected_control_points import ProjectedGcp
    from pyopf.crs import BaseToTranslatedCanonicalCrsTransform, Crs, Geolocation, SceneReferenceFrame
    from pyopf.io import save
    from pyopf.pointcloud import GlTFPointCloud
    from pyopf.pointcloud.pcl import ImagePoints, Matches, Node, PointIndexRanges, opf_axis_rotation_matrix
    from pyopf.project import Calibration, Metadata, ProjectObjects
    from pyopf.project.types import CoreProjectItemType
    from pyopf.uid64 import Uid64

    rng = np.random.default_rng(9)
    xyz, poses = truth()
    uid = lambda k: Uid64(int=10**18 + k)  # noqa: E731  64 bits do not fit a double
    sensor = Uid64(int=77)
    internals = PerspectiveInternals(np.array(CENTRE), F, np.array(RADIAL), np.array(TANGENTIAL))
    image_points, point_of, camera_of = [], [], []
    rotations = [angles_to_scene(*a) for a, _ in poses]
    ranges = []
    for k, x in enumerate(xyz):
        start = len(image_points)
        for i, (_, c) in enumerate(poses):
            px = np.array(project(rotations[i], c, x)) + noise * rng.standard_normal(2)
            if (px > 0).all() and (px < [W, H]).all():
                image_points.append(px)
                camera_of.append(i)
                point_of.append(k)
        ranges.append((start, len(image_points) - start))

    cloud = GlTFPointCloud()
    node = Node()
    offset = np.array([3.0, -2.0, 1.0])  # the node's own frame
    up = opf_axis_rotation_matrix.astype(float)
    node.matrix = np.eye(4)
    node.matrix[:3, 3] = up[:3, :3] @ offset
    node.position = ((xyz - offset) @ up[:3, :3].T).astype(np.float32)
    node.matches = Matches()
    node.matches.camera_uids = [uid(i) for i in range(len(poses))]
    node.matches.camera_ids = np.array(camera_of, dtype=np.uint32)
    node.matches.point_index_ranges = PointIndexRanges(np.zeros((len(xyz), 2), dtype=np.uint32))
    for k, r in enumerate(ranges):
        node.matches.point_index_ranges[k] = r
    node.matches.image_points = ImagePoints()
    node.matches.image_points.featureIds = np.arange(len(camera_of), dtype=np.uint32)
    node.matches.image_points.pixelCoordinates = np.array(image_points, dtype=np.float32)
    node.matches.image_points.scales = np.ones(len(camera_of), dtype=np.float32)
    cloud.nodes = [node]

    crs = Crs("EPSG:32632")
    control = []
    for k in range(gcps + checkpoints):
        marks = [
            Mark(0.5, int(uid(i)), np.array(project(rotations[i], c, xyz[k])) + 0.5 * noise * rng.standard_normal(2))
            for i, (_, c) in enumerate(poses)
            if (np.array(project(rotations[i], c, xyz[k])) > 0).all() and (np.array(project(rotations[i], c, xyz[k])) < [W, H]).all()
        ]
        control.append(Gcp(f"gcp{k}", Geolocation(xyz[k] - SHIFT, crs, np.array([0.01, 0.01, 0.02])), k >= gcps, marks))
    project_objects = ProjectObjects()
    project_objects.metadata.name = "flight"
    meta = lambda kind: Metadata(type=kind)  # noqa: E731
    kinds = CoreProjectItemType

    def put(name, obj, kind):
        obj.metadata = meta(kind)
        getattr(project_objects, f"{name}_objs").append(obj)

    put(
        "scene_reference_frame",
        SceneReferenceFrame(BaseToTranslatedCanonicalCrsTransform(np.ones(3), SHIFT, False), crs),
        kinds.SCENE_REFERENCE_FRAME,
    )
    put("camera_list", CameraList([CameraData(uid(i), f"images/IMG%20{i}.JPG") for i in range(len(poses))]), kinds.CAMERA_LIST)
    bands = [BandInformation(1.0, "grey")]
    sensors = [Sensor(sensor, "body", bands, np.array([W, H]), internals, 3.2, ShutterType.GLOBAL)]
    when = datetime.datetime(2026, 1, 1, tzinfo=datetime.UTC)
    shots = [
        Capture(
            Uid64(int=500 + i),
            [Camera(uid(i), ModelSource.USER, StaticPixelRange(0.0, 255.0), PixelType.UINT8, sensor)],
            None,
            uid(i),
            RigModelSource.USER,
            when,
        )
        for i in range(len(poses))
    ]
    put("input_cameras", InputCameras(shots, sensors), kinds.INPUT_CAMERAS)
    if with_gps:
        gps = [
            ProjectedCapture(Uid64(int=500 + i), ProjectedGeolocation(c + 0.02 * rng.standard_normal(3), np.array([0.02, 0.02, 0.04])))
            for i, (_, c) in enumerate(poses)
        ]
        put("projected_input_cameras", ProjectedInputCameras(gps, []), kinds.PROJECTED_INPUT_CAMERAS)
    if gcps:
        put("input_control_points", InputControlPoints(control, []), kinds.INPUT_CONTROL_POINTS)
        projected = [ProjectedGcp(f"gcp{k}", xyz[k], np.array([0.01, 0.01, 0.02])) for k in range(len(control))]
        put("projected_control_points", ProjectedControlPoints(projected), kinds.PROJECTED_CONTROL_POINTS)
        length = float(np.linalg.norm(xyz[0] - xyz[1]))
        put("constraints", Constraints([], [ScaleConstraint("bar", "gcp0", "gcp1", length, 0.01)]), kinds.CONSTRAINTS)
    calibration = Calibration()
    calibration.metadata = meta(kinds.CALIBRATION)
    poses_out = [CalibratedCamera(uid(i), sensor, np.degrees(a), c) for i, (a, c) in enumerate(poses)]
    calibration.calibrated_cameras_objs.append(CalibratedCameras(poses_out, [CalibratedSensor(sensor, internals)]))
    if tracks:
        calibration.point_cloud_objs.append(cloud)
    project_objects.calibration_objs.append(calibration)
    target = folder / "project.opf"
    save(project_objects, str(target), write_point_cloud_buffers=True)
    return target


def test_the_documented_projection_gives_zero_residuals(tmp_path):
    path = scene(tmp_path)
    assert recognise(path).name == recognise(tmp_path).name == "opf"
    network = read(tmp_path)
    assert network.images.labels[0] == "IMG 0.JPG" and network.name == "flight"
    xyz, poses = truth()
    tie, marks, bar = network.observations
    state = State.of(network)
    assert np.abs(tie.misclosures(network, state)).max() < 3e-4  # single precision of pixels up to 4000
    assert np.abs(marks.misclosures(network, state)).max() < 1e-2  # a track's start is not a control point's
    assert isinstance(bar, Distances) and abs(bar.misclosures(network, state)).max() < 1e-4
    np.testing.assert_allclose(network.images.position[2], poses[2][1] - SHIFT, atol=1e-6)
    control = network.points.roles == CONTROL
    assert control.sum() == 4 and (network.points.roles == CHECK).sum() == 1
    np.testing.assert_allclose(network.points.given[control][0], xyz[0] - SHIFT, atol=1e-6)
    assert network.points.sigmas[control][0].tolist() == [0.01, 0.01, 0.02] and (marks.sigmas == 0.5).all()
    assert network.cameras[0].image_size == (W, H) and network.cameras[0].model.name == "pix4d"


def test_adjusts_and_reads_back_as_a_project(tmp_path):
    scene(tmp_path, noise=1.0)
    network = read(tmp_path)
    result = baarda.adjust(network)
    assert result.status == "converged" and 0.8 < result.sigma0 < 1.2
    write(network, tmp_path / "own", "project")
    again = read(tmp_path / "own")
    ours, theirs = (n.observations[0].misclosures(n, State.of(n)) for n in (network, again))
    np.testing.assert_allclose(ours, theirs, atol=1e-6)


def test_measured_positions_of_the_project_become_observations(tmp_path):
    scene(tmp_path, noise=1.0, gcps=0, checkpoints=0)
    network = with_camera_positions(read(tmp_path), "source")
    group = network.observations[-1]
    assert isinstance(group, CameraPositions) and len(group) == 6
    np.testing.assert_allclose(group.sigma()[0], [0.02, 0.02, 0.04])
    np.testing.assert_allclose(group.values[0], truth()[1][0][1] - SHIFT, atol=0.1)
    assert baarda.adjust(network).status == "converged"


def change(path, edit):
    data = json.loads(path.read_text())
    edit(data)
    path.write_text(json.dumps(data, indent=1))


@pytest.mark.parametrize(
    "uri", ["../secret.json", "/etc/passwd", "file:///etc/passwd", "https://x.org/a.json", "%2e%2e/a.json", "a\\..\\..\\b", ""]
)
def test_paths_lead_nowhere_else(tmp_path, uri):
    path = scene(tmp_path)

    def edit(data):
        next(r for i in data["items"] for r in i["resources"] if "calibrated-cameras" in r["format"])["uri"] = uri

    change(path, edit)
    with pytest.raises(InputError, match=r"must be a path inside|leads out|is empty"):
        read(path)


def test_links_lead_nowhere_else(tmp_path):
    path = scene(tmp_path)
    outside = tmp_path.parent / f"{tmp_path.name}-outside.json"
    file = tmp_path / "camera_list.json"
    outside.write_text(file.read_text())
    file.unlink()
    file.symlink_to(outside)
    with pytest.raises(InputError, match="leads out of the folder"):
        read(path)
    outside.unlink()


@pytest.mark.parametrize(
    ("name", "edit", "words"),
    [
        ("project.opf", lambda d: d.update(version="2.0"), "version '2.0' of OPF"),
        ("calibrated_cameras.json", lambda d: d["sensors"][0]["internals"].update(type="fisheye"), "'fisheye' are not supported"),
        ("calibrated_cameras.json", lambda d: d["sensors"][0]["internals"].update(focal_length_px=-1), "must be positive"),
        ("calibrated_cameras.json", lambda d: d["cameras"][0].update(sensor_id=5), "sensor 5 is not among"),
        ("input_control_points.json", lambda d: d["gcps"][0]["marks"][0].update(accuracy=0), "accuracy must be positive"),
        ("projected_control_points.json", lambda d: d["projected_gcps"][0].update(sigmas=[0, 1, 1]), "must be positive"),
        ("point_cloud.gltf", lambda d: d["accessors"][0].update(count=10**9), "announced"),
        ("point_cloud.gltf", lambda d: d["buffers"][0].update(uri="../../../etc/passwd"), "leads out|must be the path"),
        ("point_cloud.gltf", lambda d: d["accessors"][0].update(componentType=5125), "must be 3 value"),
    ],
)
def test_damaged_files_are_refused_with_the_file(tmp_path, name, edit, words):
    path = scene(tmp_path)
    file = next(tmp_path.rglob(name))
    change(file, edit)
    with pytest.raises(InputError, match=words) as caught:
        read(path, format="opf")
    assert caught.value.file == str(file) or name.endswith("gltf")


def test_damaged_buffers_are_refused(tmp_path):
    path = scene(tmp_path)
    ranges = next(tmp_path.rglob("matchPointIndexRanges.bin"))
    good = ranges.read_bytes()
    ranges.write_bytes(b"\xff" * len(good))
    with pytest.raises(InputError, match="beyond"):
        read(path)
    ranges.write_bytes(good[:-8])
    with pytest.raises(InputError, match="truncated"):
        read(path)
