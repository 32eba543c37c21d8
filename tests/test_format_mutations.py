"""Damaged files of strangers end in a message that names the file, never in a traceback: random mutations of every text and archive."""

import contextlib
import random

import pytest

import test_format_metashape
import test_format_mrcal
import test_format_nvm
import test_format_openmvg
import test_format_opensfm
from baarda.errors import InputError, MissingExtra, UsageError
from baarda.formats import formats, read

COUNT = 120
WORDS = [
    b"",
    b"0",
    b"-1",
    b"1e400",
    b"nan",
    b'"',
    b"{",
    b"[",
    b"]",
    b"}",
    b"<",
    b">",
    b"\x00",
    b"\xff",
    b"9" * 400,
    b"null",
    b"true",
    b"\n",
    b"\t",
    b",",
    b"e",
]


def mutated(data, rng):
    """Return bytes with one to three pieces deleted, doubled, replaced or cut off."""
    for _ in range(rng.randint(1, 3)):
        a = rng.randrange(len(data) + 1)
        b = min(len(data), a + rng.choice([0, 1, 1, 2, 5, 20, 200]))
        kind = rng.randrange(5)
        piece = {0: b"", 1: data[a:b] * 2, 2: rng.choice(WORDS), 3: bytes(rng.randrange(256) for _ in range(b - a))}.get(kind)
        data = data[:a] if kind == 4 and a > 10 else data[:a] + (piece or b"") + data[b:]
    return data


def survive(path, file, name, seed):
    good = file.read_bytes()
    rng = random.Random(seed)
    refused = 0
    for i in range(COUNT):
        file.write_bytes(mutated(good, rng) or b" ")
        for f in formats().values():
            f.recognises(path)
        try:
            read(path, format=name)
        except (InputError, MissingExtra, UsageError) as error:
            refused += 1
            assert str(error).isprintable() or "\n" not in str(error), (i, error)
    file.write_bytes(good)
    assert refused > COUNT // 10


@pytest.mark.parametrize("file", ["reconstruction.json", "tracks.csv", "ground_control_points.json"])
def test_opensfm(tmp_path, file):
    test_format_opensfm.scene(tmp_path)
    (tmp_path / "ground_control_points.json").write_text(
        '{"points": [{"id": "a", "position": {"latitude": 52.5, "longitude": 13.4, "altitude": 30}, "observations": '
        '[{"shot_id": "0.jpg", "projection": [0.01, 0.02]}, {"shot_id": "1.jpg", "projection": [0.1, 0.2]}]}]}'
    )
    survive(tmp_path, tmp_path / file, "opensfm", 1)


def test_control_lists(tmp_path):
    camera, pose, xyz = test_format_opensfm.scene(tmp_path)
    path = test_format_opensfm.control_list(tmp_path, "LOCAL", xyz[:4], pose, camera, xyz)
    good, rng = path.read_bytes(), random.Random(2)
    for _ in range(COUNT):
        path.write_bytes(mutated(good, rng) or b" ")
        with contextlib.suppress(InputError, MissingExtra, UsageError):
            read(tmp_path, control=path)


@pytest.mark.parametrize("make", [test_format_metashape.psz, test_format_metashape.xml])
def test_metashape(tmp_path, make):
    path, _ = make(tmp_path)
    survive(path, path, "metashape", 3)


def test_metashape_parts(tmp_path):
    import zipfile

    path, _ = test_format_metashape.psz(tmp_path)
    with zipfile.ZipFile(path) as z:
        parts = {n: z.read(n) for n in z.namelist()}
    rng = random.Random(4)
    for _ in range(COUNT):
        name = rng.choice(list(parts))
        test_format_metashape.zipped(path, {**parts, name: mutated(parts[name], rng)})
        with contextlib.suppress(InputError, MissingExtra, UsageError):
            read(path, format="metashape")


def test_nvm(tmp_path):
    path = test_format_nvm.scene(tmp_path)
    survive(path, path, "nvm", 5)


def test_openmvg(tmp_path):
    path = test_format_openmvg.scene(tmp_path, control=True)
    survive(path, path, "openmvg", 6)


def test_mrcal(tmp_path):
    path = test_format_mrcal.model(tmp_path, test_format_mrcal.inputs())
    survive(path, path, "mrcal", 7)
