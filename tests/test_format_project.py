"""Our own project format: the round trip is exact, hostile and broken input is refused with file and line."""

import os
import random
import re
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import baarda.formats as formats
from baarda import cameras
from baarda.adjustment import adjust
from baarda.cameras import FIXED, FREE, OBSERVED
from baarda.errors import InputError, OutputError, UsageError
from baarda.formats.project import project
from baarda.network import CHECK, CONTROL, Images, Network, Points
from baarda.observations import Distances, ImagePoints
from conftest import data_folder
from networks import ring, with_distances

DOCS = Path(__file__).parent.parent / "docs" / "project-format.md"


def same(a, b, where=""):
    """Assert that two values are equal bit for bit: arrays with NaN and the sign of zero, dataclasses field by field."""
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        x, y = np.ascontiguousarray(a), np.ascontiguousarray(b)
        assert x.dtype.kind == y.dtype.kind and x.shape == y.shape, where
        if x.dtype.kind == "f":
            x, y = (np.where(np.isnan(v), np.nan, v).astype(float) for v in (x, y))
            assert x.tobytes() == y.tobytes(), where
        else:
            assert np.array_equal(x, y), where
    elif isinstance(a, tuple) and isinstance(b, tuple):
        assert len(a) == len(b), where
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            same(x, y, f"{where}[{i}]")
    elif hasattr(a, "__dataclass_fields__") and not isinstance(a, cameras.CameraModel):
        assert type(a) is type(b), where
        for f in fields(a):
            if not (isinstance(a, Network) and f.name in ("path", "format", "sha256")):
                same(getattr(a, f.name), getattr(b, f.name), f"{where}.{f.name}")
    else:
        assert a == b, where


def returned(network, folder):
    project.write(network, folder)
    return project.read(folder)


def rich():
    """A network with everything that the format can hold."""
    n = with_distances(ring(images=4, points=12, control=4, checks=2, seed=3, correlation=0.3), [(5, 6), (7, 8)])
    p, im = n.points, n.images
    states, sigmas, given, correlations = np.array(p.states), np.array(p.sigmas), np.array(p.given), np.array(p.correlations)
    states[1, 2], sigmas[1, 2] = FREE, np.nan  # a horizontal control point
    given[1, 2] = np.nan
    coordinates = np.array(p.coordinates)
    states[2], sigmas[2] = FIXED, np.nan  # an exact one
    coordinates[2] = given[2]
    correlations[3] = 0.1, -0.2, 0.3
    coordinates[9] = np.nan  # a tie point without start
    p = replace(p, states=states, sigmas=sigmas, given=given, correlations=correlations, coordinates=coordinates)
    istates, igiven, isigmas = np.array(im.states), np.array(im.given), np.array(im.sigmas)
    istates[0, :3], igiven[0, :3], isigmas[0, :3] = OBSERVED, im.position[0] + 0.01, 0.02
    istates[1, 5], igiven[1, 5], isigmas[1, 5] = OBSERVED, 0.5, 1e-3
    istates[2, 3:] = FIXED
    rotation, position = np.array(im.rotation), np.array(im.position)
    rotation[3], position[3] = np.nan, np.nan
    im = replace(im, states=istates, given=igiven, sigmas=isigmas, rotation=rotation, position=position)
    observed = cameras.create(
        'second, a "mm" camera',
        cameras.model("dbat1"),
        {"principal_distance": 35.0, "K1": -1e-5},
        free=["K1"],
        observed={"principal_distance": 0.01},
        unit="mm",
        pixel_size=np.array([0.005, 0.0051]),
        origin=np.array([-0.5, 0.25]),
        y_down=False,
    )
    adjusted = n.cameras[0].with_values(n.cameras[0].values + 0.1)
    group = n.observations[0]
    second = replace(group.selected(np.arange(5)), name="seconds", residual_plane="corrected")
    twice = replace(group.selected(np.array([0, 1, 0])), name="repeated")
    return replace(
        n,
        cameras=(adjusted, observed),
        images=replace(im, cameras=np.array([0, 1, 0, 1])),
        points=p,
        observations=(*n.observations, second, twice),
        name='a "name"\nwith \\ and \x7f ü',
        unit="mm",
        offset=np.array([1.0, -2.5, 1e6]),
        settings={"datum": "inner", "min_rays": 3, "camera": ("K1", "K2"), "tolerance": 1e-9, "of the source": (1, ("x", 2.5))},
        assumptions=("first", 'second, with "quotes"'),
    )


def with_unit(network):
    """Distances carry the unit of the network."""
    return replace(
        network, observations=tuple(replace(g, unit=network.unit) if isinstance(g, Distances) else g for g in network.observations)
    )


