"""mrcal models with their calibration inputs: the convention of its documentation, damaged and hostile archives."""

import base64
import io
import zipfile

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import baarda
from baarda.errors import InputError
from baarda.formats import read, recognise
from baarda.network import State

INTRINSICS = {
    "PINHOLE": [],
    "OPENCV4": [-0.1, 0.02, 1e-3, -2e-3],
    "OPENCV5": [-0.1, 0.02, 1e-3, -2e-3, 0.01],
    "OPENCV8": [-0.1, 0.02, 1e-3, -2e-3, 0.01, 0.02, -0.01, 0.003],
}


def project(core, d, p):
    """OpenCV's model as mrcal's documentation refers to it."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (*d, *[0.0] * 8)[:8]
    x, y = p[0] / p[2], p[1] / p[2]
    r2 = x * x + y * y
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return core[0] * u + core[2], core[1] * v + core[3]


def inputs(kind="OPENCV5", cameras=1):
    rng = np.random.default_rng(4)
    core, d = [800.0, 805.0, 322.0, 238.0], INTRINSICS[kind]
    h, w, spacing, warp = 5, 6, 0.08, np.array([2e-3, -1e-3])
    frames = np.concatenate([rng.uniform(-0.4, 0.4, (6, 3)), rng.uniform(-0.1, 0.1, (6, 2)) - 0.2, rng.uniform(0.9, 1.4, (6, 1))], axis=1)
    extrinsics = np.array([[0.01, -0.05, 0.02, -0.1, 0.0, 0.02]])[: cameras - 1]
    index, seen = [], []
    for f in range(6):
        for c in range(cameras):
            index.append((f, c, c - 1))
            grid = np.zeros((h, w, 3))
            for i in range(h):
                for j in range(w):
                    u, v = j / (w - 1), i / (h - 1)
                    z = warp[0] * (1 - 4 * (u - 0.5) ** 2) + warp[1] * (1 - 4 * (v - 0.5) ** 2)
                    p = Rotation.from_rotvec(frames[f, :3]).apply([j * spacing, i * spacing, z]) + frames[f, 3:]
                    if c:
                        p = Rotation.from_rotvec(extrinsics[0, :3]).apply(p) + extrinsics[0, 3:]
                    grid[i, j] = (*project(core, d, p), 1.0 if i else 0.5)
            seen.append(grid)
    seen[0][2, 2] = (0.0, 0.0, -1.0)
    return {
        "lensmodel": f"LENSMODEL_{kind}",
        "intrinsics": np.tile(np.array(core + d), (cameras, 1)),
        "imagersizes": np.tile(np.array([640, 480], dtype=np.int32), (cameras, 1)),
        "extrinsics_rt_fromref": extrinsics if cameras > 1 else "",
        "frames_rt_toref": frames,
        "points": "",
        "observations_board": np.array(seen),
        "indices_frame_camintrinsics_camextrinsics": np.array(index, dtype=np.int32),
        "observations_point": "",
        "calobject_warp": warp,
        "calibration_object_spacing": spacing,
        "do_optimize_intrinsics_core": True,
        "do_optimize_intrinsics_distortions": True,
    }


def model(folder, content, blob=None):
    if blob is None:
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **content)
        blob = base64.b85encode(buffer.getvalue()).decode()
    path = folder / "camera-0.cameramodel"
    path.write_text(
        "# generated\n{\n    'lens_model':  'LENSMODEL_OPENCV5',\n\n    'intrinsics': [ 1, 2,],\n    'extrinsics': [ 0, 0, 0, 0, 0, 0,],\n"
        f"    'imagersize': [ 640, 480,],\n\n    'optimization_inputs': b'{blob}',\n}}\n"
    )
    return path


@pytest.mark.parametrize("kind", INTRINSICS)
@pytest.mark.parametrize("cameras", [1, 2])
def test_the_documented_projection_gives_zero_residuals(tmp_path, kind, cameras):
    path = model(tmp_path, inputs(kind, cameras))
    assert recognise(path).name == "mrcal"
    network = read(path)
    assert len(network.cameras) == cameras
    group = network.observations[0]
    assert len(group) == 6 * cameras * 30 - 1
    assert np.abs(group.misclosures(network, State.of(network))).max() < 1e-9
    assert set(group.sigmas.ravel()) == {1.0, 2.0}
    assert any("1 of" in a and "outliers of mrcal" in a for a in network.assumptions)


def test_adjustment(tmp_path):
    result = baarda.adjust(read(model(tmp_path, inputs("OPENCV4"))))
    assert result.status == "converged"
    assert result.objective < 1e-10
    assert result.datum.defect.count == 0


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("lensmodel", "LENSMODEL_SPLINED_STEREOGRAPHIC_order=3", "is not supported; supported are"),
        ("intrinsics", np.ones((1, 4)), "intrinsics has shape"),
        ("intrinsics", np.full((1, 9), np.nan), "not finite"),
        ("frames_rt_toref", np.zeros((2, 6)), "point beyond"),
        ("observations_board", "", "observations_board is missing"),
        ("calibration_object_spacing", -1.0, "positive spacing"),
        ("observations_point", np.zeros((1, 3)), "single points are not supported"),
        ("calobject_warp", np.array([{"a": 1}, 2], dtype=object), "not a plain array"),
    ],
)
def test_inputs_that_cannot_be_used(tmp_path, key, value, words):
    with pytest.raises(InputError, match=words) as caught:
        read(model(tmp_path, {**inputs(), key: value}), format="mrcal")
    assert caught.value.line == 9


def test_hostile_archives(tmp_path):
    for blob in ("", "abcd!", "0" * 1000):
        with pytest.raises(InputError, match="cannot be unpacked"):
            read(model(tmp_path, None, blob), format="mrcal")
    # a header that announces far more than follows
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **inputs())

    with zipfile.ZipFile(io.BytesIO(buffer.getvalue())) as z:
        parts = {n: z.read(n) for n in z.namelist()}
    head = parts["frames_rt_toref.npy"]
    parts["frames_rt_toref.npy"] = head.replace(b"(6, 6)", b"(9, 6)")
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as z:
        for n, c in parts.items():
            z.writestr(n, c)
    with pytest.raises(InputError, match="not a plain array of the size"):
        read(model(tmp_path, None, base64.b85encode(out.getvalue()).decode()), format="mrcal")


def test_a_model_alone(tmp_path):
    path = model(tmp_path, inputs())
    path.write_text(path.read_text().split("    'optimization_inputs'")[0] + "}\n")
    with pytest.raises(InputError, match="carries no optimization_inputs"):
        read(path, format="mrcal")
