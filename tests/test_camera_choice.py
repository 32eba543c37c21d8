"""--camera: lists, words and presets; conversion between models; own sets of a project."""

from __future__ import annotations

from dataclasses import replace
from importlib.resources import files

import numpy as np
import pytest

import baarda
from baarda import cameras
from baarda.adjustment.camera_choice import with_cameras
from baarda.cameras import FIXED, FREE, OBSERVED, Optics, create
from baarda.cameras.conversion import converted
from baarda.cameras.own_sets import Term, own_set, terms_of
from baarda.errors import InputError, UsageError
from baarda.formats.project import write
from networks import ring

BROWN = {"principal_distance": 900.0, "principal_point_x": 505.0, "principal_point_y": 396.0, "K1": 2e-8, "P1": 3e-7, "B1": 1e-4}


@pytest.fixture(scope="module")
def camcal():
    return baarda.read(files("baarda") / "data" / "camcal" / "camcaldemo.xml")


def brown(**more):
    return create("1", cameras.model("brown"), BROWN, image_size=(1000.0, 800.0), **more)


def names(camera, state):
    return {n for n, s in zip(camera.model.order, camera.states, strict=True) if s == state}


def test_words_and_lists_keep_their_meaning(camcal):
    source = camcal.cameras[0]
    assert with_cameras(camcal, None)[0] is camcal
    assert np.array_equal(with_cameras(camcal, "source")[0].cameras[0].states, source.states)
    for nothing in ((), "none"):
        assert names(with_cameras(camcal, nothing)[0].cameras[0], FIXED) == set(source.model.order)
    assert names(with_cameras(camcal, "all")[0].cameras[0], FREE) == set(source.model.order)
    for chosen in ("principal_distance, K1", ("principal_distance", "K1")):
        network, notes = with_cameras(camcal, chosen)
        assert names(network.cameras[0], FREE) == {"principal_distance", "K1"}
        assert notes == []
    more = with_cameras(camcal, "source,B2")[0].cameras[0]
    assert names(more, FREE) == names(source, FREE) | {"B2"}


def test_a_parameter_of_known_sigma_stays_observed():
    camera = replace(brown(), states=np.array([1] * 10, dtype=np.int8), sigmas=np.ones(10))
    network = replace(ring(control=4), cameras=(camera,))
    assert names(with_cameras(network, "K1")[0].cameras[0], OBSERVED) == {"K1"}
    preset = with_cameras(network, "brown+ebner12")[0].cameras[0]
    assert names(preset, OBSERVED) == set(camera.model.order)
    assert names(preset, FREE) == {f"E{k}" for k in range(1, 13)}


@pytest.mark.parametrize("preset", ["ebner12", "gruen44", "gruen12", "polynomial4", "fourier1", "brown", "opencv", "brown+ebner12"])
def test_a_preset_frees_its_additional_parameters_and_leaves_the_interior(preset):
    network = replace(ring(control=4), cameras=(brown(free=("principal_point_x",)),))
    made, notes = with_cameras(network, preset)
    camera = made.cameras[0]
    additional = {n for n, a in zip(camera.model.order, camera.model.additional, strict=True) if a}
    assert names(camera, FREE) == additional | {"principal_point_x"}
    assert len(notes) == 1
    assert camera.model.name == preset


def test_fixed_brown_and_free_ebner(camcal):
    for text in ("fixed-brown+ebner12", "fixed-source+ebner12"):
        network, notes = with_cameras(camcal, text)
        camera = network.cameras[0]
        assert camera.model.name == "brown+ebner12"
        assert names(camera, FREE) == names(camcal.cameras[0], FREE) - {"K1", "K2", "K3", "P1", "P2", "B1", "B2"} | {
            f"E{k}" for k in range(1, 13)
        }
        assert "carried over" in notes[0]
    both = with_cameras(camcal, "ebner12,principal_distance")[0].cameras[0]
    assert "principal_distance" in names(both, FREE)


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        ("K9", "no camera has a parameter 'K9'"),
        ("brown+nothing", "unknown camera model 'nothing'"),
        ("ebner12,gruen44", "one preset"),
        ("opencv+ebner12", "does not correct measured coordinates"),
        ("ebner12+ebner12", "two parts have a parameter 'E1'"),
        ("ebner12+dbat5", "can only be the first"),
        ("fixed-K1", "no camera has a parameter"),
    ],
)
def test_what_makes_no_sense_is_refused(camcal, choice, message):
    with pytest.raises(UsageError, match=message):
        with_cameras(camcal, choice)