@pytest.mark.parametrize(
    "network",
    [
        ring(),
        ring(control=5, checks=3, fixed_control=True),
        ring(per_image=True, correlation=-0.4, keep=0.7, seed=4),
        ring(start=False, control=6),
        with_unit(rich()),
    ],
    ids=["free", "fixed control", "camera per image", "no start values", "everything"],
)
def test_round_trip_is_exact(network, tmp_path):
    again = returned(network, tmp_path / "p")
    same(again, network)
    project.write(again, tmp_path / "q")
    for file in (tmp_path / "p").iterdir():
        assert file.read_bytes() == (tmp_path / "q" / file.name).read_bytes()


@pytest.mark.parametrize("source", ["dbat_sxb/sxb.xml", "colmap_sceaux_txt"])
def test_round_trip_of_other_formats(source, tmp_path):
    folder, _, file = source.partition("/")
    network = formats.read(data_folder(folder) / file)
    same(returned(network, tmp_path / "p"), network)


def test_round_trip_of_the_bundled_block(camcal, tmp_path):
    network = formats.read(camcal)
    same(returned(network, tmp_path / "p"), network)


def test_round_trip_of_an_adjusted_network_gives_the_same_adjustment(tmp_path):
    result = adjust(ring(control=4, checks=2, seed=2))
    again = returned(result.network, tmp_path / "p")
    same(again, replace(result.network))
    assert adjust(again).variance_factor == pytest.approx(result.variance_factor, rel=1e-12)


hostile = st.text(
    alphabet=st.characters(exclude_categories=["Cs"], exclude_characters=[*map(chr, range(32)), "\x7f"]), min_size=1, max_size=12
)
number = st.floats(allow_nan=False, allow_infinity=False)


@settings(max_examples=60, deadline=None)
@given(data=st.data(), labels=st.lists(hostile, min_size=3, max_size=5, unique=True))
def test_round_trip_of_hostile_labels_and_any_number(data, labels, tmp_path_factory):
    n = len(labels)
    array = lambda *shape: data.draw(hnp.arrays(float, shape, elements=number))  # noqa: E731
    sigma = data.draw(hnp.arrays(float, (n, 2), elements=st.floats(1e-12, 1e12)))
    at = data.draw(st.floats(-1e12, 1e12))
    camera = cameras.create(labels[0], cameras.model("pinhole"), {"principal_distance": 1.0, "principal_point_x": at})
    network = Network(
        (camera,),
        Images.make(labels, position=array(n, 3)),
        Points.make(labels[::-1], array(n, 3)),
        (ImagePoints.make(np.arange(n), np.arange(n), array(n, 2), sigma, name=labels[1]),),
        name=labels[2],
        assumptions=tuple(labels),
    )
    same(returned(network, tmp_path_factory.mktemp("h") / "p"), network)


def test_recognised_by_folder_and_by_header(tmp_path):
    project.write(ring(), tmp_path / "p")
    for path in (tmp_path / "p", tmp_path / "p" / "project.toml"):
        assert formats.recognise(path).name == "project"
        assert formats.read(path).format == "project"
    (tmp_path / "other.toml").write_text("[tool]\n")
    with pytest.raises(InputError, match="no known format"):
        formats.recognise(tmp_path / "other.toml")


# ------------------------------------------------------------------------------------------------ writing by hand: defaults

HAND = {
    "project.toml": 'schema = "baarda.project/1"\nunit = "m"\n',
    "cameras.csv": "camera,model\n1,pinhole\n",
    "camera_parameters.csv": "camera,parameter,value\n1,principal_distance,1000\n1,principal_point_x,500\n1,principal_point_y,400\n",
    "images.csv": "image,X0,Y0,Z0,omega,phi,kappa\nA,0,0,10,0,0,0\nB,2,0,10,0,0,0\n",
    "points.csv": "point,role,X,Y,Z,sigma_X,sigma_Y,sigma_Z\n"
    "1,control,0,0,0,0.01,0.01,0.02\n2,control,3,0,0,0,0,0\n3,check,0,3,0,0,0,0.05\n4,tie,3,3,0,,,\n5,,,,,,,\n",
    "image_points.csv": "image,point,x,y\n"
    + "".join(f"{i},{p},{100 * k + 7 * j},{50 * k + 30 * j}\n" for j, i in enumerate("AB") for k, p in enumerate("12345")),
    "distances.csv": "from,to,value,sigma\n1,2,3.001,0.001\n",
}


def folder(tmp_path, **changes):
    """Write the files of the project above, some of them changed; None leaves one out."""
    where = tmp_path / "hand"
    where.mkdir(exist_ok=True)
    for name, text in {**HAND, **{k.replace("__", "."): v for k, v in changes.items()}}.items():
        if text is not None:
            (where / name).write_bytes(text.encode() if isinstance(text, str) else text)
    return where


