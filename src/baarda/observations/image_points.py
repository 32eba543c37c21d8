"""Image points: measured image coordinates and the collinearity equations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from baarda.cameras import Optics
from baarda.errors import UsageError
from baarda.geometry import collinearity
from baarda.network import Network, State
from baarda.observations import kernels
from baarda.observations.base import Block, Floats, Ints, Rows

CHUNK = 16384


@dataclass(frozen=True)
class Piece:
    """Rows that share a camera model with its constants."""

    optics: Optics
    rows: Ints

    @property
    def width(self) -> int:
        """The number of camera parameters."""
        return len(self.optics.model.order)


@dataclass(frozen=True)
class Evaluation:
    """Image points of one optics at one state, ready for the compiled loop: the group, the loop, and its arguments that do not change."""

    group: ImagePoints
    loop: Any
    fixed: tuple[Any, ...]

    def __call__(
        self, rows: Any, positions: Sequence[Ints], misclosure: Floats, partials: Sequence[Floats] = (), weights: Floats | None = None
    ) -> bool:
        """Write misclosures and partials of some rows, each multiplied by its weight.

        Parameters
        ----------
        rows : slice or int array
        positions : sequence of int arrays
            The parameters to keep of camera, image and point; all three of a point.
        misclosure : (n, 2) array
        partials : sequence of (n, 2, w) arrays
            Of camera, image and point; none for misclosures alone.
        weights : (n, 2) or (1, 2) array, optional
            One over the sigmas, if not given.

        Returns
        -------
        bool
            False where a distortion could not be inverted.
        """
        g, some = self.group, _together(rows)
        if weights is None:
            weights = 1.0 / (g.sigmas[:1] if g.sigmas.strides[0] == 0 else g.sigmas[some])
        own = [_read_only(x) for x in (g.images[some].astype(np.intp), g.points[some].astype(np.intp), g.xy[some])]
        out = partials if len(partials) else [np.empty((0, 2, len(p))) for p in positions]
        failed = self.loop(
            *self.fixed, *own, weights, 0, len(own[0]), len(partials) > 0, positions[0], positions[1], misclosure, *out
        )  # fmt: skip
        return bool(failed < 0)


@dataclass(frozen=True)
class ImagePoints:
    """Measured image coordinates.

    Attributes
    ----------
    images, points : (n,) int arrays
        Indices of image and object point.
    xy : (n, 2) array
        Measured coordinates, source pixels.
    sigmas : (n, 2) array
        A-priori standard deviations, source pixels.
    correlations : (n,) array
        Correlation of x and y.
    name : str
    residual_plane : {"image", "corrected"}
        Where residuals live: in the image as measured, or in the plane where a `correct` model meets the collinearity equations (what
        DBAT does); either way they are stated in source pixels and axes.

    Notes
    -----
    In the image plane v = distort(projected) - measured: the exact solution of the combined model B v + A x = l of a `correct` model, with
    the residuals of the original observations. In the corrected plane v = projected - correct(measured), divided by the pixel size.
    """

    images: Ints
    points: Ints
    xy: Floats
    sigmas: Floats
    correlations: Floats
    name: str = "image points"
    residual_plane: Literal["image", "corrected"] = "image"

    def __post_init__(self) -> None:
        for key in ("images", "points", "xy", "sigmas", "correlations"):
            view = np.asarray(getattr(self, key)).view()
            view.flags.writeable = False
            object.__setattr__(self, key, view)
        if self.residual_plane not in ("image", "corrected"):
            raise UsageError(f"residual_plane must be 'image' or 'corrected', not {self.residual_plane!r}")

    @staticmethod
    def make(images: Any, points: Any, xy: Any, sigmas: Any = 1.0, correlations: Any = None, **rest: Any) -> ImagePoints:
        """Make image points; `sigmas` may be one number for all."""
        n = len(images)
        return ImagePoints(
            np.asarray(images, dtype=np.intp),
            np.asarray(points, dtype=np.intp),
            np.asarray(xy, dtype=float).reshape(n, 2),
            np.broadcast_to(np.asarray(sigmas, dtype=float), (n, 2)),
            np.broadcast_to(0.0, n) if correlations is None else np.asarray(correlations, dtype=float),
            **rest,
        )

    components = ("x", "y")
    unit = "px"

    def __len__(self) -> int:
        return len(self.images)

    def selected(self, keep: Any) -> ImagePoints:
        """Return some of the image points (index or mask)."""
        return replace(
            self,
            images=self.images[keep],
            points=self.points[keep],
            xy=self.xy[keep],
            sigmas=_selected(self.sigmas, keep),
            correlations=_selected(self.correlations, keep),
        )

    def points_of(self) -> tuple[Ints, ...]:
        """Return the object point of each row."""
        return (self.points,)

    def observed(self) -> Floats:
        """Return the measured coordinates."""
        return self.xy

    def sigma(self) -> Floats:
        """Return the a-priori standard deviations."""
        return self.sigmas

    def labels(self, network: Network) -> dict[str, Any]:
        """Return image and point codes."""
        return {"image": self.images, "point": self.points}

    def by_optics(self, network: Network) -> list[tuple[Optics, Ints]]:
        """Return the rows of each optics (model and constants)."""
        optics: dict[tuple[Any, ...], tuple[Optics, list[int]]] = {}
        for i, c in enumerate(network.cameras):
            key = (c.model.name, *np.ravel(c.pixel_size), *np.ravel(c.origin), c.y_down, c.half_width)
            optics.setdefault(key, (Optics.of(c), []))[1].append(i)
        if len(optics) == 1:
            return [(o, np.arange(len(self))) for o, _ in optics.values()]
        camera = network.images.cameras[self.images]
        found = [(o, np.flatnonzero(np.isin(camera, members))) for o, members in optics.values()]
        return [(o, rows) for o, rows in found if len(rows)]

    def pieces(self, network: Network) -> list[Piece]:
        """Split the rows by optics, then into pieces of fixed size that can be handled side by side."""
        return [Piece(o, rows[a : a + CHUNK]) for o, rows in self.by_optics(network) for a in range(0, len(rows), CHUNK)]

    def _computed(self, optics: Optics, rows: Ints, network: Network, state: State) -> tuple[Any, ...]:
        image = self.images[rows]
        camera = network.images.cameras[image]
        same = camera.min() == camera.max() if len(camera) else True
        p = state.cameras[camera[0]][None] if same else np.stack(state.cameras)[camera] if _equal(state) else _gather(state, camera)
        rotation = state.rotation[image]
        vectors = collinearity.camera_coordinates(rotation, state.position[image], state.points[self.points[rows]])
        ideal, d_vectors, in_front = collinearity.project(vectors)
        return p, camera, image, rotation, vectors, ideal, d_vectors, in_front

    def linearize(self, network: Network, state: State) -> list[Rows]:
        """Linearise all rows in pieces; see `Kind.linearize`."""
        return [self.linearize_piece(network, state, piece) for piece in self.pieces(network)]

    def linearize_piece(self, network: Network, state: State, piece: Piece) -> Rows:
        """Linearise the rows of a piece."""
        optics, rows = piece.optics, piece.rows
        quick = self._compiled(piece, network, state, partials=True)
        if quick is not None:
            image = self.images[rows]
            misclosure, d_camera, d_exterior, d_point = quick
            camera = network.images.cameras[image]
            blocks = (Block("camera", camera, d_camera), Block("image", image, d_exterior), Block("point", self.points[rows], d_point))
            return Rows(rows, misclosure, blocks, self._cofactor(rows))
        p, camera, image, rotation, vectors, ideal, d_vectors, _front = self._computed(optics, rows, network, state)
        measured = self.xy[rows]
        if self.residual_plane == "image":
            computed, d_ideal, d_camera, valid = optics.distort(ideal, p, start=measured)
            misclosure = np.where(valid[:, None], measured - computed, np.nan)  # a distortion that cannot be inverted
        else:
            projected, d_ideal, p_camera = optics.from_ideal(ideal, p)
            corrected, _, m_camera = optics.from_measured(measured, p)
            factor = _to_pixels(optics)
            misclosure = (corrected - projected) * factor
            d_ideal, d_camera = d_ideal * factor[:, None], (p_camera - m_camera) * factor[:, None]
        d_exterior, d_point = collinearity.partials(rotation, vectors, d_ideal @ d_vectors)
        blocks = (Block("camera", camera, d_camera), Block("image", image, d_exterior), Block("point", self.points[rows], d_point))
        return Rows(rows, misclosure, blocks, self._cofactor(rows))

    def misclosures(self, network: Network, state: State) -> Floats:
        """Return observed - computed, (n, 2)."""
        out = np.empty((len(self), 2))
        for piece in self.pieces(network):
            out[piece.rows] = self.misclosures_of_piece(network, state, piece)
        return out

    def misclosures_of_piece(self, network: Network, state: State, piece: Piece) -> Floats:
        """Return observed - computed of the rows of a piece."""
        optics, rows = piece.optics, piece.rows
        quick = self._compiled(piece, network, state, partials=False)
        if quick is not None:
            return quick[0]
        p, *_, ideal, _d, _front = self._computed(optics, rows, network, state)
        measured = self.xy[rows]
        if self.residual_plane == "image":
            computed, _, _, valid = optics.distort(ideal, p, start=measured)
            return np.asarray(np.where(valid[:, None], measured - computed, np.nan))
        return np.asarray((optics.from_measured(measured, p)[0] - optics.from_ideal(ideal, p)[0]) * _to_pixels(optics))

    def images_of(self, network: Network, piece: Piece) -> str:
        """Return in words which images the rows of a piece are of."""
        names = [network.images.labels[i] for i in np.unique(self.images[piece.rows])]
        return "images " + ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")

    def fill(self, network: Network, state: State, piece: Piece, misclosure: Floats, parts: Any) -> Floats | None:
        """Write the whitened misclosures and partials of a piece straight into the arrays of a chunk.

        Parameters
        ----------
        network, state, piece
            As for `linearize_piece`.
        misclosure : (n, 2) array
        parts : sequence of (positions, nodes (n,), partials (n, 2, w))
            Of camera, image and point.

        Returns
        -------
        (n, 2) array or None
            The sigmas; None where this cannot be done and nothing was written.
        """
        (_, cameras, _), (_, images, _), (_, points, _) = parts
        evaluation = self.evaluation(piece.optics, network, state)
        if np.any(self.correlations[piece.rows]) or len(parts[2][0]) != 3 or evaluation is None:
            return None
        if not evaluation(piece.rows, [p[0] for p in parts], misclosure, [p[2] for p in parts]):
            return None
        images[:], points[:] = self.images[piece.rows], self.points[piece.rows]
        cameras[:] = network.images.cameras[images]
        return self.sigmas[piece.rows]

    def can_be_evaluated(self, optics: Optics) -> bool:
        """Return whether there is a compiled loop for so many rows of these optics."""
        return len(self) >= kernels.COMPILE_FROM and kernels.Program.of(optics) is not None and kernels.compiled() is not None

    def evaluation(self, optics: Optics, network: Network, state: State) -> Evaluation | None:
        """Return what evaluates rows of these optics at a state by the compiled loop; None for small groups and cameras without one."""
        program, loop = kernels.Program.of(optics), kernels.compiled()
        if program is None or not self.can_be_evaluated(optics):
            return None
        return Evaluation(
            self, loop,
            (
                program.steps, program.places, program.measured, self.residual_plane == "corrected", _to_pixels(optics),
                np.ascontiguousarray(optics.pixel_size, dtype=float), np.ascontiguousarray(optics.origin, dtype=float),
                state.camera_table(len(optics.model.order)), state.rotation, state.position, state.points, network.images.cameras,
            ),
        )  # fmt: skip

    def _compiled(self, piece: Piece, network: Network, state: State, partials: bool) -> tuple[Floats, Floats, Floats, Floats] | None:
        """Evaluate a piece by the compiled loop; None where that cannot be done, or a distortion cannot be inverted."""
        n, k = len(piece.rows), piece.width
        count = n if partials else 0
        misclosure, out = np.empty((n, 2)), (np.empty((count, 2, k)), np.empty((count, 2, 6)), np.empty((count, 2, 3)))
        evaluation = self.evaluation(piece.optics, network, state)
        positions = [np.arange(k), np.arange(6), np.arange(3)]
        done = evaluation is not None and evaluation(piece.rows, positions, misclosure, out if partials else (), np.ones((1, 2)))
        return (misclosure, *out) if done else None

    def in_front(self, network: Network, state: State) -> NDArray[np.bool_]:
        """Return for each row whether its point lies in front of its camera."""
        out = np.empty(len(self), dtype=bool)
        for piece in self.pieces(network):
            out[piece.rows] = self._computed(piece.optics, piece.rows, network, state)[-1]
        return out

    def _cofactor(self, rows: Ints) -> Floats:
        s = self.sigmas[rows]
        if not np.any(self.correlations[rows]):
            return np.asarray(s**2)
        q = np.zeros((len(rows), 2, 2))
        q[:, 0, 0], q[:, 1, 1] = s[:, 0] ** 2, s[:, 1] ** 2
        q[:, 0, 1] = q[:, 1, 0] = self.correlations[rows] * s[:, 0] * s[:, 1]
        return q


def _together(rows: Any) -> Any:
    """Return rows that follow each other as a slice, which takes views and no copies."""
    if isinstance(rows, slice) or not len(rows) or rows[-1] - rows[0] != len(rows) - 1 or np.any(np.diff(rows) != 1):
        return rows
    return slice(rows[0], rows[-1] + 1)


def _read_only(array: Any) -> Any:
    """Return an array like those of a group, for which the loop is compiled."""
    array.flags.writeable = False
    return array


def _to_pixels(optics: Optics) -> Floats:
    """Return the factors from the meeting plane to source pixels and axes."""
    turned = optics.y_down and any(s.name == "flip" for s in optics.model.measured)
    return np.array([1.0, -1.0 if turned else 1.0]) / optics.pixel_size


def _selected(values: Floats, keep: Any) -> Floats:
    """Return some rows; of one value that stands for all rows no copies are made."""
    if values.strides[0] or isinstance(keep, slice):
        return np.asarray(values[keep])
    index = np.asarray(keep)
    count = int(index.sum()) if index.dtype == bool else len(index)
    return np.broadcast_to(values[:1], (count, *values.shape[1:])) if len(values) else values


def _equal(state: State) -> bool:
    return len({len(c) for c in state.cameras}) == 1


def _gather(state: State, camera: Ints) -> Floats:
    """Stack the parameters of cameras of one model among cameras of several."""
    used, inverse = np.unique(camera, return_inverse=True)
    return np.asarray(np.stack([state.cameras[i] for i in used])[inverse])
