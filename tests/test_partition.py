"""Networks in parts: what stands where, and that the parts hold everything once."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import baarda
from baarda.cameras import FREE, OBSERVED
from baarda.errors import InputError, UsageError
from baarda.network import State
from baarda.observations import ImageCoordinates, direct_observations
from baarda.procedures.partition import border_nodes, part_network, partition
from baarda.procedures.partition_folder import is_partition, read_partition, write_partition
from baarda.procedures.synthetic import synthetic
from networks import ring, with_distances


def aerial(images=25, **options):
    return synthetic("aerial", images, points=options.pop("points", 20 * images), **options).network


def rows_of(network):
    """Every scalar observation by its names, with its value."""
    out = {}
    groups = [*network.observations, *direct_observations(network, np.ones(len(network.points.labels), dtype=bool))]
    for group in groups:
        labels = group.labels(network)
        ends = [[network.points.labels[i] for i in end] for end in group.points_of()] if hasattr(group, "points_of") else []
        names = [np.array(network.images.labels, dtype=object)[labels["image"]]] if "image" in labels else []
        for kind, node in labels.items():
            if kind == "camera":
                names.append(np.array([c.label for c in network.cameras], dtype=object)[node])
            elif kind == "point" and not ends:
                names.append(np.array(network.points.labels, dtype=object)[node])
            elif kind == "component":
                names.append(node)
        for row, (values, *key) in enumerate(zip(group.observed().tolist(), *names, *ends, strict=True)):
            full = (group.name, *map(str, key))
            assert full not in out, (full, row)
            out[full] = values
    return out


@pytest.mark.parametrize("parts", [1, 2, 3, 5])
def test_everything_stands_in_one_part(parts):
    network = with_distances(aerial(), [(0, 7), (7, 100), (200, 480)])
    split = partition(network, parts)
    made = [part_network(network, split, k) for k in range(parts)]
    labels = [label for m in made for label in m.points.labels]
    assert sorted(labels) == sorted(network.points.labels)
    found = {}
    for m in made:
        own = rows_of(m)
        assert not own.keys() & found.keys()
        found |= own
    assert found == rows_of(network)
    images = [label for m in made for label in m.images.labels]
    border = {network.images.labels[i] for kind, i in border_nodes(network, split) if kind == "image"}
    assert {i for i in images if images.count(i) > 1} == border and set(images) == set(network.images.labels)


def test_parts_are_balanced_and_the_border_is_small():
    network = synthetic("aerial", 200, points=6000).network
    for parts in (2, 3, 4, 8):
        split = partition(network, parts)
        size = np.bincount(split.rows[0], minlength=parts)
        assert size.max() < 1.6 * size.mean()
        assert split.shared("image").sum() < 24 * parts
        again = partition(network, parts)
        assert all(np.array_equal(a, b) for a, b in zip(split.rows, again.rows, strict=True))


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), parts=st.integers(1, 4), kind=st.sampled_from(["aerial", "ring", "long-tracks", "dense"]))
def test_any_network(seed, parts, kind):
    network = synthetic(kind, 12, points=90, seed=seed).network
    try:
        split = partition(network, parts)
    except UsageError as refused:
        assert "too small" in str(refused)
        return
    assert sum(len(part_network(network, split, k).observations[0]) for k in range(parts)) == len(network.observations[0])


def test_direct_observations_of_the_border_count_once():
    network = aerial(16)
    states = np.array(network.images.states)
    states[:, :3] = OBSERVED
    given_, sigmas = np.full((16, 6), np.nan), np.full((16, 6), np.nan)
    given_[:, :3], sigmas[:, :3] = network.images.position, 0.1
    network = replace(network, images=replace(network.images, states=states, given=given_, sigmas=sigmas))
    split = partition(network, 2)
    made = [part_network(network, split, k) for k in range(2)]
    shared = np.flatnonzero(split.shared("image"))
    assert len(shared)
    for i in shared:
        label = network.images.labels[i]
        assert [m.images.states[m.images.labels.index(label), 0] for m in made] == [OBSERVED, FREE]
    assert sum(int((m.images.states == OBSERVED).sum()) for m in made) == 48


def test_single_coordinates_and_joined_points():
    network = with_distances(ring(images=8, points=40, keep=0.5), [(0, 1), (1, 2)])
    whole = network.observations[0]
    single = ImageCoordinates(whole.selected(np.arange(5)), np.array([0, 1, 0, 1, 0]))
    network = replace(network, observations=(whole.selected(np.arange(5, len(whole))), single, *network.observations[1:]))
    split = partition(network, 2)
    assert len({*split.points[:3].tolist()}) == 1
    made = [part_network(network, split, k) for k in range(2)]
    assert sum(len(g) for m in made for g in m.observations if isinstance(g, ImageCoordinates)) == 5


def test_written_and_read(tmp_path):
    network = aerial(16)
    made = write_partition(network, 3, tmp_path / "p")
    assert is_partition(tmp_path / "p") and is_partition(tmp_path / "p" / "partition.json") and not is_partition(tmp_path)
    assert made == read_partition(tmp_path / "p" / "partition.json")
    assert sum(p.points for p in made.parts) == len(network.points.labels)
    first = (tmp_path / "p" / "partition.json").read_bytes()
    write_partition(network, 3, tmp_path / "p")  # replaces its own kind
    assert (tmp_path / "p" / "partition.json").read_bytes() == first
    for k, p in enumerate(made.parts):
        part = baarda.read(made.place(k))
        assert len(part.images.labels) == p.images
    kept = {label: i for i, label in enumerate(network.images.labels)}
    part = baarda.read(made.place(1))
    state, whole = State.of(part), State.of(network)
    at = [kept[label] for label in part.images.labels]
    assert np.array_equal(state.position, whole.position[at]) and np.array_equal(state.rotation, whole.rotation[at])


def test_start_values_are_found_before_the_split(tmp_path):
    network = ring(images=8, points=60, control=5, keep=0.7, start=False)
    made = write_partition(network, 2, tmp_path / "p")
    for k in range(2):
        assert np.isfinite(baarda.read(made.place(k)).images.position).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"parts": []}, "no parts"),
        ({"border": [["image", "x"]]}, "owned by exactly one"),
        ({"centroid": [0, 0]}, "cannot be used"),
        ({"counts": None}, "cannot be used"),
    ],
)
def test_a_spoilt_index_is_refused(tmp_path, change, message):
    import json

    write_partition(aerial(12, points=100), 1, tmp_path / "p")
    file = tmp_path / "p" / "partition.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **change}, indent=1))
    with pytest.raises(InputError, match=message):
        read_partition(tmp_path / "p")


def test_what_cannot_be_split():
    with pytest.raises(UsageError, match="too small for 400 parts"):
        partition(aerial(16), 400)
    with pytest.raises(UsageError, match="must be positive"):
        partition(aerial(16), 0)
