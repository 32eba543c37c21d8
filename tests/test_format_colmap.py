"""COLMAP models: the reference model, pycolmap as oracle, text and binary alike, truncated and broken files."""

import shutil
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import baarda.formats as formats
from baarda import cameras
from baarda.cameras import FIXED, FREE
from baarda.errors import InputError, OutputError, UsageError
from baarda.formats.colmap import colmap
from baarda.formats.colmap_model import CAMERA_MODELS
from baarda.network import Images, Network, Points, State
from baarda.observations import ImagePoints
from conftest import data_folder
from networks import ring, with_distances

SMALL = {
    "cameras.txt": "# Camera list\n# Number of cameras: 2\n7 SIMPLE_RADIAL 1000 800 900 500 400 -0.1\n3 PINHOLE 1000 800 900 910 500 400\n",
    "images.txt": "# Image list\n# Number of images: 2, mean observations per image: 2.5\n"
    "20 1 0 0 0 0.5 0 0 7 folder/b c.jpg\n100.5 200.25 9 300 400 -1 500 600 4000000000\n"
    "5 0.7071067811865476 0 0.7071067811865475 0 0 0 1 3 a.jpg\n1 2 9 3 4 11 5 6 4000000000\n",
    "points3D.txt": "# Points\n# Number of points: 3, mean track length: 1.67\n"
    "11 1 2 3 0 0 0 0.5 5 1\n4000000000 4 5 6 1 2 3 0.5 20 2 5 2\n9 7 8 9 255 255 255 -1 20 0 5 0\n",
}


def written(where, **changes):
    """Write the small text model, some files changed."""
    where.mkdir(exist_ok=True)
    for name, text in {**SMALL, **{k.replace("__", "."): v for k, v in changes.items()}}.items():
        if text is not None:
            (where / name).write_bytes(text.encode() if isinstance(text, str) else text)
    return where


def binary(where, model="SIMPLE_RADIAL", order="<"):
    """Write a small binary model by hand: the layout of COLMAP's documentation."""
    where.mkdir(exist_ok=True)
    code = {name: k for k, name in CAMERA_MODELS.items()}[model]
    pack = lambda layout, *v: struct.pack(order + layout, *v)  # noqa: E731
    (where / "cameras.bin").write_bytes(pack("Q", 1) + pack("IiQQ4d", 7, code, 1000, 800, 900.0, 500.0, 400.0, -0.1))
    image = pack("I7dI", 20, 1.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 7) + b"b.jpg\0" + pack("Q", 2)
    image += pack("ddQ", 100.5, 200.25, 9) + pack("ddQ", 3.0, 4.0, 2**64 - 1)
    (where / "images.bin").write_bytes(pack("Q", 1) + image)
    (where / "points3D.bin").write_bytes(pack("Q", 1) + pack("Q3d3BdQ", 9, 7.0, 8.0, 9.0, 1, 2, 3, 0.5, 1) + pack("II", 20, 0))
    return where


def residuals(network):
    group = network.observations[0]
    return group.misclosures(network, State.of(network))


# ------------------------------------------------------------------------------------------------------------- reference


def test_the_reference_model():
    n = formats.read(data_folder("colmap_sceaux_txt"))
    assert n.format == "colmap" and n.unit == "model units" and dict(n.settings) == {"first_pixel": 0.5}
    assert (len(n.images.labels), len(n.points.labels), len(n.observations[0])) == (11, 7862, 37123)
    camera = n.cameras[0]
    assert camera.model.name == "SIMPLE_RADIAL" and camera.values.tolist() == [2971.71, 1416.0, 1064.0, -0.164224]
    assert camera.states.tolist() == [FREE, FIXED, FIXED, FREE]
    group = n.observations[0]
    length = np.linalg.norm(residuals(n), axis=1)
    mean = (np.bincount(group.points, length) / np.bincount(group.points)).mean()
    assert mean == pytest.approx(0.604344, abs=5e-5)  # the text model is rounded to six digits; pycolmap finds 0.604365 in it
    assert group.in_front(n, State.of(n)).all() and (group.sigmas == 1.0).all()
    said = " ".join(n.assumptions)
    for part in ("image sigma 1 px", "principal points are fixed", "79314 image point(s)", "159 image point(s) measure a point"):
        assert part in said