def test_defaults(tmp_path):
    n = project.read(folder(tmp_path))
    c = n.cameras[0]
    assert (c.unit, c.y_down, c.image_size, c.given) == ("px", True, None, None)
    assert (c.states == FIXED).all() and c.values.tolist() == [1000.0, 500.0, 400.0]
    assert (n.images.states == FREE).all() and n.images.cameras.tolist() == [0, 0]
    np.testing.assert_array_equal(n.images.rotation[0], np.eye(3))
    p = n.points
    assert p.roles.tolist() == [CONTROL, CONTROL, CHECK, 0, 0]
    assert p.states.tolist() == [[OBSERVED] * 3, [FIXED] * 3, [FREE] * 3, [FREE] * 3, [FREE] * 3]
    same(p.given[:3], p.coordinates[:3])
    same(p.sigmas, np.array([[0.01, 0.01, 0.02], [np.nan] * 3, [0.0, 0.0, 0.05], [np.nan] * 3, [np.nan] * 3]))
    assert np.isnan(p.given[3:]).all() and np.isnan(p.coordinates[4]).all()
    points, bar = n.observations
    assert (points.name, points.residual_plane, bar.name, bar.unit) == ("image points", "image", "distances", "m")
    assert (points.sigmas == 1.0).all() and n.assumptions == ("10 image point(s) without sigma: 1 px assumed",)


def test_order_of_columns_blanks_and_byte_order_mark(tmp_path):
    text = "\ufeffY0, image ,Z0,X0,kappa, omega,phi\r\n 0 , A, 10,0 ,0,0,0\r\n\r\n0,B,10, 2,0,0,0\r\n"
    same(project.read(folder(tmp_path, images__csv=text)), project.read(folder(tmp_path, images__csv=HAND["images.csv"])))


def test_sigma_of_a_group(tmp_path):
    toml = (
        HAND["project.toml"] + '[[groups]]\nname = "image points"\nsigma = 0.25\n[[groups]]\nname = "bars"\nkind = "distances"\nsigma = 1\n'
    )
    n = project.read(folder(tmp_path, project__toml=toml, distances__csv="group,from,to,value\nbars,1,2,3.001\n"))
    assert (n.observations[0].sigmas == 0.25).all() and n.observations[1].sigmas.tolist() == [1.0]
    assert n.assumptions == ()


def test_control_without_sigmas_is_fixed_and_said(tmp_path):
    n = project.read(folder(tmp_path, points__csv="point,role,X,Y,Z\n1,control,0,0,0\n2,control,3,0,\n3,check,0,3,0\n4,,,,\n5,,,,\n"))
    assert n.points.states[:2].tolist() == [[FIXED] * 3, [FIXED, FIXED, FREE]]
    assert n.points.sigmas[2].tolist() == [0.0] * 3
    assert n.assumptions[:2] == ("2 control point(s) without sigma: held fixed", "1 check point(s) without sigma: taken as exact")


def test_unknowns_by_name(tmp_path):
    text = (
        "name,value,sigma\ncamera 1: principal_distance,999,0.5\nimage B: X0,2.1,0.05\nimage A: kappa,,0.001\n"
        "point 5: Z,1.5,0.1\nimage A: Z0,10.5,0\n"
    )
    n = project.read(folder(tmp_path, unknowns__csv=text))
    c = n.cameras[0]
    assert c.states.tolist() == [OBSERVED, FIXED, FIXED] and c.prior[0] == 999.0 and c.values[0] == 1000.0 and c.sigmas[0] == 0.5
    im = n.images
    assert im.states.tolist() == [[2, 2, FIXED, 2, 2, OBSERVED], [OBSERVED, 2, 2, 2, 2, 2]]
    assert im.given[1, 0] == 2.1 and im.given[0, 5] == 0.0 and im.position[0, 2] == 10.5
    assert n.points.roles[4] == CONTROL and n.points.states[4].tolist() == [2, 2, OBSERVED] and n.points.given[4, 2] == 1.5


def test_matrix_and_angles(tmp_path):
    project.write(ring(images=3), tmp_path / "p")
    file = tmp_path / "p" / "images.csv"
    lines = file.read_text().splitlines()
    head = lines[0].split(",")
    k = head.index("kappa")
    row = lines[2].split(",")
    row[k] = repr(float(row[k]) + 0.1)
    file.write_text("\n".join([lines[0], lines[1], ",".join(row), lines[3]]))
    with pytest.raises(InputError, match=r"images.csv, line 3: .*contradict"):
        project.read(tmp_path / "p")


def test_distance_groups_and_empty_groups_return(tmp_path):
    n = with_distances(ring(images=3, points=8), [(0, 1)])
    bars, points = n.observations[1], n.observations[0]
    n = replace(n, observations=(replace(bars, name="b"), points, replace(points.selected(np.arange(0)), name="none"), bars))
    same(returned(n, tmp_path / "p"), n)


