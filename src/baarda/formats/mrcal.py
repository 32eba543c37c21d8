"""mrcal camera models, ``.cameramodel``, with the inputs of the calibration that they carry.

The text of a model holds the observations of all cameras as a NumPy archive in base 85. Every observation of the chessboard is an image:
p_camera = R_c (R_f p_board + t_f) + t_c with rotation vectors, z forward, y down; so M = diag(1, -1, -1) R_c R_f and the board stands
still. The corners are fixed at their places, bent by ``calobject_warp``: z = w0 4 u (1 - u) + w1 4 v (1 - v), u and v from 0 to 1 over the
board. Pixels count from the centre of the first one; weights w <= 0 mark outliers, sigma = 1 px / w.
"""

from __future__ import annotations

import base64
import io
import lzma
import math
import re
import tokenize
import warnings
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda import cameras as camera_models
from baarda.cameras import FIXED
from baarda.errors import InputError
from baarda.formats import checks
from baarda.formats.base import Format, read_text, regular_size
from baarda.geometry import rotation as rot
from baarda.network import CONTROL, Images, Network, Points
from baarda.observations import ImagePoints

Floats = NDArray[np.float64]

LARGEST = 512 * 1024**2  # bytes of a model, and of its arrays
#: what damaged archives and headers end in
HEADER_ERRORS = (
    *(ValueError, TypeError, KeyError, OSError, EOFError, RuntimeError, NotImplementedError, OverflowError, SyntaxError, MemoryError),
    *(zlib.error, lzma.LZMAError, zipfile.BadZipFile, tokenize.TokenError),
)
_AXES = np.diag([1.0, -1.0, -1.0])  # mrcal's camera axes in ours
_INPUTS = re.compile(r"'optimization_inputs'\s*:\s*b'([0-9A-Za-z!#$%&()*+;<=>?@^_`{|}~-]*)'")
_LENS = re.compile(rb"'lens_?model'\s*:\s*'LENSMODEL_")
#: lens model: ours with the same parameters in the same order
_MODELS = {
    "LENSMODEL_PINHOLE": "PINHOLE",
    "LENSMODEL_OPENCV4": "OPENCV",
    "LENSMODEL_OPENCV5": "opencv",
    "LENSMODEL_OPENCV8": "FULL_OPENCV",
}


def recognises(path: Path) -> bool:
    """Tell a model by the name of its lens model."""
    if not path.is_file():
        return False
    with path.open("rb") as f:
        return _LENS.search(f.read(1 << 16)) is not None


def read(path: Path) -> Network:
    """Read the calibration that a model carries.

    Parameters
    ----------
    path : Path

    Returns
    -------
    Network
        An image for every observation of the board, named ``frame F camera C``; its corners, named ``row,column``, are fixed control points
        in the unit of the board's spacing.

    Raises
    ------
    InputError
        With file and line if the model cannot be used or carries no observations of a board.
    """
    if regular_size(path) > LARGEST:
        raise InputError(f"the file has {regular_size(path)} bytes; the limit is {LARGEST}", path)
    text = read_text(path)
    found = _INPUTS.search(text)
    if found is None:
        raise InputError("the model carries no optimization_inputs: without observations there is nothing to adjust", path, 1)
    return _Inputs(path, text.count("\n", 0, found.start()) + 1, found[1]).network()


