"""BAL problems: convention by the published initial cost, minimum, packed files, round trip, damaged files."""

import bz2
import gzip
from dataclasses import replace

import numpy as np
import pytest

import baarda
from baarda.errors import InputError, OutputError, RedundancyNotPositive, UsageError
from baarda.formats import read, recognise, write
from baarda.network import State

SMALL = "2 2 3\n0 0 1.5 -2\n1 0 3 4\n1 1 5 6\n" + "\n".join(["0.1", "0", "0", "1", "2", "3", "900", "0", "0"] * 2) + "\n1 2 3\n4 5 6\n"


def cost(network):
    state = State.of(network)
    return 0.5 * sum(float((g.misclosures(network, state) ** 2).sum()) for g in network.observations)


@pytest.fixture(scope="module")
def tiny(data):
    return data("bal_dubrovnik_tiny") / "dubrovnik-3-7-pre.txt"


@pytest.fixture(scope="module")
def dubrovnik(data):
    return data("bal_dubrovnik16") / "problem-16-22106-pre.txt"


def test_initial_costs_are_those_of_ceres_and_gtsam(tiny, dubrovnik):
    network = read(dubrovnik)
    assert network.format == "bal"
    assert (len(network.images.labels), len(network.points.labels), len(network.observations[0])) == (16, 22106, 83718)
    assert cost(network) == pytest.approx(4185659.518249701, rel=1e-13)
    assert cost(read(tiny)) == pytest.approx(2764.219984, abs=5e-7)
    assert any("1 px" in a for a in network.assumptions)


def test_every_point_lies_in_front_of_its_camera(dubrovnik):
    network = read(dubrovnik)
    assert network.observations[0].in_front(network, State.of(network)).mean() > 0.999


def test_dubrovnik_reaches_the_known_minimum(dubrovnik):
    result = baarda.adjust(read(dubrovnik))
    assert result.status == "converged"
    assert result.redundancy == 100981
    assert 0.5 * result.objective == pytest.approx(18033.90348, rel=1e-7)
    assert result.sigma0 == pytest.approx(0.59764, abs=5e-6)


def test_the_cut_out_is_refused_with_free_cameras_and_adjusted_with_fixed_ones(tiny):
    with pytest.raises(RedundancyNotPositive, match="redundancy -3"):
        baarda.adjust(read(tiny))
    assert baarda.adjust(read(tiny), camera=()).redundancy == 6


@pytest.mark.parametrize("packed", [".txt", ".bz2", ".gz"])
def test_round_trip(tiny, tmp_path, packed):
    network = read(tiny)
    out = tmp_path / f"again{packed}"
    write(network, out, "bal")
    again = read(out)
    assert again.format == "bal"
    np.testing.assert_allclose(again.images.rotation, network.images.rotation, atol=4e-16)
    np.testing.assert_allclose(again.images.position, network.images.position, atol=1e-14)
    for a, b in ((again.points.coordinates, network.points.coordinates), (again.observations[0].xy, network.observations[0].xy)):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal([c.values for c in again.cameras], [c.values for c in network.cameras])
    assert cost(again) == pytest.approx(cost(network), rel=1e-12)
    with pytest.raises(OutputError, match="exists"):
        write(network, out, "bal")
    assert len(list(tmp_path.iterdir())) == 1


def test_other_cameras_are_written_where_the_format_contains_them(data, tmp_path):
    network = read(data("colmap_sceaux_txt"))
    assert network.cameras[0].model.name == "SIMPLE_RADIAL"
    write(network, tmp_path / "sceaux.txt", "bal")
    again = read(tmp_path / "sceaux.txt")
    assert cost(again) == pytest.approx(cost(network), rel=1e-11)
    brown = replace(network, cameras=(baarda.cameras.create("b", baarda.cameras.model("brown"), {"principal_distance": 1.0}),))
    with pytest.raises(UsageError, match="cannot hold model 'brown'"):
        write(brown, tmp_path / "no.txt", "bal")


@pytest.mark.parametrize("pack", [bz2.compress, gzip.compress, bytes])
def test_content_not_the_name_tells_the_format(tmp_path, pack):
    path = tmp_path / "anything.dat"
    path.write_bytes(pack(SMALL.encode()))
    assert recognise(path).name == "bal"
    network = read(path)
    np.testing.assert_array_equal(network.observations[0].xy, [[1.5, -2], [3, 4], [5, 6]])
    np.testing.assert_array_equal(network.points.coordinates, [[1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize(
    ("change", "line", "words"),
    [
        (lambda t: t.replace("1 0 3 4", "1 0 3 four"), 3, "not a number: 'four'"),
        (lambda t: t.replace("1 0 3 4", "1 0 3 nan"), 3, "not finite"),
        (lambda t: t.replace("1 0 3 4", "1 0 3 1e999"), 3, "not finite"),
        (lambda t: t.replace("1 0 3 4", "1 0 3 1_0"), 3, "not a number"),
        (lambda t: t.replace("1 1 5 6", "2 1 5 6"), 4, "number of a camera must be a whole number from 0 to 1"),
        (lambda t: t.replace("1 1 5 6", "1 7 5 6"), 4, "number of a point"),
        (lambda t: t.replace("1 1 5 6", "1 0.5 5 6"), 4, "not 0.5"),
        (lambda t: t.replace("900\n0\n0\n1 2", "-900\n0\n0\n1 2"), 14, "image 1: principal_distance must be positive"),
        (lambda t: t.replace("1 1 5 6", "0 1 5 6").replace("1 0 3 4", "0 0 3 4"), 14, "image '1' has no image points"),
        (lambda t: t[:-8], 23, "truncated"),
        (lambda t: t + "7\n", 25, "goes on"),
        (lambda t: "2 2 999999999" + t[5:], 24, "truncated"),
        (lambda t: "2 2 -3" + t[5:], 1, "count of the header"),
    ],
)
def test_damaged_files_are_refused_with_the_line(tmp_path, change, line, words):
    path = tmp_path / "bad.txt"
    path.write_text(change(SMALL))
    with pytest.raises(InputError, match=words) as caught:
        read(path, format="bal")
    assert caught.value.line == line


def test_damaged_packing_is_refused(tmp_path):
    for pack in (bz2.compress, gzip.compress):
        path = tmp_path / pack.__module__
        path.write_bytes(pack(SMALL.encode() * 50)[:-20])
        with pytest.raises(InputError, match="damaged"):
            read(path, format="bal")


def test_a_folder_of_files_names_those_that_can_be_read(data):
    with pytest.raises(
        InputError, match=r"of the files in it, give one: dubrovnik-3-7-18-pre\.txt \(bal\), dubrovnik-3-7-pre\.txt \(bal\)"
    ):
        read(data("bal_dubrovnik_tiny"))
