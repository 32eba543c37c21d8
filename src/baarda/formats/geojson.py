"""Adjusted object points with their standard deviations: CSV tables, and GeoJSON (RFC 7946) where their place on the earth is known."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

import numpy as np

from baarda.errors import UsageError
from baarda.formats.coordinate_system import system_of
from baarda.formats.csv_table import csv_text, numbers_text, quoted
from baarda.formats.whole_file import write_file
from baarda.geometry.tangent_frame import TangentFrame
from baarda.network import AXES

_PAIRS, _INDICES = ("XY", "XZ", "YZ"), ((0, 1), (0, 2), (1, 2))
_DEGREES, _METRES = 11, 5  # decimals of GeoJSON: micrometres at the equator


def write_points(result: Any, path: str | Path, sigma: Literal["aposteriori", "apriori"] = "aposteriori") -> None:
    """Write the adjusted object points with standard deviations and correlations.

    Parameters
    ----------
    result : Adjustment
    path : str or Path
        A new file: ``.csv``, in the coordinate system of the control points where one was given, else in that of the network; or
        ``.geojson`` for networks in the frame (east, north, up) of a place that their source names.
    sigma : {"aposteriori", "apriori"}
        Which variance factor scales the cofactors.

    Raises
    ------
    UsageError
        If the ending is another one, the adjustment did not converge, or the place on the earth is not known.
    OutputError
        If the file exists or cannot be written.
    """
    path = Path(path)
    if result.status != "converged":
        raise UsageError("the adjustment did not converge: there are no points to write")
    if sigma not in ("aposteriori", "apriori"):
        raise UsageError(f"sigma is aposteriori or apriori, not {sigma!r}")
    table = result.point_table(sigma)
    names = ("point", "role", *AXES, "sX", "sY", "sZ", "corr_XY", "corr_XZ", "corr_YZ", "rays")
    columns = {n: np.asarray(table[n]) for n in names}
    if path.suffix.lower() == ".csv":
        columns = _in_their_system(result, columns)
        text = {n: numbers_text(c) if c.dtype.kind == "f" else [quoted(str(v)) for v in c.tolist()] for n, c in columns.items()}
        write_file(path, csv_text(text).encode("utf-8"))
        return
    if path.suffix.lower() not in (".geojson", ".json"):
        raise UsageError(f"points are written as .csv or .geojson, not {path.suffix!r}")
    write_file(path, _geojson(result, columns, sigma).encode("utf-8"))


def _in_their_system(result: Any, columns: dict[str, Any]) -> dict[str, Any]:
    """Return the columns in the coordinate system of the control points, covariances turned back; unchanged where none was given."""
    named = system_of(result.network.settings)
    if named is None:
        return columns
    system, frame = named
    local = np.stack([columns[a] for a in AXES], axis=1) - np.asarray(result.network.offset)
    xyz = system.from_local(local, frame)
    s = np.stack([columns[n] for n in ("sX", "sY", "sZ")], axis=1)
    r = np.nan_to_num(np.stack([columns[f"corr_{p}"] for p in _PAIRS], axis=1))  # a coordinate that was held fixed has none
    c = np.broadcast_to(np.eye(3), (len(s), 3, 3)).copy()
    for j, (a, b) in enumerate(_INDICES):
        c[:, a, b] = c[:, b, a] = r[:, j]
    back = np.linalg.inv(system.partials(local, frame))
    c = back @ (c * s[:, :, None] * s[:, None, :]) @ back.transpose(0, 2, 1)
    s = np.sqrt(np.einsum("nii->ni", c))
    with np.errstate(invalid="ignore", divide="ignore"):
        turned = {f"corr_{p}": c[:, a, b] / (s[:, a] * s[:, b]) for p, (a, b) in zip(_PAIRS, _INDICES, strict=True)}
    out = {**columns, **dict(zip((*AXES, "sX", "sY", "sZ"), np.hstack([xyz, s]).T, strict=True)), **turned}
    return {**out, "system": np.full(len(s), system.name)}


def _geojson(result: Any, columns: dict[str, Any], sigma: str) -> str:
    reference = result.network.settings.get("reference_lla")
    if reference is None or result.network.unit != "m":
        raise UsageError("GeoJSON needs longitude and latitude, and the source does not say where on the earth the points are: write .csv")
    named = system_of(result.network.settings)
    frame = TangentFrame(*(float(v) for v in reference)) if named is None else named[1]
    xyz = np.stack([columns[a] for a in AXES], axis=1) - np.asarray(result.network.offset)
    lla = frame.geographic(xyz)
    if named is not None:
        lla = named[0].to_wgs84(lla)
    features = []
    for i, place in enumerate(lla.tolist()):
        properties: dict[str, Any] = {"point": str(columns["point"][i]), "role": str(columns["role"][i]), "rays": int(columns["rays"][i])}
        for name, new in (("sX", "sigma_east"), ("sY", "sigma_north"), ("sZ", "sigma_up"), ("corr_XY", "correlation_east_north"),
                          ("corr_XZ", "correlation_east_up"), ("corr_YZ", "correlation_north_up")):  # fmt: skip
            value = float(columns[name][i])
            properties[new] = value if np.isfinite(value) else None  # a coordinate that was held fixed has no correlation
        where = [round(place[1], _DEGREES), round(place[0], _DEGREES), round(place[2], _METRES)]
        features.append({"type": "Feature", "geometry": {"type": "Point", "coordinates": where}, "properties": properties})
    root = {
        "type": "FeatureCollection",
        "description": f"adjusted object points, WGS 84, ellipsoidal heights; sigmas ({sigma}) in metres in the frame east, north, up",
        "features": features,
    }
    return json.dumps(root, allow_nan=False, ensure_ascii=False, indent=1) + "\n"