class _Inputs:
    """The arrays of an archive, each checked before it is believed."""

    def __init__(self, path: Path, line: int, text: str) -> None:
        self.path, self.line = path, line
        try:
            self.packed = base64.b85decode(text)
            self.zip = zipfile.ZipFile(io.BytesIO(self.packed))
            self.members = {i.filename.removesuffix(".npy"): i for i in self.zip.infolist()}
        except (ValueError, zipfile.BadZipFile, NotImplementedError) as error:
            raise self.error(f"optimization_inputs cannot be unpacked: {error}") from None
        if sum(i.file_size for i in self.members.values()) > min(LARGEST, max(1 << 24, 200 * len(self.packed))):
            raise self.error("optimization_inputs unpack to more than the limit")

    def error(self, message: str) -> InputError:
        """Return an error that names file and line."""
        return InputError(message, self.path, self.line)

    def array(self, *names: str) -> Any:
        """Return an array under the first of several names, None where it is absent; nothing of it is executed."""
        name = next((n for n in names if n in self.members), None)
        if name is None:
            return None
        info = self.members[name]
        try:
            with self.zip.open(info) as f:
                data = f.read(info.file_size + 1)
            stream = io.BytesIO(data)
            version = np.lib.format.read_magic(stream)
            header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of headers that Python 2 wrote
                shape, fortran, dtype = header(stream)
        except HEADER_ERRORS as error:
            raise self.error(f"{name} cannot be read: {error}") from None
        rest = len(data) - stream.tell()
        if dtype.hasobject or fortran or any(type(s) is not int or s < 0 for s in shape) or math.prod(shape) * dtype.itemsize != rest:
            raise self.error(f"{name} is not a plain array of the size it announces")
        return np.frombuffer(data, dtype, math.prod(shape), stream.tell()).reshape(shape)

    def numbers(self, *names: str, shape: tuple[int | None, ...], optional: bool = False) -> Any:
        """Return an array of finite numbers of this shape (None = any length), or fail."""
        out = self.array(*names)
        if out is None or (out.shape == () and out.dtype.kind in "US"):  # mrcal writes '' for None
            if optional:
                return None
            raise self.error(f"{names[0]} is missing")
        fits = out.ndim == len(shape) and all(s is None or s == n for s, n in zip(shape, out.shape, strict=True))
        if not fits or out.dtype.kind not in "fiu":
            raise self.error(f"{names[0]} has shape {out.shape}; needed are {tuple('any' if s is None else s for s in shape)} numbers")
        if not (np.abs(out.astype(float)) <= 1e9).all():
            raise self.error(f"{names[0]} holds a number that is not finite or beyond 1e9")
        return out

    def network(self) -> Network:
        lens = self.array("lensmodel", "lens_model")
        name = "" if lens is None or lens.shape != () else str(lens)
        if name not in _MODELS:
            raise self.error(f"lens model {name!r:.60} is not supported; supported are {', '.join(_MODELS)}")
        model = camera_models.model(_MODELS[name])
        seen = self.numbers("observations_board", shape=(None, None, None, 3))
        if self.numbers("observations_point", shape=(None, 3), optional=True) is not None and len(self.array("observations_point")):
            raise self.error("observations of single points are not supported")
        count, height, width, _ = seen.shape
        intrinsics = self.numbers("intrinsics", shape=(None, len(model.order)))
        size = self.numbers("imagersizes", shape=(len(intrinsics), 2))
        frames = self.numbers("frames_rt_toref", "rt_ref_frame", shape=(None, 6))
        cameras = self.numbers("extrinsics_rt_fromref", "rt_cam_ref", shape=(None, 6), optional=True)
        cameras = np.zeros((0, 6)) if cameras is None else cameras
        index = self.numbers("indices_frame_camintrinsics_camextrinsics", shape=(count, 3)).astype(np.intp)
        spacing = self.numbers("calibration_object_spacing", shape=())
        warp = self.numbers("calobject_warp", shape=(2,), optional=True)
        limits = ((0, len(frames)), (0, len(intrinsics)), (-1, len(cameras)))
        if not count or any((index[:, k] < low).any() or (index[:, k] >= high).any() for k, (low, high) in enumerate(limits)):
            raise self.error("indices_frame_camintrinsics_camextrinsics point beyond the frames and cameras")
        if not float(spacing) > 0.0 or min(height, width) < 2 or (size < 1).any():
            raise self.error("the board needs a positive spacing and two rows and columns, images a positive size")
        board = _board(height, width, float(spacing), np.zeros(2) if warp is None else warp)
        poses = np.concatenate([cameras, np.zeros((1, 6))])[index[:, 2]]  # -1: at the reference
        r_camera, r_frame = rot.exp(poses[:, :3]), rot.exp(frames[index[:, 0], :3].astype(float))
        rotation = r_camera @ r_frame
        shift = np.einsum("nij,nj->ni", r_camera, frames[index[:, 0], 3:].astype(float)) + poses[:, 3:]
        position = -np.einsum("nji,nj->ni", rotation, shift)
        weight = seen[..., 2].reshape(count, -1).astype(float)
        image, point = np.nonzero(weight > 0.0)
        xy = seen[..., :2].reshape(count, -1, 2)[image, point].astype(float)
        with np.errstate(over="ignore"):  # weights next to zero are refused below
            sigma = 1.0 / weight[image, point]
        checks.sigma_range(sigma, "1 / weight", lambda _, m: self.error(m))
        labels = [f"frame {f} camera {c}" for f, c, _ in index.tolist()]
        if len(set(labels)) < count:
            raise self.error("a frame is observed twice by the same camera")
        checks.images_with_points(image, labels, np.ones(count, dtype=bool), lambda _, m: self.error(m))
        for c, values in enumerate(intrinsics):
            if not (values[:2] > 0.0).all():
                raise self.error(f"camera {c}: the focal lengths must be positive")
        names = [f"{i},{j}" for i in range(height) for j in range(width)]
        states = np.full((len(names), 3), FIXED, dtype=np.int8)
        return Network(
            tuple(
                camera_models.create(
                    str(c),
                    model,
                    dict(zip(model.order, v.tolist(), strict=True)),
                    free=self._free(model),
                    image_size=(float(s[0]), float(s[1])),
                )
                for c, (v, s) in enumerate(zip(intrinsics.astype(float), size, strict=True))
            ),
            Images.make(labels, index[:, 1], position, _AXES @ rotation),
            Points.make(names, board, np.full(len(names), CONTROL), states, board),
            (ImagePoints.make(image.astype(np.intp), point.astype(np.intp), xy, sigma[:, None]),),
            unit="m",
            assumptions=tuple(self._notes(weight, len(cameras), warp is not None)),
        )

    def _free(self, model: camera_models.CameraModel) -> list[str]:
        """Return the parameters that the calibration estimated."""
        flags = {}
        for name in ("do_optimize_intrinsics_core", "do_optimize_intrinsics_distortions"):
            flag = self.array(name)
            flags[name] = flag is None or flag.shape != () or bool(flag)
        return [n for n in model.order if flags[f"do_optimize_intrinsics_{'core' if n.startswith('principal') else 'distortions'}"]]

    def _notes(self, weight: Floats, extrinsics: int, warped: bool) -> list[str]:
        out = ["the corners of the board are fixed; lengths are taken as m", "sigma of an image point: 1 px / weight, as mrcal weights it"]
        outliers = int((weight <= 0.0).sum())
        if outliers:
            out.append(f"{outliers} of {weight.size} corner observation(s) are outliers of mrcal or were not seen: left out")
        if extrinsics:
            out.append("the fixed geometry between several cameras is not used: every image has its own orientation")
        if warped:
            out.append("the warp of the board is held at mrcal's estimate")
        return out


def _board(height: int, width: int, spacing: float, warp: Floats) -> Floats:
    """Return the corners row by row, (height * width, 3)."""
    row, column = (a.ravel().astype(float) for a in np.indices((height, width)))
    u, v = column / (width - 1), row / (height - 1)
    z = warp[0] * 4.0 * u * (1.0 - u) + warp[1] * 4.0 * v * (1.0 - v)
    return np.stack([column * spacing, row * spacing, z], axis=1)


mrcal = Format("mrcal", "mrcal camera model with the inputs of its calibration (.cameramodel)", recognises, read, first_pixel=0.0)