def test_a_large_table(tmp_path):
    rng = np.random.default_rng(1)
    i, p = np.divmod(np.arange(100_000), 1000)
    network = Network(
        (cameras.create("1", cameras.model("pinhole"), {"principal_distance": 1000.0}),),
        Images.make([f"image {k}" for k in range(100)]),
        Points.make([str(k) for k in range(1000)], rng.random((1000, 3))),
        (ImagePoints.make(i, p, rng.random((100_000, 2)) * 1000),),
    )
    project.write(network, tmp_path / "p")
    same(project.read(tmp_path / "p"), network)


# --------------------------------------------------------------------------------------------------------- broken input


def edited(name, line, text):
    """Replace a line (from 1) of a file of the project written by hand; None deletes it."""
    lines = HAND[name].split("\n")
    lines[line - 1 : line] = [] if text is None else [text]
    return {name.replace(".", "__"): "\n".join(lines)}


HEADER = HAND["project.toml"]
BROKEN = {
    "empty table": ({"points__csv": ""}, "points.csv", None, "empty"),
    "blank table": ({"points__csv": " \n\n"}, "points.csv", None, "empty"),
    "header only": ({"image_points__csv": "image,point,x,y\n"}, "image_points.csv", 1, "no rows"),
    "not text": ({"points__csv": b"point,X\n1,\xff\n"}, "points.csv", 2, "UTF-8"),
    "truncated row": (edited("image_points.csv", 4, "A,3,200"), "image_points.csv", 4, "3 fields, the header 4"),
    "row too long": (edited("image_points.csv", 4, "A,3,1,2,3"), "image_points.csv", 4, "5 fields"),
    "open quote": (edited("images.csv", 2, '"A,0,0,10,0,0,0'), "images.csv", 2, "CSV"),
    "unknown column": (edited("images.csv", 1, "image,X0,Y0,Z0,omega,phi,kapa"), "images.csv", 1, "'kapa'"),
    "doubled column": (edited("images.csv", 1, "image,X0,Y0,Z0,omega,phi,X0"), "images.csv", 1, "'X0' appears twice"),
    "missing column": ({"distances__csv": "from,value,sigma\n1,3,1\n"}, "distances.csv", 1, "'to' is missing"),
    "not a number": (edited("image_points.csv", 3, "A,2,abc,1"), "image_points.csv", 3, "x is not a number: 'abc'"),
    "underscore in a number": (edited("image_points.csv", 3, "A,2,1_0,1"), "image_points.csv", 3, "not a number: '1_0'"),
    "NaN": (edited("image_points.csv", 3, "A,2,nan,1"), "image_points.csv", 3, "x is not finite"),
    "infinite": (edited("images.csv", 3, "B,1e999,0,10,0,0,0"), "images.csv", 3, "X0 is not finite"),
    "missing measurement": (edited("image_points.csv", 3, "A,2,,1"), "image_points.csv", 3, "x is missing"),
    "duplicate camera": ({"cameras__csv": "camera,model\n1,pinhole\n1,brown\n"}, "cameras.csv", 3, "'1' appears twice (first in line 2)"),
    "duplicate image": (edited("images.csv", 3, "A,2,0,10,0,0,0"), "images.csv", 3, "'A' appears twice (first in line 2)"),
    "duplicate point": (edited("points.csv", 5, "1,tie,3,3,0,,,"), "points.csv", 5, "'1' appears twice (first in line 2)"),
    "absurd parameter": (
        edited("camera_parameters.csv", 3, "1,principal_point_x,-1e200"),
        "camera_parameters.csv",
        3,
        "value = -1e+200 is beyond 1e+12",
    ),
    "absurd origin": (
        {"cameras__csv": "camera,model,origin_x,origin_y\n1,pinhole,0.5,1e13\n"},
        "cameras.csv",
        2,
        "the origin = 10000000000000.0 is beyond 1e+12",
    ),
    "absurd unknown": (
        {"unknowns__csv": "name,value,sigma\ncamera 1: principal_distance,1e100,1\n"},
        "unknowns.csv",
        2,
        "value = 1e+100 is beyond 1e+12",
    ),
    "duplicate parameter": (
        edited("camera_parameters.csv", 3, "1,principal_distance,5"),
        "camera_parameters.csv",
        3,
        "twice (first in line 2)",
    ),
    "measured twice": (
        edited("image_points.csv", 6, "A,2,1,1"),
        "image_points.csv",
        6,
        "'2' is measured twice in this image (first in line 3)",
    ),
    "image without points": (edited("images.csv", 4, "C,1,1,10,0,0,0\n"), "images.csv", 4, "'C' has no image points"),
    "unknown camera": ({"images__csv": "image,camera\nA,1\nB,2\n"}, "images.csv", 3, "unknown camera '2'"),
    "unknown image": (edited("image_points.csv", 5, "X,4,1,1"), "image_points.csv", 5, "unknown image 'X'"),
    "unknown point": (edited("image_points.csv", 5, "A,44,1,1"), "image_points.csv", 5, "unknown point '44'"),
    "unknown end of a distance": (edited("distances.csv", 2, "1,9,3,1"), "distances.csv", 2, "unknown point '9'"),
    "distance to itself": (edited("distances.csv", 2, "1,1,3,1"), "distances.csv", 2, "two different points"),
    "distance without sigma": ({"distances__csv": "from,to,value\n1,2,3\n"}, "distances.csv", 2, "sigma"),
    "negative distance": (edited("distances.csv", 2, "1,2,-3,1"), "distances.csv", 2, "must be positive"),
    "unknown camera model": (edited("cameras.csv", 2, "1,fisheye"), "cameras.csv", 2, "unknown camera model 'fisheye'"),
    "unknown parameter": (edited("camera_parameters.csv", 3, "1,K1,0"), "camera_parameters.csv", 3, "no parameter 'K1'"),
    "no principal distance": (
        {"camera_parameters__csv": "camera,parameter,value\n1,principal_point_x,5\n"},
        "cameras.csv",
        2,
        "no principal_distance",
    ),
    "zero principal distance": (
        edited("camera_parameters.csv", 2, "1,principal_distance,0"),
        "camera_parameters.csv",
        2,
        "must be positive",
    ),
    "zero pixel": ({"cameras__csv": "camera,model,pixel_size_x\n1,pinhole,0\n"}, "cameras.csv", 2, "pixel size"),
    "zero sigma": (
        {"image_points__csv": "image,point,x,y,sigma_x,sigma_y\nA,1,1,1,1,1\nB,1,1,1,0,1\n"},
        "image_points.csv",
        3,
        "must be positive",
    ),
    "negative sigma": (edited("points.csv", 2, "1,control,0,0,0,0.01,-0.01,0.02"), "points.csv", 2, "sigma_Y must not be negative"),
    "NaN sigma": (edited("points.csv", 2, "1,control,0,0,0,0.01,nan,0.02"), "points.csv", 2, "sigma_Y is not finite"),
    "control without sigma": (edited("points.csv", 2, "1,control,0,0,0,0.01,,0.02"), "points.csv", 2, "sigma_Y is missing"),
    "control without coordinate": (edited("points.csv", 2, "1,control,0,,0,0.01,0.01,0.02"), "points.csv", 2, "given value is missing"),
    "control without coordinates": (edited("points.csv", 2, "1,control,,,,,,"), "points.csv", 2, "without given coordinates"),
    "tie with sigma": (edited("points.csv", 5, "4,,3,3,0,1,1,1"), "points.csv", 5, "role of the point is not control"),
    "unknown role": (edited("points.csv", 5, "4,GCP,3,3,0,1,1,1"), "points.csv", 5, "role must be one of tie, control, check"),
    "correlation": (
        {
            "points__csv": HAND["points.csv"]
            .replace("sigma_Z\n", "sigma_Z,correlation_XY\n")
            .replace("0.02\n", "0.02,1.5\n")
            .replace(",0,0,0\n2", ",0,0,0,\n2")
            .replace("control,3,0,0,0,0,0\n", "control,3,0,0,0,0,0,\n")
            .replace("0.05\n", "0.05,\n")
            .replace("0,,,\n", "0,,,,\n")
            .replace("5,,,,,,,\n", "5,,,,,,,,\n")
        },
        "points.csv",
        2,
        "covariance matrix",
    ),
    "angle missing": (edited("images.csv", 3, "B,2,0,10,0,,0"), "images.csv", 3, "three angles must be given together"),
    "angle fixed alone": (
        {"images__csv": "image,omega,phi,kappa,state_kappa\nA,0,0,0,free\nB,0,0,0,fixed\n"},
        "images.csv",
        3,
        "fixed together",
    ),
    "observed without sigma": ({"images__csv": "image,X0,state_X0\nA,1,observed\nB,2,free\n"}, "images.csv", 2, "sigma_X0 is missing"),
    "fixed without value": ({"images__csv": "image,X0,state_X0\nA,1,fixed\nB,,fixed\n"}, "images.csv", 3, "has no value"),
    "fixed and otherwise": ({"images__csv": "image,X0,given_X0,state_X0\nA,1,2,fixed\nB,,,\n"}, "images.csv", 2, "differs from given_X0"),
    "not a rotation": (
        {"images__csv": "image,r11,r12,r13,r21,r22,r23,r31,r32,r33\nA,1,0,0,0,1,0,0,0,1\nB,1,0,0,0,1,0,0,0,-1\n"},
        "images.csv",
        3,
        "rotation",
    ),
    "unknown of nothing": ({"unknowns__csv": "name,value,sigma\ncamera 7: K1,0,1\n"}, "unknowns.csv", 2, "not in the network"),
    "unknown parameter of a camera": ({"unknowns__csv": "name,value,sigma\ncamera 1: K9,0,1\n"}, "unknowns.csv", 2, "no parameter 'K9'"),
    "unknown observed twice": ({"unknowns__csv": "name,value,sigma\npoint 1: X,0,1\n"}, "unknowns.csv", 2, "already"),
    "unknown check point": ({"unknowns__csv": "name,value,sigma\npoint 3: X,0,1\n"}, "unknowns.csv", 2, "check point"),
    "control in mm, start in m": (
        {
            "points__csv": "point,role,X,Y,Z,given_X,given_Y,given_Z,sigma_X,sigma_Y,sigma_Z\n"
            "1,control,0,0,0,0,0,0,1,1,1\n2,control,3,0,0,3001,0,0,1,1,1\n3,control,0,3,0,2,2999,1,1,1,1\n4,,3,3,0,,,,,,\n5,,,,,,,,,,\n"
        },
        "points.csv",
        2,
        "in mm and not in m",
    ),
    "control in mm, ties in m": (
        {
            "points__csv": "point,role,X,Y,Z,sigma_X,sigma_Y,sigma_Z\n"
            "1,control,0,0,0,1,1,1\n2,control,3000,0,0,1,1,1\n3,,0,3,0,,,\n4,,3,3,0,,,\n5,,1,1,0,,,\n"
        },
        "points.csv",
        2,
        "not the same unit",
    ),
    "control in km, cameras in m": (
        {
            "points__csv": "point,role,X,Y,Z,sigma_X,sigma_Y,sigma_Z\n"
            "1,control,0,0,0,1,1,1\n2,control,0.003,0,0,1,1,1\n3,control,0,0.003,0,1,1,1\n4,,,,,,,\n5,,,,,,,\n",
            "distances__csv": None,
        },
        "points.csv",
        2,
        "not the same unit",
    ),
    "distance in mm": (edited("distances.csv", 2, "1,2,3001,1"), "distances.csv", 2, "in mm and not in m"),
    "control and check points in mm, only cameras start": (
        {
            "points__csv": "point,role,X,Y,Z,sigma_X,sigma_Y,sigma_Z\n"
            "1,control,0,0,0,1,1,1\n2,control,1200,0,0,1,1,1\n3,check,0,1200,0,1,1,1\n4,,,,,,,\n5,,,,,,,\n",
            "distances__csv": None,
        },
        "points.csv",
        2,
        "in mm and not in m",
    ),
    "number of 5000 digits": ({"project__toml": HEADER + f"[settings]\nmin_rays = {'9' * 5000}\n"}, "project.toml", 4, "too many digits"),
    "number of 4000 digits": ({"project__toml": HEADER + f"[settings]\nimage_sigma = {'9' * 4000}\n"}, "project.toml", 4, "64 bits"),
    "hexadecimal number": ({"project__toml": HEADER + f"[settings.source]\nk = [0x{'f' * 5000}]\n"}, "project.toml", 4, "64 bits"),
    "coarse tolerance": ({"project__toml": HEADER + "[settings]\ntolerance = 0.011\n"}, "project.toml", 4, "settings.tolerance"),
    "tolerance of zero": ({"project__toml": HEADER + "[settings]\ntolerance = 0.0\n"}, "project.toml", 4, "settings.tolerance"),
    "negative rays": ({"project__toml": HEADER + "[settings]\nmin_rays = -1\n"}, "project.toml", 4, "settings.min_rays"),
    "huge usual sigma": ({"project__toml": HEADER + "[settings]\nimage_sigma = 1e200\n"}, "project.toml", 4, "settings.image_sigma"),
    "huge sigma of a group": ({"project__toml": HEADER + '[[groups]]\nname = "a"\nsigma = 1e200\n'}, "project.toml", 5, "groups.0.sigma"),
    "tiny image sigma": (
        {"image_points__csv": "image,point,x,y,sigma_x,sigma_y\nA,1,0,0,1,1\nA,2,0,0,1,1e-13\n"},
        "image_points.csv",
        3,
        "the sigma of an image point = 1e-13 does not lie between",
    ),
    "huge sigma of control": (
        edited("points.csv", 2, "1,control,0,0,0,0.01,1e200,0.02"),
        "points.csv",
        2,
        "the sigma of a coordinate = 1e+200",
    ),
    "huge sigma of a camera": (
        {"camera_parameters__csv": "camera,parameter,value,sigma\n1,principal_distance,1000,1e200\n"},
        "camera_parameters.csv",
        2,
        "sigma = 1e+200",
    ),
    "huge sigma of an unknown": ({"unknowns__csv": "name,value,sigma\nimage A: X0,0,1e200\n"}, "unknowns.csv", 2, "sigma = 1e+200"),
    "huge sigma of a distance": (edited("distances.csv", 2, "1,2,3.001,1e200"), "distances.csv", 2, "sigma of the distance = 1e+200"),
    "digits of another script": (edited("distances.csv", 2, "1,2,\u0663.1,1"), "distances.csv", 2, "value is not a number"),
    "control character in a label": (edited("images.csv", 2, "A\x1b[31m,0,0,10,0,0,0"), "images.csv", 2, "holds a control character"),
    "line break in a label": (edited("images.csv", 3, '"B\nC",0,0,10,0,0,0'), "images.csv", 3, "holds a control character"),
    "control character in a group": ({"project__toml": HEADER + '[[groups]]\nname = "a\\u007f"\n'}, "project.toml", 4, "control character"),
    "no header file": ({"project__toml": None}, "project.toml", None, "no such file"),
    "not TOML": ({"project__toml": HEADER + "name = \n"}, "project.toml", 3, "not a TOML file"),
    "other schema": ({"project__toml": 'name = "x"\nschema = "baarda.project/9"\n'}, "project.toml", 2, "schema"),
    "no schema": ({"project__toml": 'name = "x"\n'}, "project.toml", None, "schema: is missing"),
    "unknown key": (
        {"project__toml": HEADER + "[settings]\nmin_rays = 2\nmin_ray = 2\n"},
        "project.toml",
        5,
        "settings.min_ray: unknown key",
    ),
    "wrong value": ({"project__toml": HEADER + '[settings]\ndatum = "free"\n'}, "project.toml", 4, "settings.datum"),
    "wrong type": ({"project__toml": HEADER + '[settings]\nmin_rays = "2"\n'}, "project.toml", 4, "settings.min_rays"),
    "NaN in the header": ({"project__toml": HEADER + "offset = [0, nan, 0]\n"}, "project.toml", 3, "offset"),
    "wrong group": (
        {"project__toml": HEADER + '[[groups]]\nname = "a"\n[[groups]]\nname = "b"\nsigma = -1\n'},
        "project.toml",
        7,
        "groups.1.sigma",
    ),
    "group not declared": ({"project__toml": HEADER + '[[groups]]\nname = "a"\n'}, "image_points.csv", 2, "not declared"),
    "out of the folder": ({"project__toml": HEADER + '[tables]\npoints = "../points.csv"\n'}, "project.toml", 3, "plain name"),
    "absolute table": ({"project__toml": HEADER + '[tables]\npoints = "/etc/passwd"\n'}, "project.toml", 3, "plain name"),
    "unknown table": ({"project__toml": HEADER + '[tables]\npints = "points.csv"\n'}, "project.toml", 3, "unknown table 'pints'"),
    "table not there": (
        {
            "project__toml": HEADER + '[tables]\npoints = "p.csv"\nimages = "images.csv"\ncameras = "cameras.csv"\n'
            'image_points = "image_points.csv"\ncamera_parameters = "camera_parameters.csv"\n'
        },
        "p.csv",
        None,
        "no such file",
    ),
    "no points": ({"points__csv": None}, "project.toml", None, "table 'points' is missing"),
    "no cameras": ({"cameras__csv": None}, "project.toml", None, "table 'cameras' is missing"),
    "no camera parameters": ({"camera_parameters__csv": None}, "cameras.csv", 2, "camera_parameters"),
    "no observations": ({"image_points__csv": None, "distances__csv": None}, "project.toml", None, "no table of observations"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_input_is_refused_with_file_and_line(name, tmp_path):
    changes, file, line, message = BROKEN[name]
    where = folder(tmp_path, **changes)
    with pytest.raises(InputError) as caught:
        project.read(where)
    error = caught.value
    assert Path(error.file).name == file
    assert error.line == line, str(error)
    assert message in str(error)
    assert error.exit_code == 2


def test_line_numbers_count_lines_within_quotes(tmp_path):
    text = 'image,X0\nA,"\n\n0"\nC,1\n\nB,zwei\n'
    with pytest.raises(InputError, match=r"images.csv, line 7: X0 is not a number: 'zwei'"):
        project.read(folder(tmp_path, images__csv=text))


def test_any_changed_character_is_read_or_refused(tmp_path):
    rng = random.Random(0)
    where = folder(tmp_path)
    for name, text in HAND.items():
        for k in range(len(text)):
            new = rng.choice(["", "\n", ",", '"', "-", "9", "e", "\x00", "1e308", "ü", "=", "["])
            (where / name).write_text(text[:k] + new + text[k + 1 :], encoding="utf-8", newline="")
            try:
                assert isinstance(project.read(where), Network)
            except InputError as error:
                assert str(where) in str(error)
        (where / name).write_text(text, encoding="utf-8", newline="")


def test_same_point_twice_is_accepted_where_the_group_says_so(tmp_path):
    changes = edited("image_points.csv", 6, "A,2,1,1")
    toml = HEADER + '[[groups]]\nname = "image points"\nrepeated = true\n'
    n = project.read(folder(tmp_path, project__toml=toml, **changes))
    assert len(n.observations[0]) == 10


# -------------------------------------------------------------------------------------------------------------- writing


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"images": Images.make(["I0"] * 6)}, "'I0' appears twice"),
        ({"images": Images.make(["", *"abcde"])}, "empty label"),
        ({"name": "\ud800"}, "not Unicode"),
        ({"settings": {"datum": object()}}, "cannot be written"),
        ({"observations": (ring().observations[0],) * 2}, "two groups"),
        ({"points": Points.make(ring().points.labels, np.full((24, 3), np.inf))}, "infinite"),
    ],
)
def test_what_cannot_be_written(change, message, tmp_path):
    with pytest.raises(UsageError, match=message):
        project.write(replace(ring(), **change), tmp_path / "p")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("failure", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_full_disk_or_an_interruption_leaves_nothing(failure, tmp_path, monkeypatch):
    count = 0

    def write_bytes(self, data):
        nonlocal count
        count += 1
        if count == 3:
            raise failure
        with self.open("wb") as f:
            return f.write(data)

    monkeypatch.setattr(Path, "write_bytes", write_bytes)
    with pytest.raises((OutputError, KeyboardInterrupt)):
        project.write(ring(), tmp_path / "p")
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_overwritten(tmp_path):
    (tmp_path / "p").mkdir()
    (tmp_path / "p" / "mine").write_text("precious")
    with pytest.raises(OutputError, match="not an empty folder"):
        project.write(ring(), tmp_path / "p")
    assert [f.name for f in tmp_path.rglob("*")] == ["p", "mine"]


# ------------------------------------------------------------------------------------------------------------------ docs


def documented(tmp_path):
    """Write the files of the worked example in the documentation: blocks headed by their file name in backquotes."""
    where = tmp_path / "example"
    where.mkdir()
    for name, text in re.findall(r"^`([a-z_]+\.(?:toml|csv))`\n\n```\w+\n(.*?)^```", DOCS.read_text(encoding="utf-8"), re.S | re.M):
        (where / name).write_text(text, encoding="utf-8")
    return where


def test_the_worked_example_of_the_documentation(tmp_path):
    where = documented(tmp_path)
    assert len(list(where.iterdir())) == 8
    n = formats.read(where)
    assert n.assumptions == ()
    result = adjust(n)
    assert result.status == "converged"
    found = re.search(r"redundancy is (\d+), σ0 a posteriori (\d\.\d+)", DOCS.read_text(encoding="utf-8"))
    assert result.redundancy == int(found[1])
    assert f"{result.sigma0:.4f}" == found[2]


def test_every_column_is_documented():
    from baarda.formats import project as module
    from baarda.formats.known_values import columns_of
    from baarda.formats.project_file import GroupTable, Header, SettingsTable
    from baarda.network import AXES

    text = DOCS.read_text(encoding="utf-8")
    names = {*module._CAMERA, *(c for columns in module._OBSERVATIONS.values() for part in columns for c in part)}
    names |= {*columns_of(AXES), *SettingsTable.model_fields, *GroupTable.model_fields, *Header.model_fields} - {"schema_"}
    missing = [name for name in sorted(names) if f"`{name}`" not in text]
    assert not missing


def test_labels_with_control_characters_are_not_written(tmp_path):
    n = ring()
    with pytest.raises(UsageError, match="control character"):
        project.write(replace(n, images=replace(n.images, labels=("a\tb", *n.images.labels[1:]))), tmp_path / "p")


@pytest.mark.parametrize("name", ["project.toml", "points.csv"])
def test_only_regular_files_are_opened(name, tmp_path):
    where = folder(tmp_path)
    (where / name).unlink()
    os.mkfifo(where / name)
    with pytest.raises(InputError, match=rf"{name}: not a regular file"):
        formats.read(where, format="project")


@pytest.mark.parametrize("format", [None, "project", "dbat", "photomodeler"])
def test_pipes_and_devices_are_refused(format, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("/dev/zero")
    for path in (tmp_path / "pipe", tmp_path / "link"):
        with pytest.raises(InputError, match="not a regular file"):
            formats.read(path, format=format)
        with pytest.raises(InputError, match="not a regular file"):
            formats.digest(path)


def test_a_folder_is_not_a_file_to_read(tmp_path):
    with pytest.raises(InputError, match="not a regular file"):
        formats.read(tmp_path, format="dbat")


def test_files_that_the_system_keeps_from_us(tmp_path, monkeypatch):
    where = folder(tmp_path)

    def refused(self, *args, **kwargs):
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "open", refused)
    for call in (formats.recognise, formats.read, formats.digest):
        with pytest.raises(InputError, match=r"hand.*: cannot be read: Permission denied"):
            call(where)
    monkeypatch.setattr(Path, "read_bytes", refused)
    with pytest.raises(InputError, match=r"project.toml: cannot be read: Permission denied"):
        formats.read(where, format="project")
    monkeypatch.setattr(Path, "stat", refused)
    with pytest.raises(InputError, match="cannot be read: Permission denied"):
        formats.recognise(where)