def test_two_directions_of_brown_convert_into_each_other():
    there = converted(brown(), cameras.model("brown-distort"))
    assert there.largest < 1e-2  # the inverse of a polynomial is no polynomial
    assert there.camera.values[3] == pytest.approx(-BROWN["K1"], rel=0.05)
    back = converted(there.camera, cameras.model("brown"))
    np.testing.assert_allclose(back.camera.values[:4], brown().values[:4], rtol=1e-3)


def test_the_misfit_is_what_the_models_differ_by():
    old = brown()
    c = converted(old, cameras.model("ebner12"))
    assert set(c.fitted) == set(cameras.model("ebner12").order) - {"principal_distance", "principal_point_x", "principal_point_y"}
    pixels = np.stack(np.meshgrid(np.linspace(0, 1000, 21), np.linspace(0, 800, 21), indexing="ij"), axis=-1).reshape(-1, 2)
    normalised = Optics.of(old).correct(pixels, old.values[None])[0]
    d = Optics.of(c.camera).distort(normalised, c.camera.values[None])[0] - pixels
    assert c.rms == pytest.approx(np.sqrt(np.mean(d**2)), rel=1e-6)
    assert c.largest == pytest.approx(np.linalg.norm(d, axis=1).max(), rel=1e-6)
    assert 0.1 < c.rms < 2.0  # Ebner's set has no x (x^2 + y^2): part of K1 remains
    free = converted(brown(free=("principal_distance",)), cameras.model("ebner12"))
    assert free.rms < c.rms


def test_polynomials_of_degree_five_hold_brown_and_so_it_converts_exactly():
    old = create("1", cameras.model("brown"), {**BROWN, "P1": 0.0}, free=("principal_distance",), image_size=(1000.0, 800.0))
    c = converted(old, cameras.model("polynomial5"))  # P1 would need a rotation besides
    assert c.largest < 1e-6
    network = ring(control=4)
    measured = network.observations[0].xy
    assert converted(replace(old, image_size=None), cameras.model("polynomial5"), measured).camera.half_width > 100.0


def test_opencv_and_brown_have_different_principal_distances():
    values = {
        "principal_distance_x": 900.0,
        "principal_distance_y": 903.0,
        "principal_point_x": 505.0,
        "principal_point_y": 396.0,
        "k1": -0.02,
    }
    c = converted(create("1", cameras.model("opencv"), values, image_size=(1000.0, 800.0)), cameras.model("brown"))
    assert c.largest < 2e-2
    assert c.camera.values[0] == pytest.approx(903.0, rel=2e-4)
    assert c.camera.states[0] == FIXED


def test_without_size_and_points_a_camera_is_not_converted():
    with pytest.raises(UsageError, match="image size"):
        converted(replace(brown(), image_size=None), cameras.model("ebner12"))


def test_a_network_adjusts_alike_whatever_the_start_of_the_set():
    network = ring(control=5)
    one = baarda.adjust(network, camera="polynomial5")
    two = baarda.adjust(replace(network, cameras=one.network.cameras), camera="source")
    assert one.status == two.status == "converged"
    assert one.objective == pytest.approx(two.objective, rel=1e-9)
    assert any("fitted over the part" in text for text in one.assumptions)


@pytest.mark.parametrize("preset", ["ebner12", "gruen44", "gruen12", "polynomial5", "fourier1", "fourier2", "fixed-brown+ebner12"])
def test_every_set_adjusts_the_bundled_calibration(camcal, preset):
    """Ω falls against the camera without distortion in every set; the two solvers see the same system."""
    plain = baarda.adjust(camcal, camera="pinhole")
    result = baarda.adjust(camcal, camera=preset)
    assert result.status == "converged"
    assert result.objective < plain.objective
    assert np.sum(result.redundancy_numbers) == pytest.approx(result.redundancy, rel=1e-9)


