"""Open Photogrammetry Format (OPF 1.0), as Pix4D's programs and pyopf write it: ``project.opf``, JSON items, and tracks as glTF.

Coordinates are those of the processing system (the canonical right-handed system of the project) without its shift, so that they agree
with the coordinate system that the project names. A camera's angles lead from its axes (x right, y up, z back) to that system:
R_x(omega) R_y(phi) R_z(kappa) = M'. Pixels count from the corner of the first one. For the camera see `baarda.cameras.pix4d`. glTF counts y
upwards: (x, y, z) there is (x, -z, y) here.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from baarda import cameras as camera_models
from baarda.cameras import Camera
from baarda.errors import InputError
from baarda.formats import checks
from baarda.formats.base import Format, MeasuredPositions
from baarda.formats.gcp_marks import Marks, put_on_control, with_marks
from baarda.formats.gltf_tracks import Tracks, read_tracks
from baarda.formats.json_tree import Json, read_json
from baarda.geometry import rotation as rot
from baarda.network import CHECK, CONTROL, TIE, Images, Network, Points
from baarda.observations import Distances, ImagePoints

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

_PROJECT = "application/opf-project+json"
_LENS = ("R1", "R2", "R3", "T1", "T2")
_VERSION = re.compile(r"1\.\d+(-[\w.]+)?")


def _file(path: Path) -> Path | None:
    """Return the project file of a path: itself, or the only ``.opf`` of a folder."""
    if path.is_file():
        return path
    found = sorted(path.glob("*.opf")) if path.is_dir() else []
    return found[0] if len(found) == 1 and found[0].is_file() else None


def recognises(path: Path) -> bool:
    """Tell a project by the format that its JSON states."""
    file = _file(path)
    if file is None:
        return False
    with file.open("rb") as f:
        head = f.read(1 << 16).removeprefix(b"\xef\xbb\xbf").lstrip()
        if head.startswith(b"{") and _PROJECT.encode() not in head and file.suffix.lower() == ".opf":
            f.seek(0)
            head = f.read(1 << 24).removeprefix(b"\xef\xbb\xbf").lstrip()  # the format may stand after the items
    return head.startswith(b"{") and _PROJECT.encode() in head


def read(path: Path) -> Network:
    """Read an OPF project.

    Parameters
    ----------
    path : Path
        ``project.opf``, or the folder that holds it alone.

    Returns
    -------
    Network
        Images by their file names, tracks by their numbers, control and check points by their names; scale constraints as distances.

    Raises
    ------
    InputError
        With file and line, if something cannot be used or is not supported.
    """
    return _Project.open(path).network()


def positions(path: Path) -> MeasuredPositions:
    """Return the measured positions of the captures, in the processing system without its shift.

    Raises
    ------
    InputError
        If there are none.
    """
    return _Project.open(path).positions()


@dataclass
class _Project:
    """A project file, its items by their formats."""

    root: Json
    folder: Path
    resources: dict[str, list[tuple[str, Json]]]  # format -> type of the item and the uri

    @staticmethod
    def open(path: Path) -> _Project:
        file = _file(path)
        if file is None:
            raise InputError("not an OPF project: there must be one file .opf", path)
        root = read_json(file)
        if root.need("format").word() != _PROJECT:
            raise root.need("format").error(f"must be {_PROJECT!r}")
        version = root.need("version")
        if not _VERSION.fullmatch(version.word()):
            raise version.error(f"version {version.value!r:.40} of OPF is not supported; 1.0 is")
        resources: dict[str, list[tuple[str, Json]]] = {}
        for item in root.need("items").items():
            kind = item.need("type").word()
            for resource in item.need("resources").items():
                resources.setdefault(resource.need("format").word(), []).append((kind, resource.need("uri")))
        return _Project(root, file.parent, resources)

    def resolve(self, uri: Json) -> Path:
        """Return the file of a URI inside the project folder; anything else is refused."""
        text = unquote(uri.word())
        parts = PurePosixPath(text.replace("\\", "/"))
        if ":" in text or parts.is_absolute() or ".." in parts.parts or not parts.name or "\0" in text:
            raise uri.error(f"{text!r:.80} must be a path inside the folder of the project")
        file = self.folder / parts
        if not file.resolve().is_relative_to(self.folder.resolve()):
            raise uri.error(f"{text!r:.80} leads out of the folder of the project")
        return file

    def item(self, name: str, kind: str | None = None) -> Json | None:
        """Return the first JSON item of a format, None where there is none."""
        found = [uri for item, uri in self.resources.get(f"application/opf-{name}+json", []) if kind is None or item == kind]
        if not found:
            return None
        root = read_json(self.resolve(found[0]))
        if root.need("format").word() != f"application/opf-{name}+json":
            raise root.need("format").error(f"must be 'application/opf-{name}+json'")
        return root

    def need(self, name: str) -> Json:
        found = self.item(name)
        if found is None:
            raise self.root.error(f"the project has no {name.replace('-', ' ')}")
        return found

    # ---- parts ----

    def shift(self, notes: list[str]) -> Floats:
        """Return what the project added to the coordinates of its canonical system, and tell which system that is."""
        frame = self.item("scene-reference-frame")
        if frame is None:
            notes.append("the project names no reference frame: coordinates are those of its processing system")
            return np.zeros(3)
        transform = frame.need("base_to_canonical")
        scale, shift = transform.need("scale").numbers(3), transform.need("shift").numbers(3)
        crs = frame.need("crs").need("definition").word() if _plain(frame.need("crs").need("definition")) else "its WKT"
        swapped = transform.get("swap_xy")
        extra = ", axes X and Y exchanged" if swapped is not None and swapped.value is True else ""
        extra += ", scaled per axis" if (scale != 1.0).any() else ""
        notes.append(
            f"coordinates are those of the system {crs[:60]!r} that the project names{extra}: the block stays in it, as its program has it"
        )
        return shift

    def names(self) -> dict[str, str]:
        """Return the label of each camera: its file name where these differ, else its URI."""
        found = {c.need("id").label(): c.need("uri") for c in self.need("camera-list").need("cameras").items()}
        short = {k: PurePosixPath(unquote(u.word()).replace("\\", "/")).name for k, u in found.items()}
        if len(set(short.values())) < len(short) or not all(t.strip() for t in short.values()):
            return {k: u.label() for k, u in found.items()}
        return short

    def positions(self) -> MeasuredPositions:
        projected = self.need("projected-input-cameras")
        names = self.names()
        shift = self.shift([])
        camera_of = {}
        for capture in self.need("input-cameras").need("captures").items():
            camera_of[capture.need("id").label()] = capture.need("reference_camera_id").label()
        labels, xyz, sigmas, at = [], [], [], []
        for capture in projected.need("captures").items():
            place = capture.get("geolocation")
            camera = camera_of.get(capture.need("id").label())
            if place is None or camera not in names:
                continue
            labels.append(names[camera])
            xyz.append(place.need("position").numbers(3) - shift)
            sigmas.append(place.need("sigmas").numbers(3))
            at.append(place)
        if not labels:
            raise projected.error("no capture has a measured position")
        s = np.array(sigmas)
        if not (s > 0.0).all():
            raise at[int(np.argmin((s > 0.0).all(axis=1)))].error("the sigmas of a position must be positive")
        checks.sigma_range(s, "the sigma of a position", lambda i, m: at[i].error(m))
        covariances = np.einsum("ni,ij->nij", s**2, np.eye(3))
        strips = ("all",) * len(at)
        return MeasuredPositions(projected.file, tuple(labels), np.array(xyz), covariances, strips, None, lambda i, m: at[i].error(m))

    def cameras(self, calibrated: Json, notes: list[str]) -> tuple[list[Camera], dict[str, int]]:
        """Return the cameras and the index of each sensor."""
        sizes: dict[str, tuple[float, float]] = {}
        labels: dict[str, str] = {}
        for s in self.need("input-cameras").need("sensors").items():
            size = s.need("image_size_px").numbers(2)
            if min(size) < 1.0 or max(size) > 1e6:
                raise s.need("image_size_px").error("the image size must be positive")
            key = s.need("id").label()
            sizes[key] = (float(size[0]), float(size[1]))
            labels[key] = s.need("name").word().strip() or key
        out: list[Camera] = []
        index: dict[str, int] = {}
        for s in calibrated.need("sensors").items():
            key = s.need("id").label()
            if key in index or key not in sizes:
                raise s.need("id").error(f"sensor {key} appears twice" if key in index else f"sensor {key} is not among the input sensors")
            inner = s.need("internals")
            kind = inner.need("type").word()
            if kind != "perspective":
                raise inner.need("type").error(f"internals {kind!r:.40} are not supported; perspective ones are")
            f = inner.need("focal_length_px").number()
            if not 1.0 < f < 1e9:
                raise inner.need("focal_length_px").error("the focal length must be positive")
            lens = np.concatenate([inner.need("radial_distortion").numbers(3), inner.need("tangential_distortion").numbers(2)])
            if np.abs(lens).max() > 1e3:
                raise inner.error("a coefficient is beyond all lenses")
            centre = inner.need("principal_point_px").numbers(2)
            values = {"principal_distance": f, "principal_point_x": centre[0], "principal_point_y": centre[1]}
            index[key] = len(out)
            label = labels[key] if list(labels.values()).count(labels[key]) == 1 else key
            out.append(
                camera_models.create(
                    label,
                    camera_models.model("pix4d"),
                    {**values, **dict(zip(_LENS, lens.tolist(), strict=True))},
                    free=[*values, *(n for n, v in zip(_LENS, lens, strict=True) if v != 0.0)],
                    image_size=sizes[key],
                )
            )
        notes.append("what was estimated is not said: free are f, the principal point and the coefficients that are not 0")
        return out, index

    def network(self) -> Network:
        notes: list[str] = []
        calibrated = self.need("calibrated-cameras")
        names = self.names()
        shift = self.shift(notes)
        cameras, sensor_of = self.cameras(calibrated, notes)
        labels: dict[str, Json] = {}
        image_of: dict[str, int] = {}
        owner, position, angles = [], [], []
        rolling = 0
        for c in calibrated.need("cameras").items():
            key, sensor = c.need("id").label(), c.need("sensor_id").label()
            if key not in names:
                raise c.need("id").error(f"camera {key} is not in the camera list")
            if sensor not in sensor_of:
                raise c.need("sensor_id").error(f"sensor {sensor} is not among the calibrated sensors")
            if names[key] in labels:
                raise c.error(f"camera {names[key]!r} appears twice")
            rolling += c.get("rolling_shutter") is not None
            image_of[key] = len(labels)
            labels[names[key]] = c
            owner.append(sensor_of[sensor])
            position.append(c.need("position").numbers(3) - shift)
            angles.append(np.radians(c.need("orientation_deg").numbers(3)))
        if not labels:
            raise calibrated.error("there are no calibrated cameras")
        if rolling:
            notes.append(f"the rolling shutter of {rolling} camera(s) is not modelled")
        rotation = rot.from_angles(*np.array(angles).T)
        tracks = self.tracks()
        network = self._with_tracks(tracks, shift, image_of, cameras, Images.make(list(labels), owner, np.array(position), rotation), notes)
        used = sorted(set(owner))
        renumbered = np.array([used.index(i) for i in owner])
        network = replace(network, cameras=tuple(cameras[i] for i in used), images=replace(network.images, cameras=renumbered))
        network = self._with_control(network, image_of, shift, notes)
        if not network.observations:
            raise self.root.error("the project has no image points: neither tracks with image points nor marks of control points")
        measured = np.concatenate([g.images for g in network.observations])
        elements = list(labels.values())
        checks.images_with_points(measured, list(labels), np.ones(len(labels), dtype=bool), lambda i, m: elements[i].error(m))
        network = self._with_distances(network, notes)
        if self.item("projected-input-cameras") is not None:
            notes.append("measured camera positions are not used: --camera-positions source uses them")
        return replace(network, assumptions=(*network.assumptions, *notes))

    def tracks(self) -> Tracks | None:
        """Return the tracks of the calibration, None where it has none."""
        found = [uri for kind, uri in self.resources.get("model/gltf+json", []) if kind == "calibration"]
        if not found:
            return None
        allowed = [self.resolve(uri).resolve() for _, uri in self.resources.get("application/gltf-buffer+bin", [])]
        return read_tracks(self.resolve(found[0]), allowed)

    def _with_tracks(
        self, tracks: Tracks | None, shift: Floats, image_of: dict[str, int], cameras: list[Camera], images: Images, notes: list[str]
    ) -> Network:
        if tracks is None:
            return Network(tuple(cameras), images, Points.make([]), (), unit="m", name=_title(self.root))
        index = np.array([image_of.get(c, -1) for c in tracks.cameras], dtype=np.intp)
        image = index[tracks.camera] if len(tracks.camera) else tracks.camera
        keep = np.flatnonzero(image >= 0)
        if len(keep) < len(image):
            notes.append(f"{len(image) - len(keep)} image point(s) of tracks lie in images without calibration: left out")
        point = tracks.point[keep]
        used, number = np.unique(point, return_inverse=True)
        names = [str(i) for i in used.tolist()]
        checks.measured_once(image[keep], number, names, lambda _row, m: InputError(m, tracks.file), lambda _row: 0)
        group = ImagePoints.make(image[keep], number, tracks.xy[keep], 1.0)
        notes.append("tracks have the standard deviation 1 px, because an OPF project has none; --image-sigma sets another")
        return Network(
            tuple(cameras),
            images,
            Points.make(names, tracks.xyz[used] - shift),
            (group,) if len(keep) else (),
            unit="m",
            name=_title(self.root),
        )

    # ---- control ----

    def _with_control(self, network: Network, image_of: dict[str, int], shift: Floats, notes: list[str]) -> Network:
        source = self.item("input-control-points")
        if source is None:
            return network
        projected = self.item("projected-control-points")
        known = {} if projected is None else {g.need("id").label(): g for g in projected.need("projected_gcps").items()}
        labels: list[str] = []
        given, sigmas, roles, rows, xy, accuracy = [], [], [], [], [], []
        for kind in ("gcps", "mtps"):
            for p in source.need(kind).items():
                label = p.need("id").label()
                if label in labels:
                    raise p.error(f"point {label!r} appears twice")
                check = p.need("is_checkpoint")
                if not isinstance(check.value, bool):
                    raise check.error("must be true or false")
                place = known.get(label) if kind == "gcps" else None
                s = np.full(3, np.nan) if place is None else place.need("sigmas").numbers(3)
                if place is not None:
                    if not (s > 0.0).all():
                        raise place.need("sigmas").error("standard deviations must be positive")
                    checks.sigma_range(s, "a standard deviation", lambda _i, m, at=place: at.need("sigmas").error(m))  # type: ignore[misc]
                given.append(np.full(3, np.nan) if place is None else place.need("coordinates").numbers(3) - shift)
                sigmas.append(s)
                roles.append(CHECK if check.value and place is not None else CONTROL if place is not None else TIE)
                for m in p.need("marks").items():
                    image = image_of.get(m.need("camera_id").label())
                    a = m.need("accuracy").number()
                    if not 0.0 < a < 1e6:
                        raise m.need("accuracy").error("the accuracy must be positive")
                    if image is not None:
                        rows.append((len(labels), image))
                        xy.append(m.need("position_px").numbers(2))
                        accuracy.append(a)
                labels.append(label)
        lost = [label for label, r in zip(labels, roles, strict=True) if r == TIE and label not in known]
        if projected is None and len(source.need("gcps").array()):
            notes.append("the project has no projected control points: its control points are tie points; --control gives them")
        if not rows:
            return network
        pairs = np.array(rows, dtype=np.intp)
        checks.measured_once(pairs[:, 1], pairs[:, 0], labels, lambda _row, m: source.error(m), lambda _row: 0)
        marks = Marks(source.file, tuple(labels), np.array(given), pairs[:, 0], pairs[:, 1], np.array(xy))
        before = len(network.observations)
        network = with_marks(network, marks, np.array(sigmas), notes, move=False, roles=np.array(roles))
        group = replace(network.observations[before], sigmas=np.repeat(np.array(accuracy)[:, None], 2, axis=1))
        notes.append("marks have the accuracy that the project states, in pixels")
        if lost and projected is not None:
            notes.append(f"{len(lost)} manual tie point(s) without coordinates are tie points")
        network = replace(network, observations=(*network.observations[:before], group, *network.observations[before + 1 :]))
        return put_on_control(network, source.file, notes) if network.unit == checks.MODEL_UNITS else network

    def _with_distances(self, network: Network, notes: list[str]) -> Network:
        constraints = self.item("constraints")
        if constraints is None:
            return network
        of = {label.removeprefix("GCP "): i for i, label in enumerate(network.points.labels)}
        of.update({label: i for i, label in enumerate(network.points.labels) if label in of and label.startswith("GCP ")})
        rows, at = [], []
        for c in constraints.need("scale_constraints").items():
            ends = [of.get(c.need(k).label(), -1) for k in ("id_from", "id_to")]
            value, sigma = c.need("distance").number(), c.need("sigma").number()
            if not value > 0.0 or not sigma > 0.0:
                raise c.error("a scale constraint needs a positive distance and sigma")
            checks.sigma_range([sigma], "the sigma of a distance", lambda _i, m, at=c: at.error(m))  # type: ignore[misc]
            if min(ends) < 0 or ends[0] == ends[1]:
                notes.append(f"scale constraint {c.need('id').label()!r} is left out: its points are not measured")
                continue
            rows.append((*ends, value, sigma))
            at.append(c)
        turned = len(constraints.need("orientation_constraints").array())
        if turned:
            notes.append(f"{turned} orientation constraint(s) are not used")
        if not rows:
            return network
        t = np.array(rows)
        group = Distances(t[:, 0].astype(np.intp), t[:, 1].astype(np.intp), t[:, 2], t[:, 3], unit=network.unit, name="scale constraints")
        checks.distance_unit(group, network.points, network.unit, lambda i, m: at[i].error(m))
        return replace(network, observations=(*network.observations, group))


def _plain(value: Json) -> bool:
    return isinstance(value.value, str) and "\n" not in value.value


def _title(root: Json) -> str:
    name: Any = root.value.get("name", "")
    return name if isinstance(name, str) and name.isprintable() else ""


opf = Format(
    "opf",
    "Open Photogrammetry Format (.opf: calibrated cameras, tracks, control points)",
    recognises,
    read,
    positions=positions,
    first_pixel=0.5,
)
