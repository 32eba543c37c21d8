"""Damaged AICON, PATB, BINGO, Pix4D and OPF files: a message that names the file, bounded memory, never a traceback (hypothesis)."""

import tracemalloc

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import test_format_aicon
import test_format_opf
import test_format_patb_bingo
import test_format_pix4d
from baarda.errors import InputError, MissingExtra, UsageError
from baarda.formats import formats, read

WORDS = [
    b"",
    b"0",
    b"-1",
    b"-99",
    b"1e400",
    b"nan",
    b"inf",
    b"1_0",
    b"\x00",
    b"\xff",
    b"9" * 400,
    b"\n",
    b"\t",
    b" ",
    b"e",
    b'"',
    b"{",
    b"]",
    b"null",
]
#: bytes of memory per byte of input, above a fixed amount, that reading may take
FACTOR, BASE = 200, 8 << 20

SCENES = {
    "aicon": (test_format_aicon.scene, ["block.phc", "block.obc", "block.ior", "block.eor", "block.scale"]),
    "patb": (test_format_patb_bingo.patb, ["block.im", "block.ori", "block.con"]),
    "bingo": (test_format_patb_bingo.bingo, ["image.dat", "itera.dat", "geoin.dat"]),
    "pix4d": (test_format_pix4d.scene, ["maize_calibrated_camera_parameters.txt", "maize_tp_pix4d.txt", "maize_offset.xyz"]),
    "opf": (
        test_format_opf.scene,
        ["project.opf", "calibrated_cameras.json", "input_control_points.json", "projected_input_cameras.json", "constraints.json",
         "point_cloud.gltf", "matchPointIndexRanges.bin", "matchCameraIds.bin", "positions.bin", "camera_list.json", "input_cameras.json"],
    ),
}  # fmt: skip

edits = st.lists(
    st.tuples(st.integers(0, 10**6), st.sampled_from([0, 0, 1, 2, 5, 20, 200]), st.one_of(st.sampled_from(WORDS), st.binary(max_size=8))),
    min_size=1,
    max_size=3,
)


@pytest.mark.parametrize(("name", "file"), [(n, f) for n, (_, fs) in SCENES.items() for f in fs])
def test_broken_files(tmp_path, name, file):
    make, _ = SCENES[name]
    made = make(tmp_path)
    path = made if name == "opf" else tmp_path
    target = next(tmp_path.rglob(file))
    good = target.read_bytes()
    known = formats()
    total = sum(p.stat().st_size for p in tmp_path.rglob("*") if p.is_file())
    refused = []

    @settings(max_examples=40, suppress_health_check=list(HealthCheck), deadline=None, database=None)
    @given(edits)
    def broken(changes):
        data = good
        for at, cut, piece in changes:
            at %= len(data) + 1
            data = data[:at] + piece + data[at + cut :]
        target.write_bytes(data or b" ")
        for f in known.values():
            f.recognises(path)
        tracemalloc.start()
        try:
            read(path, format=name)
            if known[name].positions is not None:
                known[name].positions(path)
        except (InputError, MissingExtra, UsageError) as error:
            refused.append(error)
            assert "\n" not in str(error)
        finally:
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
        assert peak < BASE + FACTOR * (total + len(data))

    broken()
    assert refused
    assert all(isinstance(e, MissingExtra | UsageError) or e.file for e in refused)
