"""What the fuzzing found: the smallest file of each crash, and what must hold for all of its kind."""

import base64
import bz2
import gzip
import io
import struct
import warnings
import zipfile

import numpy as np
import pytest

import test_format_aicon
import test_format_mrcal
import test_format_nvm
from baarda.errors import LONGEST, InputError, UsageError, shown
from baarda.formats import read
from baarda.formats.long_column import open_long
from baarda.formats.residual_table import read as read_residuals
from baarda.formats.value_stream import open_values
from reference import test_libmv

SIGNALLING = struct.pack("<I", 0x7FA00000)  # a NaN that complains when it is converted


def header(shape, descr="'<f8'"):
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


@pytest.mark.parametrize(
    "array",
    [
        header("(True,)") + bytes(8),
        header("(-2, -3)") + bytes(48),
        header("(2, 3") + bytes(48),
        header("(2,)", "[[[[[") + bytes(16),
        header("(2,)", "'<\"8'") + bytes(16),
        header("(2,)", "{}") + bytes(16),
        header("(9999999999,)") + bytes(16),
        b"\x93NUMPY\x07\x00",
    ],
)
def test_headers_of_arrays_in_mrcal_models(tmp_path, array):
    out = io.BytesIO()
    np.savez(out, **test_format_mrcal.inputs())
    with zipfile.ZipFile(out) as old, zipfile.ZipFile(new := io.BytesIO(), "w") as archive:
        for name in old.namelist():
            archive.writestr(name, array if name.startswith("observations_board") else old.read(name))
    path = test_format_mrcal.model(tmp_path, None, base64.b85encode(new.getvalue()).decode())
    with pytest.raises(InputError, match="observations_board"):
        read(path)


def test_weights_of_mrcal_next_to_zero(tmp_path):
    content = test_format_mrcal.inputs()
    content["observations_board"][0, 0, 0, 2] = 1e-310
    with pytest.raises(InputError, match="1 / weight"):
        read(test_format_mrcal.model(tmp_path, content))


def lying(data, method=14):
    """Return an archive whose stored parts claim another packing: LZMA's errors are no zip errors."""
    out = bytearray(data)
    for sign, at in ((b"PK\x03\x04", 8), (b"PK\x01\x02", 10)):
        start = out.find(sign)
        while start >= 0:
            out[start + at : start + at + 2] = method.to_bytes(2, "little")
            start = out.find(sign, start + 4)
    return bytes(out)


@pytest.mark.parametrize("method", [8, 12, 14, 93])
def test_archives_with_another_packing_than_they_say(tmp_path, method):
    raw = b"\x09\x04\x05\x00\x5d\x00\x00\x80\x00" + b"\xff" * 60  # a head of LZMA, then nonsense
    with zipfile.ZipFile(out := io.BytesIO(), "w", zipfile.ZIP_STORED) as archive:
        archive.writestr("doc.xml", raw)
    (tmp_path / "block.psz").write_bytes(lying(out.getvalue(), method))
    with pytest.raises(InputError):
        read(tmp_path / "block.psz", format="metashape")
    with zipfile.ZipFile(out := io.BytesIO(), "w", zipfile.ZIP_STORED) as archive:
        archive.writestr("lensmodel.npy", raw)
    blob = base64.b85encode(lying(out.getvalue(), method)).decode()
    with pytest.raises(InputError):
        read(test_format_mrcal.model(tmp_path, None, blob))


def test_signalling_nan_in_libmv(tmp_path):
    good = test_libmv.problem()
    for at in (2, 6, 34 + 4 + 8, len(good) - 4):
        (tmp_path / "p.bin").write_bytes(good[:at] + SIGNALLING + good[at + 4 :])
        with pytest.raises(InputError, match="finite"):
            read(tmp_path / "p.bin", format="libmv")


def test_signalling_nan_in_a_table_of_residuals(tmp_path):
    path = tmp_path / "v.npy"
    path.write_bytes(header("(4,)", "'<f4'") + SIGNALLING + np.arange(3, dtype="<f4").tobytes())
    with pytest.raises(InputError, match="value 1"):
        read_residuals(path)


@pytest.mark.parametrize("shape", ["(-1,)", "(3,)"])
@pytest.mark.parametrize("kind", ["'|S0'", "'<U0'", "'|V0'", "[]"])
def test_elements_without_size(tmp_path, shape, kind):
    """NumPy divides by their size, which ends the process without a word."""
    path = tmp_path / "v.npy"
    path.write_bytes(header(shape, kind) + bytes(64))
    with pytest.raises(InputError, match=r"no size|not a readable NPY"):
        read_residuals(path)
    assert open_long(path) is None
    with pytest.raises(InputError):
        open_values(path)


@pytest.mark.parametrize("module", [bz2, gzip])
def test_a_packed_text_that_unpacks_without_end(tmp_path, module):
    text = b"1 1 1\n0 0 0.5 0.5\n" + b"0 " * (2 << 20)
    path = tmp_path / "problem.txt"
    path.write_bytes(module.compress(text))
    with pytest.raises(InputError, match=r"unpacked text has more than \d+ bytes"):
        read(path, format="bal")