def test_small_model_by_hand(tmp_path):
    n = formats.read(written(tmp_path / "m"))
    assert [c.label for c in n.cameras] == ["3", "7"] and [c.model.name for c in n.cameras] == ["PINHOLE", "SIMPLE_RADIAL"]
    assert n.images.labels == ("a.jpg", "folder/b c.jpg") and n.images.cameras.tolist() == [0, 1]
    assert n.points.labels == ("9", "11", "4000000000") and n.points.coordinates[0].tolist() == [7.0, 8.0, 9.0]
    # image b: R = I, t = (0.5, 0, 0), so the centre is (-0.5, 0, 0); ours looks along -z with y up
    np.testing.assert_allclose(n.images.position[1], [-0.5, 0, 0], atol=1e-15)
    np.testing.assert_allclose(n.images.rotation[1], np.diag([1, -1, -1]), atol=1e-15)
    # image a: a turn by 90 degrees about y, which takes world z to camera x; t = (0, 0, 1) is world -x, the centre (1, 0, 0)
    np.testing.assert_allclose(n.images.position[0], [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(n.images.rotation[0] @ [0, 0, 1], [1, 0, 0], atol=1e-15)
    group = n.observations[0]
    assert group.images.tolist() == [0, 0, 0, 1, 1] and group.points.tolist() == [0, 1, 2, 0, 2]
    assert group.xy[3].tolist() == [100.5, 200.25]  # pixel coordinates stay as they are
    assert "1 image point(s) without object point left out" in n.assumptions
    assert not any("disagree" in a for a in n.assumptions)


def test_small_binary_model_by_hand(tmp_path):
    n = formats.read(binary(tmp_path / "m"))
    assert n.images.labels == ("b.jpg",) and n.points.labels == ("9",) and n.observations[0].xy.tolist() == [[100.5, 200.25]]
    assert n.cameras[0].values.tolist() == [900.0, 500.0, 400.0, -0.1] and n.cameras[0].image_size == (1000.0, 800.0)


def test_the_binary_model_wins_and_it_is_said(tmp_path):
    where = binary(written(tmp_path / "m"))
    n = formats.read(where)
    assert n.images.labels == ("b.jpg",) and any("binary one is used" in a for a in n.assumptions)


def test_recognised_by_content(tmp_path):
    assert colmap.recognises(written(tmp_path / "t")) and colmap.recognises(binary(tmp_path / "b"))
    assert not colmap.recognises(tmp_path) and not colmap.recognises(tmp_path / "t" / "cameras.txt")
    other = written(tmp_path / "other", cameras__txt="camera;model\n1;x\n")
    assert not colmap.recognises(other)
    with pytest.raises(InputError, match="points3D is missing"):
        formats.read(written(tmp_path / "no_points", points3D__txt=None))


# ---------------------------------------------------------------------------------------------------------------- oracle


@pytest.mark.parametrize("model", ["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"])
@pytest.mark.parametrize("rigs", [1, 2])
def test_against_pycolmap(model, rigs, tmp_path):
    pycolmap = pytest.importorskip("pycolmap", reason="the oracle pycolmap is not installed (extra 'oracle')")
    parameters = {
        "SIMPLE_PINHOLE": [1280.0, 512, 384],
        "PINHOLE": [1280.0, 1290, 512, 384],
        "SIMPLE_RADIAL": [1280.0, 512, 384, -0.05],
        "RADIAL": [1280.0, 512, 384, -0.05, 0.02],
        "OPENCV": [1280.0, 1290, 512, 384, -0.05, 0.02, 1e-3, -2e-3],
        "FULL_OPENCV": [1280.0, 1290, 512, 384, -0.05, 0.02, 1e-3, -2e-3, 0.01, 0.02, -0.01, 0.005],
    }[model]
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 2, rigs, 3, 40
    options.camera_model_id = getattr(pycolmap.CameraModelId, model)
    options.camera_params = parameters
    made = pycolmap.synthesize_dataset(options)
    made.delete_point3D(sorted(made.points3D)[3])  # ids with a gap
    networks = {}
    for kind, write in (("txt", made.write_text), ("bin", made.write_binary)):
        where = tmp_path / kind
        where.mkdir()
        write(str(where))
        assert (where / f"rigs.{kind}").is_file() and (where / f"frames.{kind}").is_file()
        networks[kind] = formats.read(where)
    for kind, n in networks.items():
        assert len(n.images.labels) == made.num_reg_images() == 6 * rigs
        assert any("rig(s) of several cameras" in a for a in n.assumptions) == (rigs > 1), kind
        expected = {image.name: image for image in made.images.values()}
        for i, label in enumerate(n.images.labels):
            image = expected[label]
            np.testing.assert_allclose(n.images.position[i], image.projection_center(), rtol=0, atol=1e-13)
            matrix = image.cam_from_world().rotation.matrix()
            np.testing.assert_allclose(n.images.rotation[i], np.diag([1, -1, -1]) @ matrix, rtol=0, atol=1e-14)
            assert n.cameras[n.images.cameras[i]].label == str(image.camera_id)
        group, at = n.observations[0], 0
        computed = group.xy - residuals(n)
        for i, label in enumerate(n.images.labels):
            image = expected[label]
            seen = [p for p in image.points2D if p.has_point3D()]
            rows = slice(at, at + len(seen))
            assert (group.images[rows] == i).all()
            assert [n.points.labels[p] for p in group.points[rows]] == [str(p.point3D_id) for p in seen]
            np.testing.assert_array_equal(group.xy[rows], [p.xy for p in seen])
            projected = [image.project_point(made.points3D[p.point3D_id].xyz) for p in seen]
            np.testing.assert_allclose(computed[rows], projected, rtol=0, atol=1e-9)
            at += len(seen)
        assert at == len(group) == made.compute_num_observations()
    text, bin_ = networks["txt"], networks["bin"]
    assert text.images.rotation.tobytes() == bin_.images.rotation.tobytes()
    assert text.points.coordinates.tobytes() == bin_.points.coordinates.tobytes()
    assert text.assumptions == bin_.assumptions


def test_pycolmap_reads_what_we_write(tmp_path):
    pycolmap = pytest.importorskip("pycolmap", reason="the oracle pycolmap is not installed (extra 'oracle')")
    n = _writable()
    colmap.write(n, tmp_path / "m")
    model = pycolmap.Reconstruction(str(tmp_path / "m"))
    model.update_point_3d_errors()
    length = np.linalg.norm(residuals(n), axis=1)
    group = n.observations[0]
    assert model.num_reg_images() == 6 and model.num_points3D() == 24 and model.compute_num_observations() == len(group)
    mean = (np.bincount(group.points, length) / np.bincount(group.points)).mean()
    assert model.compute_mean_reprojection_error() == pytest.approx(mean, rel=1e-9)


# --------------------------------------------------------------------------------------------------------------- writing


def _writable():
    values = {"principal_distance": 1000.0, "principal_point_x": 505.0, "principal_point_y": 396.0, "k1": -0.05}
    return ring(model="SIMPLE_RADIAL", values=values, free=("principal_distance", "k1"), seed=5, keep=0.8)


def test_what_we_write_reads_back(tmp_path):
    n = _writable()
    formats.write(n, tmp_path / "m", "colmap")
    again = formats.read(tmp_path / "m")
    assert again.images.labels == n.images.labels
    np.testing.assert_allclose(again.images.rotation, n.images.rotation, rtol=0, atol=1e-15)
    np.testing.assert_allclose(again.images.position, n.images.position, rtol=1e-14)
    assert again.points.coordinates.tobytes() == n.points.coordinates.tobytes()
    assert again.cameras[0].values.tobytes() == n.cameras[0].values.tobytes()
    assert again.observations[0].xy.tobytes() == n.observations[0].xy.tobytes()
    assert not any("disagree" in a for a in again.assumptions)
    with pytest.raises(OutputError):
        formats.write(n, tmp_path / "m", "colmap")


@pytest.mark.parametrize(
    ("network", "message"),
    [
        (ring(), "COLMAP has no model 'brown'"),
        (ring(model="SIMPLE_RADIAL", values={"principal_distance": 900.0}, free=(), start=False), "has no orientation"),
        (with_distances(_writable(), [(0, 1)]), "image points only"),
        (replace(_writable(), cameras=(replace(_writable().cameras[0], image_size=None),)), "the image size"),
        (replace(_writable(), images=replace(_writable().images, labels=("#", *"bcdef"))), "cannot hold this name"),
    ],
)
def test_what_cannot_be_written(network, message, tmp_path):
    with pytest.raises(UsageError, match=message):
        colmap.write(network, tmp_path / "m")
    assert list(tmp_path.iterdir()) == []


# ----------------------------------------------------------------------------------------------------------- broken input


def edited(name, old, new):
    assert old in SMALL[name]
    return {name.replace(".", "__"): SMALL[name].replace(old, new)}


BROKEN = {
    "empty file": ({"images__txt": ""}, "images.txt", None, "empty"),
    "no images": ({"images__txt": "# none\n"}, "images.txt", None, "no images"),
    "not text": ({"images__txt": b"\xff\xfe1 2\n"}, "images.txt", 1, "UTF-8"),
    "unsupported model": (edited("cameras.txt", "PINHOLE", "FOV"), "cameras.txt", 4, "model FOV is not supported"),
    "model of others": (edited("cameras.txt", "PINHOLE", "brown"), "cameras.txt", 4, "model brown is not supported"),
    "parameter missing": (edited("cameras.txt", " 400 -0.1", " 400"), "cameras.txt", 3, "has 4 parameters, found are 3"),
    "camera cut": (edited("cameras.txt", "1000 800 900 910 500 400\n", "1000"), "cameras.txt", 4, "the line has 3 fields"),
    "focal length": (edited("cameras.txt", "900 500", "-900 500"), "cameras.txt", 3, "must be positive"),
    "NaN parameter": (edited("cameras.txt", "-0.1", "nan"), "cameras.txt", 3, "not finite: 'nan'"),
    "camera twice": (edited("cameras.txt", "3 PINHOLE", "7 PINHOLE"), "cameras.txt", 4, "camera 7 appears twice (first in line 3)"),
    "camera count": (edited("cameras.txt", "cameras: 2", "cameras: 3"), "cameras.txt", 4, "announces 3 cameras, the file holds 2"),
    "width": (edited("cameras.txt", "7 SIMPLE_RADIAL 1000", "7 SIMPLE_RADIAL 0"), "cameras.txt", 3, "width and height"),
    "unknown camera": (edited("images.txt", "0 0 7 folder", "0 0 8 folder"), "images.txt", 3, "unknown camera 8"),
    "image twice": (edited("images.txt", "\n20 1", "\n5 1"), "images.txt", 5, "image 5 appears twice (first in line 3)"),
    "name twice": (edited("images.txt", "a.jpg", "folder/b c.jpg"), "images.txt", 3, "appears twice (first in line 5)"),
    "image count": (edited("images.txt", "images: 2", "images: 12"), "images.txt", 6, "announces 12 images"),
    "image id": (edited("images.txt", "20 1", "x20 1"), "images.txt", 3, "image id is not a whole number"),
    "quaternion": (edited("images.txt", "20 1 0", "20 1 0.5"), "images.txt", 3, "has length 1.11803"),
    "NaN pose": (edited("images.txt", "0.5 0 0", "nan 0 0"), "images.txt", 3, "not finite"),
    "points cut": (edited("images.txt", " 4000000000\n5", "\n5"), "images.txt", 4, "not a multiple of 3"),
    "points line missing": (edited("images.txt", "1 2 9 3 4 11 5 6 4000000000\n", ""), "images.txt", 5, "is missing"),
    "not a number": (edited("images.txt", "100.5", "1OO.5"), "images.txt", 4, "not a number: '1OO.5'"),
    "NaN measurement": (edited("images.txt", "100.5", "nan"), "images.txt", 4, "not finite"),
    "id of a point": (edited("images.txt", " 9 300", " nine 300"), "images.txt", 4, "not the id of a point: 'nine'"),
    "unknown point": (edited("images.txt", " 9 300", " 10 300"), "images.txt", 3, "measures point 10, which points3D.txt does not hold"),
    "image without points": (edited("images.txt", "1 2 9 3 4 11 5 6 4000000000", ""), "images.txt", 5, "'a.jpg' has no image points"),
    "point cut": (edited("points3D.txt", "9 7 8 9 255 255 255 -1 20 0 5 0\n", "9 7 8"), "points3D.txt", 5, "the line has 3 fields"),
    "track cut": (edited("points3D.txt", "20 0 5 0\n", "20 0 5\n"), "points3D.txt", 5, "the line has 11 fields"),
    "point twice": (edited("points3D.txt", "\n11 1", "\n9 1"), "points3D.txt", 5, "point 9 appears twice (first in line 3)"),
    "NaN point": (edited("points3D.txt", "11 1 2 3", "11 1 nan 3"), "points3D.txt", 3, "not finite: 'nan'"),
    "point number": (edited("points3D.txt", "11 1 2 3", "11 1 2_0 3"), "points3D.txt", 3, "not a number: '2_0'"),
    "point count": (edited("points3D.txt", "points: 3", "points: 4"), "points3D.txt", 5, "announces 4 points"),
    "rigs": ({"rigs__txt": "1\n"}, "rigs.txt", 1, "a rig needs"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_text_is_refused_with_file_and_line(name, tmp_path):
    changes, file, line, message = BROKEN[name]
    with pytest.raises(InputError) as caught:
        formats.read(written(tmp_path / "m", **changes), format="colmap")
    assert Path(caught.value.file).name == file
    assert caught.value.line == line, str(caught.value)
    assert message in str(caught.value)


def test_text_cut_anywhere_is_refused(tmp_path):
    for name, text in SMALL.items():
        for end in range(len(text) - 1):
            if "\n" not in text[end:-1] and name == "cameras.txt" and text[end - 2 : end] in ("40", " 4"):
                continue  # 400 cut to 40 or 4 is a number like any other
            with pytest.raises(InputError):
                formats.read(written(tmp_path / "m", **{name.replace(".", "__"): text[:end]}), format="colmap")
                pytest.fail(f"{name} cut after {end} bytes was accepted: {text[:end][-40:]!r}")


def test_binary_cut_anywhere_is_refused(tmp_path):
    whole = binary(tmp_path / "whole")
    for file in sorted(whole.iterdir()):
        data = file.read_bytes()
        for end in range(len(data)):
            where = tmp_path / "cut"
            shutil.copytree(whole, where, dirs_exist_ok=True)
            (where / file.name).write_bytes(data[:end])
            with pytest.raises(InputError, match=rf"{file.name}: (byte \d+: |the file is empty)"):
                formats.read(where, format="colmap")
        (where / file.name).write_bytes(data + b"\0")
        with pytest.raises(InputError, match=rf"byte {len(data)}: 1 bytes follow"):
            formats.read(where, format="colmap")


def test_binary_with_any_byte_changed_is_read_or_refused(tmp_path):
    """No byte leads to anything but a network or an InputError, and to no large allocation."""
    whole = binary(tmp_path / "whole")
    for file in sorted(whole.iterdir()):
        data = file.read_bytes()
        for at in range(len(data)):
            changed = bytearray(data)
            changed[at] ^= 0xFF
            file.write_bytes(bytes(changed))
            try:
                assert isinstance(formats.read(whole, format="colmap"), Network)
            except InputError as error:
                assert str(whole) in str(error)
        file.write_bytes(data)


@pytest.mark.parametrize(
    ("file", "at", "layout", "value", "message"),
    [
        ("images.bin", 0, "<Q", 2**60, "byte 0: 1152921504606846976 images announced"),
        ("points3D.bin", 8 + 43, "<Q", 2**62, "track of point 9"),
        ("points3D.bin", 16, "<d", np.nan, "byte 8: point 9"),
        ("images.bin", 8 + 4, "<d", np.inf, "orientation of image 'b.jpg': not finite"),
        ("cameras.bin", 8 + 4, "<i", 5, "byte 8: camera 7: model OPENCV_FISHEYE is not supported"),
        ("cameras.bin", 8 + 4, "<i", 99, "model number 99 is not supported"),
        ("images.bin", 8 + 64, "<B", 255, "is not UTF-8"),
    ],
)
def test_broken_binary_is_refused_with_its_byte(file, at, layout, value, message, tmp_path):
    where = binary(tmp_path / "m")
    data = bytearray((where / file).read_bytes())
    struct.pack_into(layout, data, at, value)
    (where / file).write_bytes(bytes(data))
    with pytest.raises(InputError, match=message):
        formats.read(where)


def test_tracks_that_disagree_are_said(tmp_path):
    n = formats.read(written(tmp_path / "m", **edited("points3D.txt", "0.5 5 1\n", "0.5\n")))
    assert "the tracks of 1 object point(s) disagree with the images' lists of points; the images' lists are used" in n.assumptions


def test_a_point_measured_twice_in_an_image_is_kept_and_said(tmp_path):
    n = formats.read(written(tmp_path / "m", **edited("images.txt", "3 4 11", "3 4 9")))
    assert len(n.observations[0]) == 5 and any(a.startswith("1 image point(s) measure a point") for a in n.assumptions)


def test_a_text_model_is_the_same_with_other_line_ends(tmp_path):
    a = formats.read(written(tmp_path / "a"))
    b = formats.read(written(tmp_path / "b", **{k.replace(".", "__"): v.replace("\n", "\r\n") for k, v in SMALL.items()}))
    assert a.images.labels == b.images.labels and a.observations[0].xy.tobytes() == b.observations[0].xy.tobytes()
    assert a.assumptions == b.assumptions


def test_labels_that_are_no_ids_are_numbered(tmp_path):
    camera = cameras.create("the camera", cameras.model("SIMPLE_PINHOLE"), {"principal_distance": 900.0}, image_size=(1000.0, 800.0))
    n = Network(
        (camera,),
        Images.make(["x"], position=np.zeros((1, 3)), rotation=np.eye(3)[None]),
        Points.make(["p", "q", "unseen"], np.array([[0, 0, -5.0], [1, 0, -5.0], [np.nan] * 3])),
        (ImagePoints.make([0, 0], [1, 0], np.array([[1.0, 2.0], [3.0, 4.0]])),),
    )
    colmap.write(n, tmp_path / "m")
    again = colmap.read(tmp_path / "m")
    assert again.points.labels == ("1", "2") and again.cameras[0].label == "1"
    assert again.observations[0].points.tolist() == [1, 0]


@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        (
            "cameras.txt",
            "900 500 400 -0.1",
            "900 500 400 1e13",
            r"cameras.txt, line 3: camera 7: k1 = 10000000000000.0 is not finite or beyond 1e\+12",
        ),
        ("cameras.txt", "900 500 400 -0.1", "0 500 400 -0.1", r"cameras.txt, line 3: camera 7: the principal distance must be positive"),
        ("cameras.txt", "900 500 400 -0.1", "inf 500 400 -0.1", r"cameras.txt, line 3: parameters: not finite"),
        ("cameras.txt", "900 500 400 -0.1", "\u0669 500 400 -0.1", r"cameras.txt, line 3: parameters: not a number"),
        ("cameras.txt", "7 SIMPLE", "\u0667 SIMPLE", r"cameras.txt, line 3: camera id is not a whole number"),
        ("images.txt", "200.25 9 ", "200.25 \u0669 ", r"images.txt, line 4: not the id of a point"),
        ("points3D.txt", "11 1 2 3", "11 1 2 \u0663", r"points3D.txt, line 3: coordinates: not a number"),
        ("images.txt", "b c.jpg", "b\x1bc.jpg", r"images.txt, line 3: image name 'folder/b.x1bc.jpg' holds a control character"),
    ],
)
def test_values_that_no_camera_and_no_label_has(file, old, new, words, tmp_path):
    assert SMALL[file].count(old) == 1
    where = written(tmp_path / "m", **{file.replace(".", "__"): SMALL[file].replace(old, new)})
    with pytest.raises(InputError, match=words):
        colmap.read(where)


@pytest.mark.parametrize(("value", "words"), [(1e13, "beyond"), (-1.0, "must be positive"), (float("nan"), "not finite")])
def test_binary_parameters_that_no_camera_has(value, words, tmp_path):
    where = binary(tmp_path / "m")
    raw = (where / "cameras.bin").read_bytes()
    (where / "cameras.bin").write_bytes(raw.replace(struct.pack("<d", 900.0), struct.pack("<d", value)))
    with pytest.raises(InputError, match=rf"byte 8: .*camera 7.*{words}|byte 8: .*{words}.*camera 7"):
        colmap.read(where)


@pytest.mark.parametrize("make", [written, binary])
def test_only_regular_files_of_a_model_are_opened(make, tmp_path):
    where = make(tmp_path / "m")
    for file in sorted(where.glob("rigs.*")) + sorted(where.glob("points3D.*")):
        file.unlink()
        file.mkdir()
        with pytest.raises(InputError):
            colmap.read(where)
