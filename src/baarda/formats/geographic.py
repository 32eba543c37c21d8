"""Coordinates in a system that a source names, as latitude, longitude and height."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from baarda.errors import InputError, MissingExtra

Floats = NDArray[np.float64]

_WGS84 = re.compile(r"(WGS\s*_?\s*84|EPSG:4326|EPSG:4979|GEOGCS\[\"WGS 84\".*)", re.IGNORECASE | re.DOTALL)
_UTM = re.compile(r"WGS84\s+UTM\s+(\d{1,2})\s*([NS])", re.IGNORECASE)


def latitude_longitude(xyz: Floats, system: str, file: Path) -> Floats:
    """Return latitude, longitude (degrees) and height of coordinates x, y, z.

    Parameters
    ----------
    xyz : (n, 3) array
        Easting or longitude, northing or latitude, height.
    system : str
        ``WGS84``, ``WGS84 UTM 32N``, an EPSG code, a proj string or WKT.
    file : Path
        For messages.

    Raises
    ------
    InputError
        If the system is not known or the coordinates lie outside it.
    MissingExtra
        If the system is a projection, or another ellipsoid, and pyproj is not there.

    Examples
    --------
    >>> latitude_longitude(np.array([[13.4, 52.5, 30.0]]), "WGS84", Path("list.txt")).tolist()
    [[52.5, 13.4, 30.0]]
    """
    x, y, z = np.asarray(xyz, dtype=float).T
    if _WGS84.fullmatch(system.strip()):
        longitude, latitude = x, y
    else:
        try:
            pyproj = import_module("pyproj")
        except ImportError:
            raise MissingExtra("geo", f"{file}: coordinates in {system!r:.80}") from None
        utm = _UTM.fullmatch(system.strip())
        name = f"EPSG:{(32600 if utm[2].upper() == 'N' else 32700) + int(utm[1])}" if utm else system
        try:
            longitude, latitude = pyproj.Transformer.from_crs(name, "EPSG:4326", always_xy=True).transform(x, y)
        except pyproj.exceptions.ProjError as error:
            raise InputError(f"the coordinate system {system!r:.80} cannot be used: {error}", file) from None
    bad = ~(np.isfinite(latitude) & np.isfinite(longitude) & (np.abs(latitude) <= 90.0) & (np.abs(longitude) <= 360.0))
    if bad.any():
        i = int(np.flatnonzero(bad)[0])
        raise InputError(f"coordinates {x[i]!r}, {y[i]!r} lie outside the system {system!r:.80} (longitude comes first)", file)
    return np.stack([latitude, longitude, z], axis=1)
