"""Coordinates in any system that PROJ knows (extra ``geo``), as a local frame in which a block can be adjusted, and back.

A block is never adjusted in a projection: its coordinates are led to geographic ones on the ellipsoid of their own system (no change of
datum), with geoid heights to ellipsoidal heights h = H + N, and to the frame (east, north, up) that touches that ellipsoid. Standard
deviations count along the axes of the system, in metres for geographic ones; covariances follow by C' = J C J' with the partials J of the
whole way, and back by the inverse. x comes first: easting or longitude, then northing or latitude.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda.errors import InputError, MissingExtra, UsageError
from baarda.geometry.tangent_frame import A, F, TangentFrame, geocentric

Floats = NDArray[np.float64]

#: keys of the settings of a network
SYSTEM, FRAME, GEOID = "coordinate_system", "reference_lla", "geoid_height"
_ELLIPSOID = "ellipsoid"  # semi-major axis and inverse flattening, where it is not WGS 84
_CHOSEN: set[str] = set()  # grids that the user named in this process: a project file alone must not lead to other files
_STEP = 1.0  # metres: of the difference quotients


@dataclass(frozen=True)
class Geoid:
    """Geoid heights N over the ellipsoid.

    Attributes
    ----------
    constant : float
        Metres.
    east, north : float
        Slopes of a plane through known geoid heights, metres per degree of longitude and latitude, about `middle`.
    middle : (2,) tuple
        Longitude and latitude.
    grid : str
        File of a grid that PROJ reads (GTX, GeoTIFF); empty = the plane.
    """

    constant: float = 0.0
    east: float = 0.0
    north: float = 0.0
    middle: tuple[float, float] = (0.0, 0.0)
    grid: str = ""

    def heights(self, longitude: Floats, latitude: Floats) -> Floats:
        """Return N in metres at places in degrees; NaN outside the grid."""
        if not self.grid:
            return np.asarray(self.constant + self.east * (longitude - self.middle[0]) + self.north * (latitude - self.middle[1]))
        proj = _pyproj("a grid of geoid heights")
        try:
            way = proj.Transformer.from_pipeline(
                f'+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=vgridshift +grids="{self.grid}" +multiplier=1'
            )
            n = way.transform(longitude, latitude, np.zeros_like(longitude))[2]
        except proj.exceptions.ProjError as error:
            raise UsageError(f"the grid of geoid heights {self.grid} cannot be used: {error}") from None
        return np.where(np.isfinite(n), n, np.nan)

    @staticmethod
    def through(longitude: Floats, latitude: Floats, heights: Floats) -> Geoid:
        """Return the plane through known geoid heights; their mean where they are fewer than three or on a line.

        Examples
        --------
        >>> g = Geoid.through(np.array([8.0, 8.1, 8.0]), np.array([46.0, 46.0, 46.1]), np.array([50.0, 50.1, 49.8]))
        >>> g.heights(np.array([8.05]), np.array([46.05])).round(6)
        array([49.95])
        """
        middle = float(longitude.mean()), float(latitude.mean())
        a = np.stack([np.ones_like(longitude), longitude - middle[0], latitude - middle[1]], axis=1)
        scale = np.abs(a).max(axis=0)
        if len(a) < 3 or (scale == 0.0).any() or np.linalg.matrix_rank(a / scale, tol=1e-6) < 3:
            return Geoid(float(heights.mean()))
        found = np.linalg.lstsq(a / scale, heights, rcond=None)[0] / scale
        return Geoid(float(found[0]), float(found[1]), float(found[2]), middle)


def _pyproj(what: str) -> Any:
    try:
        return import_module("pyproj")
    except ImportError:
        raise MissingExtra("geo", what) from None


@dataclass(frozen=True)
class CoordinateSystem:
    """A system of coordinates on the earth.

    Attributes
    ----------
    name : str
        As it was given.
    kind : {"projected", "geographic", "geocentric"}
    ellipsoid : (2,) tuple
        Semi-major axis in metres, flattening.
    units : (2,) tuple
        Metres per unit of plan (1 for geographic) and of height.
    angle : float
        Degrees per unit of its geographic coordinates (0.9 for gon).
    vertical : bool
        Whether heights are above a vertical datum, not the ellipsoid, so that geoid heights are needed.
    geoid : Geoid or None
    to_geographic, from_geographic : callable
        x, y to longitude, latitude in units of the system's own geographic coordinates, and back.
    """

    name: str
    kind: str
    ellipsoid: tuple[float, float]
    units: tuple[float, float]
    angle: float
    vertical: bool
    geoid: Geoid | None
    to_geographic: Any = field(repr=False, compare=False)
    from_geographic: Any = field(repr=False, compare=False)

    @staticmethod
    def of(name: str, geoid: str | float | None = None) -> CoordinateSystem:
        """Return a system by its name.

        Parameters
        ----------
        name : str
            An EPSG code (``EPSG:25832``, ``EPSG:25832+7837``), WKT or a proj string.
        geoid : str or float, optional
            Geoid height in metres, or the file of a grid.

        Raises
        ------
        UsageError
            If the system or the geoid cannot be used.
        MissingExtra
            If pyproj is not there.
        """
        proj = _pyproj(f"the coordinate system {name!r:.80}")
        try:
            whole = proj.CRS.from_user_input(name)
        except proj.exceptions.CRSError as error:
            raise UsageError(f"the coordinate system {name!r:.80} is not known: {str(error)[:200]}") from None
        parts = list(whole.sub_crs_list) if whole.is_compound else [whole]
        plan, vertical = parts[0], parts[1] if len(parts) > 1 else None
        kind = "projected" if plan.is_projected else "geocentric" if plan.is_geocentric else "geographic" if plan.is_geographic else ""
        if not kind or plan.ellipsoid is None:
            raise UsageError(f"the coordinate system {name!r:.80} is neither projected, geographic nor geocentric")
        plane = 1.0 if kind != "projected" else float(plan.axis_info[0].unit_conversion_factor)
        upright = [axis for axis in (vertical or plan).axis_info if axis.direction in ("up", "down")]
        height = float(upright[0].unit_conversion_factor) if upright else plane
        if upright and upright[0].direction == "down":
            raise UsageError(f"the coordinate system {name!r:.80} counts depths, not heights")
        to, back = None, None
        if kind == "projected":
            try:
                to = proj.Transformer.from_crs(plan, plan.geodetic_crs, always_xy=True)
                back = proj.Transformer.from_crs(plan.geodetic_crs, plan, always_xy=True)
            except proj.exceptions.ProjError as error:
                raise UsageError(f"the coordinate system {name!r:.80} cannot be used: {error}") from None
        e = plan.ellipsoid
        flattening = 1.0 / e.inverse_flattening if e.inverse_flattening else 0.0
        angle = 1.0 if kind == "geocentric" else float(np.degrees(plan.geodetic_crs.axis_info[0].unit_conversion_factor))
        return CoordinateSystem(
            name, kind, (float(e.semi_major_metre), flattening), (plane, height), angle, vertical is not None, _geoid(geoid), to, back
        )

    # ---- points ----

    def geographic(self, xyz: Floats) -> Floats:
        """Return latitude, longitude (degrees) and ellipsoidal height (metres) of coordinates, (n, 3) to (n, 3); not finite outside."""
        xyz = np.asarray(xyz, dtype=float)
        if self.kind == "geocentric":
            return TangentFrame(0.0, 0.0, 0.0, *self.ellipsoid).geographic(_from_geocentric(xyz, self.ellipsoid))
        x, y = xyz[:, 0], xyz[:, 1]
        longitude, latitude = self.angle * np.asarray((x, y) if self.to_geographic is None else self.to_geographic.transform(x, y))
        h = xyz[:, 2] * self.units[1]
        if self.geoid is not None:
            h = h + self.geoid.heights(longitude, latitude)
        return np.stack([latitude, longitude, h], axis=1)

    def coordinates(self, lla: Floats) -> Floats:
        """Return the coordinates of latitude, longitude (degrees) and ellipsoidal height (metres), (n, 3) to (n, 3)."""
        lla = np.asarray(lla, dtype=float)
        if self.kind == "geocentric":
            return geocentric(lla, *self.ellipsoid)
        latitude, longitude, h = lla.T
        if self.geoid is not None:
            h = h - self.geoid.heights(longitude, latitude)
        x, y = longitude / self.angle, latitude / self.angle
        if self.from_geographic is not None:
            x, y = self.from_geographic.transform(x, y)
        return np.stack([x, y, h / self.units[1]], axis=1)

    def frame(self, xyz: Floats) -> TangentFrame:
        """Return the frame that touches the ellipsoid, height 0, in the middle of points."""
        lla = self.geographic(xyz)
        return TangentFrame(float(np.mean(lla[:, 0])), float(np.mean(lla[:, 1])), 0.0, *self.ellipsoid)

    def to_local(self, xyz: Floats, frame: TangentFrame) -> Floats:
        """Return east, north, up of coordinates, metres."""
        return frame.local(self.geographic(xyz))

    def from_local(self, local: Floats, frame: TangentFrame) -> Floats:
        """Return the coordinates of east, north, up."""
        return self.coordinates(frame.geographic(np.asarray(local, dtype=float)))

    def partials(self, local: Floats, frame: TangentFrame) -> Floats:
        """Return d(east, north, up)/d(axes of the system), (n, 3, 3); metres per metre, or per unit of a projection.

        The axes of a geographic system are east, north, up at each point; a geocentric one turns only.
        """
        local = np.asarray(local, dtype=float)
        n = len(local)
        if self.kind == "geocentric":
            return np.broadcast_to(frame.rotation, (n, 3, 3)).copy()
        if self.kind == "geographic":
            lla = frame.geographic(local)
            own = np.array([TangentFrame(la, lo, 0.0).rotation for la, lo, _ in lla.tolist()]).reshape(n, 3, 3)
            out = frame.rotation @ own.transpose(0, 2, 1)
            out[:, :, 2] *= self.units[1]
            return np.asarray(out)
        steps = np.array([_STEP / self.units[0], _STEP / self.units[0], _STEP / self.units[1]])
        xyz = self.from_local(local, frame)
        out = np.empty((n, 3, 3))
        for k in range(3):
            e = np.zeros(3)
            e[k] = steps[k]
            out[:, :, k] = (self.to_local(xyz + e, frame) - self.to_local(xyz - e, frame)) / (2.0 * steps[k])
        return out

    def to_wgs84(self, lla: Floats) -> Floats:
        """Return latitude, longitude and ellipsoidal height in WGS 84 of those on the system's own ellipsoid, as PROJ leads over."""
        proj = _pyproj("WGS 84")
        plan = proj.CRS.from_user_input(self.name)
        plan = plan.sub_crs_list[0] if plan.is_compound else plan
        way = proj.Transformer.from_crs(plan.geodetic_crs.to_3d() if self.kind != "geocentric" else plan, "EPSG:4979", always_xy=True)
        if self.kind == "geocentric":
            longitude, latitude, h = way.transform(*geocentric(lla, *self.ellipsoid).T)
        else:
            longitude, latitude, h = way.transform(lla[:, 1] / self.angle, lla[:, 0] / self.angle, lla[:, 2])
        return np.stack([latitude, longitude, h], axis=1)

    # ---- the network remembers ----

    def settings(self, frame: TangentFrame) -> dict[str, Any]:
        """Return what a network keeps of the system and the frame."""
        out: dict[str, Any] = {SYSTEM: self.name, FRAME: (frame.latitude, frame.longitude, frame.height)}
        if abs(self.ellipsoid[0] - A) > 0.01 or abs(self.ellipsoid[1] - F) > 1e-9:
            out[_ELLIPSOID] = self.ellipsoid
        if self.geoid is not None:
            g = self.geoid
            out[GEOID] = g.grid or (g.constant, g.east, g.north, *g.middle)
        return out

    def text(self) -> str:
        """Return one sentence on the system for the assumptions."""
        if self.geoid is not None:
            g = self.geoid
            how = f"of the grid {Path(g.grid).name}" if g.grid else f"{g.constant:.6g} m" + (" and its slopes" if g.east or g.north else "")
            heights = f"heights are above a vertical datum, geoid heights {how} lead to the ellipsoid"
        elif self.vertical:
            heights = (
                "heights are above a vertical datum, and no geoid heights are given: they are taken as ellipsoidal, which tilts and "
                "shifts the block by the geoid (--geoid gives them)"
            )
        else:
            heights = "heights are ellipsoidal"
        return f"coordinate system {self.name:.80}: {heights}"