# ---- own sets ----
BOW = [Term("q1", x=((1.0, 0, 2), (-0.5, 0, 0))), Term("q2", x=((1.0, 2, 1),), y=((-1.0, 1, 2),))]


def test_an_own_set_is_a_model_like_others():
    model = own_set("bow", BOW)
    camera = create("1", model, {"principal_distance": 900.0, "q1": 2e-6, "q2": 1e-9}, grid=400.0)
    xy = np.array([[100.0, -50.0]])
    out = Optics.of(replace(camera, y_down=False)).from_measured(xy, camera.values[None])[0]
    x, y, b = 100.0, -50.0, 400.0
    np.testing.assert_allclose(out, [[x + 2e-6 * (y * y - b * b / 2) + 1e-9 * x * x * y, y - 1e-9 * x * y * y]], rtol=1e-14)
    assert terms_of(cameras.model("brown+bow", [model])) == {"bow": tuple(BOW)}


@pytest.mark.parametrize("model", ["bow", "brown+bow"])
def test_own_sets_survive_the_project(tmp_path, model):
    network = ring(control=5)
    own = own_set("bow", BOW, "bow of the sensor")
    network, _ = with_cameras(replace(network, settings={"camera_sets": (own,)}), model)
    network = replace(network, cameras=tuple(replace(c, grid=431.7) for c in network.cameras))
    write(network, tmp_path / "p")
    back = baarda.read(tmp_path / "p")
    assert back.cameras[0].model.name == model
    assert back.cameras[0].half_width == 431.7
    assert terms_of(back.cameras[0].model) == {"bow": tuple(BOW)}
    assert back.settings["camera_sets"][0].description == "bow of the sensor"
    np.testing.assert_array_equal(back.cameras[0].values, network.cameras[0].values)
    one, two = (baarda.adjust(n).objective for n in (network, back))
    assert one == two
    write(back, tmp_path / "q")
    for file in (tmp_path / "p").iterdir():
        assert file.read_bytes() == (tmp_path / "q" / file.name).read_bytes()


def test_a_declared_set_is_a_preset(tmp_path):
    write(ring(control=5), tmp_path / "p")
    header = tmp_path / "p" / "project.toml"
    header.write_text(header.read_text() + '\n[[camera_sets]]\nname = "bow"\nterms = [{ name = "q1", x = [[1.0, 0, 2], [-0.5, 0, 0]] }]\n')
    network = baarda.read(tmp_path / "p")
    result = baarda.adjust(network, camera="fixed-source+bow")
    assert "camera 1: q1" in result.unknowns["name"]
    assert result.status == "converged"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('name = "brown"\nterms = [{ name = "q1", x = [[1.0, 0, 2]] }]', "that of a camera model"),
        ('name = "bow"\nterms = []', "has 1 to"),
        ('name = "bow"\nterms = [{ name = "q1" }]', "corrects nothing"),
        ('name = "bow"\nterms = [{ name = "q1", x = [[1.0, -1, 2]] }]', "exponents"),
        ('name = "bow"\nterms = [{ name = "q1", x = [[1.0, 0, 2]] }, { name = "q1", y = [[1.0, 0, 2]] }]', "taken"),
        ('name = "bow"\nterms = [{ name = "q 1", x = [[1.0, 0, 2]] }]', "letter"),
        ('name = "bow"\nterms = [{ name = "q1", x = ["__import__"] }]', "camera_sets"),
        ('name = "bow"\nterms = [{ name = "q1", x = [[nan, 0, 2]] }]', "camera_sets"),
        ('name = "bow"\nformula = "x**2"\nterms = [{ name = "q1", x = [[1.0, 0, 2]] }]', "unknown key"),
    ],
)
def test_wrong_declarations_name_file_and_line(tmp_path, text, message):
    write(ring(control=5), tmp_path / "p")
    header = tmp_path / "p" / "project.toml"
    start = len(header.read_text().splitlines())
    header.write_text(header.read_text() + "\n[[camera_sets]]\n" + text + "\n")
    with pytest.raises(InputError, match=message) as caught:
        baarda.read(tmp_path / "p")
    assert caught.value.line is not None
    assert caught.value.line > start