def test_numbers_of_bal_that_cannot_be_squared(tmp_path, data):
    text = (data("bal_dubrovnik_tiny") / "dubrovnik-3-7-pre.txt").read_text().splitlines()
    text[-30] = "1e308"
    (tmp_path / "p.txt").write_text("\n".join(text))
    with pytest.raises(InputError, match=rf"line {len(text) - 29}: beyond 1e\+15: '1e308'"):
        read(tmp_path / "p.txt")


def test_lens_parameters_of_aicon_that_cannot_be_squared(tmp_path):
    test_format_aicon.scene(tmp_path)
    ior = tmp_path / "block.ior"
    words = ior.read_text().split()
    big = next(w for w in words if w.startswith("-") and "e-" in w.lower())
    ior.write_text(ior.read_text().replace(big, "1e308", 1))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(InputError):
            read(tmp_path)


@pytest.mark.parametrize("focal", ["1e-320", "1e-200", "0", "1e300"])
def test_focal_lengths_of_nvm_whose_square_vanishes(tmp_path, focal):
    path = test_format_nvm.scene(tmp_path)
    path.write_text(path.read_text().replace("\t801.0 ", f"\t{focal} ", 1))
    assert focal in path.read_text()
    with pytest.raises(InputError, match="principal distance must be positive"):
        read(path)


@pytest.mark.parametrize(("line", "field"), [(1, 2), (1, 3), (3, 3), (3, 4)])
@pytest.mark.parametrize("value", ["1e-320", "1e300"])
def test_sizes_of_photomodeler_whose_quotient_vanishes(tmp_path, data, line, field, value):
    text = (data("dbat_camcal") / "pm" / "camcal-pmexport5.txt").read_text().splitlines()
    fields = text[line].split()
    fields[field] = value
    text[line] = " ".join(fields)
    (tmp_path / "p.txt").write_text("\n".join(text))
    with pytest.raises(InputError, match=rf"line {line + 1}: the (image|format) size"):
        read(tmp_path / "p.txt", format="photomodeler")


PLACES = ["../outside.txt", "/etc/passwd", "..", "reference/../../outside.txt", "link.txt", "a\u0001b"]


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("of", ["images/images.txt", "measurements/markpts.txt", "reference/camcal-fixed.txt", "base"])
def test_a_script_of_dbat_names_no_file_outside_its_folder(tmp_path, camcal, place, of):
    (tmp_path / "outside.txt").write_text("secret,1,2,3\n")
    folder = tmp_path / "block"
    folder.mkdir()
    (folder / "link.txt").symlink_to(tmp_path / "outside.txt")
    text = camcal.read_text(encoding="utf-8")
    if of == "base":
        text = text.replace('base_dir="$HERE"', f'base_dir="$HERE/{place}"' if place.startswith("..") else f'base_dir="{place}"', 1)
    else:
        text = text.replace(of, place)
    (folder / "s.xml").write_text(text, encoding="utf-8")
    for name in ("images", "measurements", "reference"):
        (folder / name).symlink_to(camcal.parent / name)
    with pytest.raises(InputError) as error:
        read(folder / "s.xml")
    assert "secret" not in str(error.value)
    assert "outside the folder of the script" in str(error.value) or "not well-formed" in str(error.value)


@pytest.mark.parametrize("kind", [InputError, UsageError])
def test_messages_end_and_steer_no_terminal(kind):
    text = str(kind("point '\x1b[2J\u202e\ud800' " + "9" * 100_000))
    assert len(text) < LONGEST + 100
    assert text.isprintable()
    assert text.encode("utf-8")
    assert "left out" in text


def test_shown_leaves_plain_text_alone():
    assert shown("Tür 12: α = 0.05\nnext line") == "Tür 12: α = 0.05\nnext line"


def test_an_element_larger_than_the_file(tmp_path):
    path = tmp_path / "v.npy"
    path.write_bytes(header((2,), "'<U420000000'") + bytes(64))
    with pytest.raises(InputError):
        read_residuals(path)


def test_a_header_longer_than_the_file(tmp_path):
    path = tmp_path / "v.npy"
    path.write_bytes(b"\x93NUMPY\x02\x00" + struct.pack("<I", 1_680_308_992) + b"{'descr': '<f8'".ljust(595))
    with pytest.raises(InputError, match="beyond the file"):
        read_residuals(path)


def test_a_count_of_colmap_with_thousands_of_digits(tmp_path):
    for name, text in (
        ("cameras.txt", f"# Number of cameras: {'9' * 5000}\n1 PINHOLE 100 100 90 90 50 50\n"),
        ("images.txt", "1 1 0 0 0 0 0 0 1 a.jpg\n50 50 1\n2 1 0 0 0 1 0 0 1 b.jpg\n40 50 1\n"),
        ("points3D.txt", "1 0 0 9 0 0 0 0 1 0 2 0\n"),
    ):
        (tmp_path / name).write_text(text)
    assert read(tmp_path).cameras[0].label == "1"