def _geoid(given: str | float | None) -> Geoid | None:
    if given is None:
        return None
    try:
        value = float(given)
    except ValueError:
        path = Path(str(given))
        if not path.is_file():
            raise UsageError(f"the geoid is a height in metres or the file of a grid, not {str(given)!r:.80}") from None
        if any(c in str(path) for c in '"\n\r'):
            raise UsageError("the name of the grid of geoid heights must not hold quotes") from None
        _CHOSEN.add(str(path.resolve()))
        return Geoid(grid=str(path.resolve()))
    if not abs(value) < 1e4:
        raise UsageError(f"the geoid height must be metres, not {given!r}")
    return Geoid(value)


def _from_geocentric(xyz: Floats, ellipsoid: tuple[float, float]) -> Floats:
    """Return geocentric coordinates as east, north, up of the frame at latitude 0, longitude 0."""
    frame = TangentFrame(0.0, 0.0, 0.0, *ellipsoid)
    return np.asarray((xyz - frame.origin) @ frame.rotation.T)


def system_of(settings: Any) -> tuple[CoordinateSystem, TangentFrame] | None:
    """Return system and frame that the settings of a network name, None where they name none.

    Raises
    ------
    UsageError
        If a project states something else.
    MissingExtra
        If pyproj is not there.
    """
    if SYSTEM not in settings:
        return None
    try:
        frame = TangentFrame(*(float(v) for v in settings[FRAME]), *(float(v) for v in settings.get(_ELLIPSOID, ())))
        system = CoordinateSystem.of(str(settings[SYSTEM]))
        given = settings.get(GEOID)
        if isinstance(given, str):
            if given not in _CHOSEN:
                raise UsageError(f"the block belongs to a grid of geoid heights ({Path(given).name!r:.80}): give it again by --geoid")
            system = replace(system, geoid=Geoid(grid=given))
        elif given is not None:
            c, east, north, lon, lat = (float(v) for v in given)
            system = replace(system, geoid=Geoid(c, east, north, (lon, lat)))
    except (TypeError, ValueError, KeyError):
        raise UsageError(f"{SYSTEM}, {FRAME} and {GEOID} of the project do not fit together") from None
    return system, frame


def checked(lla: Floats, xyz: Floats, system: CoordinateSystem, error: Any) -> None:
    """Refuse coordinates that lie outside their system.

    Parameters
    ----------
    lla, xyz : (n, 3) arrays
        Geographic coordinates and those of the system.
    system : CoordinateSystem
    error : callable
        Row and message to the error with file and line.
    """
    good = np.isfinite(lla).all(axis=1) & (np.abs(lla[:, 0]) <= 90.0) & (np.abs(lla[:, 1]) <= 540.0) & (np.abs(lla[:, 2]) < 1e6)
    if system.kind == "projected" and good.any():  # beyond its area a projection does not lead back to where it began
        back = system.coordinates(np.where(good[:, None], lla, 0.0))
        good &= np.abs(back[:, :2] - xyz[:, :2]).max(axis=1) < 1.0
    if not good.all():
        i = int(np.argmin(good))
        found: InputError = error(
            i, f"coordinates {xyz[i, 0]:.10g}, {xyz[i, 1]:.10g} lie outside the system {system.name:.60} (easting or longitude comes first)"
        )
        raise found
