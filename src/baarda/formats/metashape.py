"""Agisoft Metashape: exported XML of cameras and markers, ``.psz`` archives and ``.psx`` projects with their tie points.

A camera's 4 x 4 matrix leads from its axes (x right, y down, z forward) into the system of the chunk, and the chunk's transform on to the
world: X = t + s R x. With local coordinates the world is the markers' system; with geographic or projected ones it is geocentric, and the
network stands in the frame (east, north, up) that touches the ellipsoid at the markers' or cameras' mean. Pixels count from the corner of
the first one. For the camera see `baarda.cameras.metashape`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda import cameras as camera_models
from baarda.cameras import Camera
from baarda.errors import InputError
from baarda.formats import checks
from baarda.formats.base import Format, MeasuredPositions
from baarda.formats.gcp_marks import Marks, put_on_control, with_marks
from baarda.formats.geographic import latitude_longitude
from baarda.formats.metashape_document import Chunk, looks_like, opened
from baarda.formats.ply_table import vertices
from baarda.formats.xml_tree import Element
from baarda.geometry.tangent_frame import TangentFrame
from baarda.network import CHECK, CONTROL, TIE, Images, Network, Points
from baarda.observations import ImagePoints

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

AXES = np.diag([1.0, -1.0, -1.0])  # Metashape's camera axes in ours
#: Metashape's accuracies where the chunk does not say them: pixels, pixels, metres
_USUAL = {"accuracy_tiepoints": 1.0, "accuracy_projections": 0.5, "accuracy_markers": 0.005}
_CAMERAS = ("accuracy_cameras", 10.0)  # metres
_NAMES = {
    "principal_distance": "f", "principal_point_x": "cx", "principal_point_y": "cy", "K1": "k1", "K2": "k2", "K3": "k3", "K4": "k4",
    "P1": "p1", "P2": "p2", "B1": "b1", "B2": "b2",
}  # fmt: skip
_REFUSED = ("p3", "p4")


def read(path: Path) -> Network:
    """Read a Metashape project, archive or XML export.

    Parameters
    ----------
    path : Path
        ``.psx`` with its folder beside it, ``.psz``, or an XML file that holds cameras and the marks of markers.

    Returns
    -------
    Network
        Images by their labels, tie points by their track numbers, markers by their labels: enabled ones are control, others check
        points.

    Raises
    ------
    InputError
        With file and line, if something cannot be used or is not supported.
    """
    with opened(path) as chunk:
        return _Reader(chunk).network()


def positions(path: Path) -> MeasuredPositions:
    """Return the measured positions of the enabled cameras, in the system of the network.

    Raises
    ------
    InputError
        With file and line, if there are none or one cannot be used.
    """
    with opened(path) as chunk:
        return _Reader(chunk).positions()


@dataclass
class _World:
    """From chunk coordinates to the network: X = t + s R x, then the tangent frame."""

    rotation: Floats
    translation: Floats
    scale: float
    frame: TangentFrame | None = None

    def points(self, x: Floats) -> Floats:
        out = self.scale * x @ self.rotation.T + self.translation
        return np.asarray(out if self.frame is None else (out - self.frame.origin) @ self.frame.rotation.T)

    def turned(self, rotation: Floats) -> Floats:
        """Return rotations that take network coordinates instead of chunk coordinates."""
        whole = self.rotation if self.frame is None else self.frame.rotation @ self.rotation
        return np.asarray(rotation @ whole.T)


def _complaint(element: Element) -> checks.Complaint:
    return lambda _row, message: element.error(message)


class _Reader:
    """A chunk while its parts are collected."""

    def __init__(self, chunk: Chunk) -> None:
        self.source, self.chunk = chunk, chunk.chunk
        self.notes: list[str] = []
        self.geographic: str | None = None
        self.image_of: dict[str, int] = {}
        if chunk.others:
            self.notes.append(f"{chunk.others} further chunk(s) are not read")
        bars = len(self.chunk.all("scalebars", "scalebar"))
        if bars:
            self.notes.append(f"{bars} scale bar(s) are not used: give them as distances of a project")
        self.accuracy = {k: self._property(self.chunk.first("settings"), k, v) for k, v in _USUAL.items()}

    def _property(self, where: Element | None, name: str, default: float) -> float:
        for p in () if where is None else where.all("property"):
            if p.attributes.get("name") == name:
                value = p.value("value")
                if not 1e-9 < value < 1e9:
                    raise p.error(f"{name} must be positive, not {value!r}")
                return value
        self.notes.append(f"{name} is not said: {default:g} is assumed, Metashape's default")
        return default

    def network(self) -> Network:
        sensors = {s.word("id"): s for s in (*self.chunk.all("sensors", "sensor"), *self.chunk.all("sensors", "group", "sensor"))}
        found = self._images(sensors)
        labels, elements, owner, matrices, used = found
        self.image_of = {e.word("id"): i for i, e in enumerate(elements)}
        cameras = tuple(self._camera(s) for s in used)
        markers = self.chunk.all("markers", "marker") + self.chunk.all("markers", "group", "marker")
        world = self._world(markers)
        matrix = np.array(matrices)
        position = matrix[:, :3, 3] if world is None else world.points(matrix[:, :3, 3])
        rotation = matrix[:, :3, :3].transpose(0, 2, 1)
        rotation = AXES @ (rotation if world is None else world.turned(rotation))
        ids, xyz, image, point, xy = self._tie_points()
        network = Network(
            cameras,
            Images.make(labels, owner, position, rotation),
            Points.make([str(i) for i in ids.tolist()], xyz if world is None else world.points(xyz)),
            (ImagePoints.make(image, point, xy, self.accuracy["accuracy_tiepoints"]),) if len(image) else (),
            unit=checks.MODEL_UNITS if world is None else "m",
            name=self.chunk.attributes.get("label", "") if self.chunk.attributes.get("label", "").isprintable() else "",
            format="metashape",
        )
        marks, roles, sigmas = self._markers(markers, world)
        if marks is not None:
            network = with_marks(
                network, marks, sigmas, self.notes, move=False, roles=roles, sigma_marks=self.accuracy["accuracy_projections"]
            )
        if not network.observations:
            raise InputError(
                "no image points: an export of cameras alone has none; export the markers with it, or read the .psz or .psx",
                self.source.file,
            )
        measured = np.concatenate([g.images for g in network.observations])
        checks.images_with_points(measured, labels, np.ones(len(labels), dtype=bool), lambda i, m: elements[i].error(m))
        if world is None and marks is not None:
            network = put_on_control(network, self.source.file, self.notes)
        if any(e.first("reference") is not None for e in elements):
            self.notes.append("measured camera positions are not used: --camera-positions source uses them, a table gives others")
        return replace(network, assumptions=(*network.assumptions, *self.notes))

    # ---- cameras and images ----

    def _images(self, sensors: dict[str, Element]) -> tuple[list[str], list[Element], list[int], list[Floats], list[Element]]:
        labels: dict[str, Element] = {}
        elements, owner, matrices = [], [], []
        used: dict[str, int] = {}
        left = 0
        for c in (*self.chunk.all("cameras", "camera"), *self.chunk.all("cameras", "group", "camera")):
            transform = c.first("transform")
            if transform is None or not c.flag("enabled", True):
                left += 1
                continue
            label, sensor = c.word("label"), c.word("sensor_id")
            if label in labels:
                raise c.error(f"camera {label!r} appears twice (first in line {labels[label].line})")
            if sensor not in sensors:
                raise c.error(f"sensor {sensor!r} is not among the sensors")
            m = transform.numbers(16).reshape(4, 4)
            checks.rotation_matrices(m[None, :3, :3], _complaint(transform))
            labels[label] = c
            elements.append(c)
            owner.append(used.setdefault(sensor, len(used)))
            matrices.append(m)
        if not elements:
            raise self.chunk.error("no camera is enabled and aligned")
        if left:
            self.notes.append(f"{left} camera(s) that are disabled or not aligned are left out")
        return list(labels), elements, owner, matrices, [sensors[s] for s in used]

    def _camera(self, sensor: Element) -> Camera:
        kind = sensor.attributes.get("type", "frame")
        if kind != "frame":
            raise sensor.error(f"sensor type {kind!r:.40} is not supported; frame is")
        of_class = {c.attributes.get("class", "adjusted"): c for c in sensor.all("calibration")}
        calibration = of_class.get("adjusted", of_class.get("initial"))
        if calibration is None:
            raise sensor.error("the sensor has no calibration")
        if calibration.first("fx") is not None:
            raise calibration.error("a calibration with fx and fy (PhotoScan before 1.3) is not supported: save it by a newer version")
        for name in _REFUSED:
            element = calibration.first(name)
            if element is not None and element.numbers(1)[0] != 0.0:
                raise element.error("this coefficient is not supported")
        resolution = calibration.first("resolution") or sensor.need("resolution")
        size = (resolution.value("width"), resolution.value("height"))
        if min(size) < 1:
            raise resolution.error("width and height must be positive")
        values = {}
        for name, tag in _NAMES.items():
            element = calibration.need(tag) if tag == "f" else calibration.first(tag)
            values[name] = 0.0 if element is None else float(element.numbers(1)[0])
            if element is not None and not abs(values[name]) < 1e9:
                raise element.error("the value is beyond all lenses")
        if not values["principal_distance"] > 0.0:
            raise calibration.need("f").error("the principal distance must be positive")
        values["principal_point_x"] += 0.5 * size[0]
        values["principal_point_y"] += 0.5 * size[1]
        label = sensor.attributes.get("label", "").strip()
        label = f"{sensor.word('id')} {label}".strip() if label.isprintable() else sensor.word("id")
        return camera_models.create(
            label, camera_models.model("metashape"), values, free=self._estimated(sensor, label, values), image_size=size
        )

    def _estimated(self, sensor: Element, label: str, values: dict[str, float]) -> list[str]:
        """Return the parameters that Metashape estimated: those of its covariance, else f, cx, cy and all coefficients that are not 0."""
        fixed = next((p.flag("value", False) for p in sensor.all("property") if p.attributes.get("name") == "fixed"), False)
        if fixed:
            self.notes.append(f"camera {label}: its calibration is fixed in Metashape, so it is here")
            return []
        listed = sensor.first("covariance", "params")
        if listed is not None:
            names = listed.text.lower().split()
            return [name for name, tag in _NAMES.items() if tag in names]
        self.notes.append(f"camera {label}: what was estimated is not said; free are f, cx, cy and the coefficients that are not 0")
        return [n for n in _NAMES if n.startswith("principal") or values[n] != 0.0]

    # ---- the world ----

    def _world(self, markers: list[Element]) -> _World | None:
        transform = self.chunk.first("transform")
        if transform is None or transform.first("translation") is None:
            return None
        rotation = transform.need("rotation").numbers(9).reshape(3, 3)
        checks.rotation_matrices(rotation[None], lambda _, m: transform.need("rotation").error(m))
        element = transform.first("scale")
        scale = 1.0 if element is None else float(element.numbers(1)[0])
        if not scale > 0.0:
            raise transform.need("scale").error("the scale must be positive")
        out = _World(rotation, transform.need("translation").numbers(3), scale)
        reference = self.chunk.first("reference")
        crs = "" if reference is None else reference.text
        local = not crs or crs.upper().startswith("LOCAL_CS")
        self.geographic = None if local else crs
        if not local:
            xyz = np.array([self._reference(m)[0] for m in markers]).reshape(-1, 3)
            known = xyz[np.isfinite(xyz).all(axis=1)]
            if not len(known):
                origin = self._from_geocentric(out.translation)
            else:
                origin = latitude_longitude(known, crs, self.source.file).mean(axis=0)
            out.frame = TangentFrame(float(origin[0]), float(origin[1]), 0.0)
            self.notes.append(
                "coordinates stand in the frame (east, north, up) that touches the ellipsoid at latitude "
                f"{out.frame.latitude!r}, longitude {out.frame.longitude!r}, height 0; heights are taken as ellipsoidal"
            )
        return out

    @staticmethod
    def _from_geocentric(xyz: Floats) -> Floats:
        """Return latitude and longitude in degrees near geocentric coordinates, height 0: enough to place a frame."""
        horizontal = float(np.hypot(xyz[0], xyz[1]))
        latitude = np.arctan2(xyz[2], horizontal * (1.0 - 0.00669437999014))
        return np.array([np.degrees(latitude), np.degrees(np.arctan2(xyz[1], xyz[0])), 0.0])

    def positions(self) -> MeasuredPositions:
        """Return the measured positions of cameras; see `positions`."""
        self.notes.clear()
        usual = self._property(self.chunk.first("settings"), *_CAMERAS)
        cameras = (*self.chunk.all("cameras", "camera"), *self.chunk.all("cameras", "group", "camera"))
        found = [(c, *self._reference(c, usual, "camera")) for c in cameras if c.flag("enabled", True) and c.attributes.get("label")]
        found = [f for f in found if f[3] and np.isfinite(f[1]).all()]
        if not found:
            raise self.chunk.error("no camera has a measured position that is enabled")
        xyz, sigmas = np.array([f[1] for f in found]), np.array([f[2] for f in found])
        markers = self.chunk.all("markers", "marker") + self.chunk.all("markers", "group", "marker")
        world = self._world(markers)
        crs = self.chunk.first("reference")
        if crs is not None and crs.text and not crs.text.upper().startswith("LOCAL_CS"):
            frame = None if world is None else world.frame
            if frame is None:  # as the markers found it
                known = np.array([self._reference(m)[0] for m in markers]).reshape(-1, 3)
                known = known[np.isfinite(known).all(axis=1)]
                frame = TangentFrame(*latitude_longitude(known if len(known) else xyz, crs.text, self.source.file).mean(axis=0))
            xyz = frame.local(latitude_longitude(xyz, crs.text, self.source.file))
        covariances = np.einsum("ni,ij->nij", sigmas**2, np.eye(3))
        notes = [n for n in self.notes if n.startswith(_CAMERAS[0])]
        labels = tuple(f[0].word("label") for f in found)
        return MeasuredPositions(
            self.source.file, labels, xyz, covariances, ("all",) * len(labels), None, lambda i, m: found[i][0].error(m), tuple(notes)
        )

    def _reference(self, marker: Element, usual: float | None = None, what: str = "marker") -> tuple[Floats, Floats, bool]:
        """Return coordinates, standard deviations and whether a marker or camera takes part."""
        r = marker.first("reference")
        if r is None:
            return np.full(3, np.nan), np.full(3, np.nan), False
        xyz = np.array([r.value(a, np.nan) for a in "xyz"])
        usual = self.accuracy["accuracy_markers"] if usual is None else usual
        whole = r.value("sxyz", usual)
        plan = r.value("sxy", whole)
        sigma = np.array([r.value("sx", plan), r.value("sy", plan), r.value("sz", whole)])
        checks.sigma_range(sigma, f"the accuracy of a {what}", lambda _, m: r.error(m))
        if not (sigma > 0.0).all():
            raise r.error(f"the accuracy of a {what} must be positive")
        return xyz, sigma, r.flag("enabled", True)

    # ---- image points ----

    def _tie_points(self) -> tuple[Ints, Floats, Ints, Ints, Floats]:
        cloud = self.source.cloud
        nothing = np.zeros(0, dtype=np.intp)
        if cloud is None:
            return nothing, np.zeros((0, 3)), nothing, nothing, np.zeros((0, 2))
        ids, xyz = [], []
        for element in cloud.all("points"):
            table = vertices(*self.source.part(element.word("path")), ("x", "y", "z", "id"))
            ids.append(table["id"].astype(np.int64))
            xyz.append(np.stack([table[a].astype(float) for a in "xyz"], axis=1))
        number = np.concatenate(ids) if ids else np.zeros(0, dtype=np.int64)
        coordinates = np.concatenate(xyz) if xyz else np.zeros((0, 3))
        if not np.isfinite(coordinates).all():
            raise cloud.error("a tie point is not finite")
        order = np.argsort(number, kind="stable")
        number, coordinates = number[order], coordinates[order]
        if len(np.unique(number)) < len(number):
            raise cloud.error("a tie point appears twice")
        image, point, xy = [], [], []
        unused = 0
        for element in cloud.all("projections"):
            camera = self.image_of.get(element.word("camera_id"))
            if camera is None:
                continue
            table = vertices(*self.source.part(element.word("path")), ("x", "y", "id"))
            id_ = table["id"].astype(np.int64)
            at = np.minimum(np.searchsorted(number, id_), max(len(number) - 1, 0))
            good = number[at] == id_ if len(number) else np.zeros(len(id_), dtype=bool)
            unused += int((~good).sum())
            where = np.stack([table["x"].astype(float), table["y"].astype(float)], axis=1)[good]
            if not (np.abs(where) < 1e9).all():
                raise element.error("a projection is not finite")
            image.append(np.full(int(good.sum()), camera))
            point.append(at[good])
            xy.append(where)
        if unused:
            self.notes.append(f"{unused} projection(s) of tracks without a tie point are left out, as Metashape does")
        images, points = (np.concatenate(a).astype(np.intp) if a else nothing for a in (image, point))
        labels = [str(i) for i in number.tolist()]
        checks.measured_once(images, points, labels, lambda _, m: cloud.error(m), lambda _: cloud.line)
        if len(points):
            self.notes.append("tie points keep the accuracy of the chunk; Metashape also weights them by the size of the features")
        return number.astype(np.intp), coordinates, images, points, np.concatenate(xy) if xy else np.zeros((0, 2))

    def _markers(self, markers: list[Element], world: _World | None) -> tuple[Marks | None, Any, Any]:
        labels: dict[str, Element] = {}
        index: dict[str, int] = {}
        for m in markers:
            label = m.word("label", f"marker {m.word('id')}")
            if label in labels:
                raise m.error(f"marker {label!r} appears twice (first in line {labels[label].line})")
            index[m.word("id")] = len(labels)
            labels[label] = m
        frame = self.source.frame
        rows, xy, guessed = [], [], 0
        for m in () if frame is None else frame.all("markers", "marker"):
            number = m.word("marker_id")
            if number not in index:
                raise m.error(f"marker {number!r} is not among the markers of the chunk")
            for location in m.all("location"):
                camera = self.image_of.get(location.word("camera_id"))
                if camera is None or not location.flag("valid", True):
                    continue
                if not location.flag("pinned", True):
                    guessed += 1
                    continue
                rows.append((index[number], camera, location))
                xy.append((location.value("x"), location.value("y")))
        if guessed:
            self.notes.append(f"{guessed} marker projection(s) that are not pinned are Metashape's guesses, not observations: left out")
        if not rows:
            return None, None, None
        points, images = (np.array([r[k] for r in rows], dtype=np.intp) for k in (0, 1))
        checks.measured_once(images, points, list(labels), lambda i, m: rows[i][2].error(m), lambda i: rows[i][2].line)
        given, sigmas, enabled = (np.array(v) for v in zip(*(self._reference(m) for m in labels.values()), strict=True))
        known = np.isfinite(given).all(axis=1)
        if self.geographic is not None and known.any():
            frame_ = None if world is None else world.frame
            lla = latitude_longitude(given[known], self.geographic, self.source.file)
            frame_ = frame_ or TangentFrame(*lla.mean(axis=0))
            given = np.full(given.shape, np.nan)
            given[known] = frame_.local(lla)
        roles = np.where(~np.isfinite(given).any(axis=1), TIE, np.where(enabled, CONTROL, CHECK))
        return Marks(self.source.file, tuple(labels), given, points, images, np.array(xy)), roles, sigmas


metashape = Format(
    "metashape", "Agisoft Metashape: .psx, .psz, or XML of cameras and markers", looks_like, read, positions=positions, first_pixel=0.5
)
