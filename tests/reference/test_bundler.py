"""Bundler files: the same convention as BAL (whose initial cost is published), lists of names, damaged files."""

import numpy as np
import pytest

from baarda.errors import InputError, UsageError
from baarda.formats import read, recognise, write
from baarda.network import State

SMALL = """# Bundle file v0.3
3 2
900 -0.1 0.01
1 0 0
0 1 0
0 0 1
0 0 0
0 0 0
0 0 0
0 0 0
0 0 0
0 0 0
800 0 0
0 -1 0
1 0 0
0 0 1
1 2 3
1 2 -10
255 0 0
2 0 5 1.5 -2 2 7 3 4
-1 2 -9
0 255 0
1 2 8 5 6
"""


def write_small(folder, text=SMALL, names=None, where="."):
    path = folder / "bundle" / "bundle.out"
    path.parent.mkdir()
    path.write_text(text)
    if names is not None:
        (path.parent / where / "list.txt").write_text(names)
    return path


def cost(network):
    state = State.of(network)
    return 0.5 * sum(float((g.misclosures(network, state) ** 2).sum()) for g in network.observations)


def test_bal_problem_through_a_bundler_folder(data, tmp_path):
    network = read(data("bal_dubrovnik_tiny") / "dubrovnik-3-7-pre.txt")
    write(network, tmp_path / "out", "bundler")
    again = read(tmp_path / "out")
    assert again.format == "bundler"
    assert cost(again) == pytest.approx(2764.219984, abs=5e-7)
    for a, b in ((again.points.coordinates, network.points.coordinates), (again.observations[0].xy, network.observations[0].xy)):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(again.images.rotation, network.images.rotation)
    np.testing.assert_allclose(again.images.position, network.images.position, atol=1e-15)
    assert again.images.labels == network.images.labels


def test_a_file_by_hand(tmp_path):
    path = write_small(tmp_path)
    assert recognise(path).name == "bundler"
    assert recognise(tmp_path).name == "bundler"
    network = read(path)
    assert network.images.labels == ("0", "2")
    assert any("1 of 3 camera(s) without orientation" in a for a in network.assumptions)
    np.testing.assert_array_equal(network.images.position[1], [-2.0, 1.0, -3.0])
    group = network.observations[0]
    np.testing.assert_array_equal(group.images, [0, 1, 1])
    np.testing.assert_array_equal(group.points, [0, 0, 1])
    computed = group.xy - group.misclosures(network, State.of(network))
    p = np.array([0.1, 0.2])  # -P_xy / P_z of the first point in the first camera
    np.testing.assert_allclose(computed[0], 900.0 * (1 - 0.1 * 0.05 + 0.01 * 0.05**2) * p, rtol=1e-14)
    np.testing.assert_allclose(computed[1], 800.0 * np.array([-1.0, 3.0]) / 7.0, rtol=1e-14)


@pytest.mark.parametrize("where", [".", ".."])
def test_list_of_names(tmp_path, where):
    path = write_small(tmp_path, names="a.jpg 0 1234.5\nb c.jpg\nd.jpg 0 9e2\n", where=where)
    assert read(path).images.labels == ("a.jpg", "d.jpg")


def test_lists_that_do_not_fit(tmp_path):
    path = write_small(tmp_path, names="a.jpg\nb.jpg\n")
    with pytest.raises(InputError, match=r"names 2 images, bundle\.out holds 3 cameras"):
        read(path)
    (path.parent / "list.txt").write_text("a.jpg\nb.jpg\na.jpg\n")
    with pytest.raises(InputError, match=r"line 3: image 'a\.jpg' appears twice"):
        read(path)


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ("v0.3", "v0.4", 1, "version 0.4"),
        ("# Bundle", "# Bungle", 1, "first line"),
        ("1 2 8 5 6", "1 2 8 5 x", 23, "not a number: 'x'"),
        ("1 2 8 5 6", "1 2 8 5 inf", 23, "not finite"),
        ("1 2 8 5 6", "2 2 8 5 6", 23, "point 1 announces 2 views"),
        ("1 2 8 5 6", "-1 2 8 5 6", 23, "whole number, not -1"),
        ("1 2 8 5 6", "1e300 2 8 5 6", 23, "beyond 1e"),
        ("1 2 8 5 6", "1 2 8 5 6 7", 23, "goes on"),
        ("1 2 8 5 6", "1 3 8 5 6", 23, "number of a camera must be a whole number from 0 to 2"),
        ("1 2 8 5 6", "1 1 8 5 6", 23, "camera 1 measures this point but has principal distance 0"),
        ("3 2\n900", "3 20\n900", 23, "truncated"),
        ("0 -1 0\n1 0 0", "0 -2 0\n1 0 0", 13, "not a rotation"),
        ("800 0 0", "-800 0 0", 13, "image 2: principal_distance must be positive"),
    ],
)
def test_damaged_files_are_refused_with_the_line(tmp_path, old, new, line, words):
    path = write_small(tmp_path, SMALL.replace(old, new))
    with pytest.raises(InputError, match=words) as caught:
        read(path, format="bundler")
    assert caught.value.line == line


def test_names_that_a_list_cannot_hold(tmp_path):
    network = read(write_small(tmp_path, names="a b.jpg\nc.jpg\nd.jpg\n"))
    with pytest.raises(UsageError, match="white space"):
        write(network, tmp_path / "out", "bundler")
    assert not (tmp_path / "out").exists()
