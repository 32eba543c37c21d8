"""Covariances of the unknowns of an adjustment as files that say what they hold.

A folder with ``covariance.npz`` (NumPy, without pickles), ``covariance.mtx`` (Matrix Market, lower triangle), ``index.csv`` (name, group,
label, parameter, unit, value and standard deviation of every row) and ``index.json``: which variance factor, which datum, which blocks.
"""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from baarda.errors import UsageError
from baarda.formats.csv_table import csv_text, numbers_text, quoted
from baarda.formats.folder import Mark, whole_folder

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

SCHEMA = "baarda.covariance/1"
FILES = ("covariance.npz", "covariance.mtx", "index.csv", "index.json")
MARK = Mark("index.json", SCHEMA, FILES)
FULL = 2000  # unknowns up to which all covariances are written
_ANGLES = {"omega": "rotation_x", "phi": "rotation_y", "kappa": "rotation_z"}


def write_covariance(
    result: Any,
    path: str | Path,
    blocks: Literal["auto", "full", "nodes"] = "auto",
    sigma: Literal["aposteriori", "apriori"] = "aposteriori",
) -> None:
    """Write the covariance matrix of the unknowns, marginal: with all other unknowns estimated too.

    Parameters
    ----------
    result : Adjustment
    path : str or Path
        The folder; it must not exist, be empty, or hold an earlier covariance.
    blocks : {"auto", "full", "nodes"}
        All covariances, or those between the parameters of one camera, one image, one point and of all cameras among each other; auto =
        full up to 2000 unknowns.
    sigma : {"aposteriori", "apriori"}
        Which variance factor scales the cofactors.

    Raises
    ------
    UsageError
        If an option is not known or the adjustment did not converge.
    OutputError
        If the folder cannot be written; nothing is left behind.
    """
    if blocks not in ("auto", "full", "nodes") or sigma not in ("aposteriori", "apriori"):
        raise UsageError(f"blocks is auto, full or nodes, and sigma aposteriori or apriori, not {blocks!r} and {sigma!r}")
    if result.status != "converged":
        raise UsageError("the adjustment did not converge: there is no covariance to write")
    numbering = result.numbering
    whole = blocks == "full" or (blocks == "auto" and numbering.count <= FULL)
    scale = float(result.scale(sigma)) ** 2
    if whole:
        at = np.arange(numbering.count)
        matrix = scale * result.cofactors.of(at)
        matrix = 0.5 * (matrix + matrix.T)
        row, column = np.tril_indices(numbering.count)
        value = matrix[row, column]
        arrays: dict[str, Any] = {"covariance": matrix}
    else:
        row, column, value = _node_blocks(result)
        value = scale * value
        arrays = {"row": row.astype(np.int64), "column": column.astype(np.int64), "value": value}
    names, table = _index(result, sigma)
    about = {
        "schema": SCHEMA,
        "unknowns": numbering.count,
        "stored": "full" if whole else "nodes",
        "meaning": "marginal covariances: all other unknowns are estimated, too",
        "blocks": "all"
        if whole
        else "within each camera, image and object point, and among all cameras; other covariances are not stored, not zero",
        "triangle": "covariance.npz holds the symmetric matrix"
        if whole
        else "covariance.npz and covariance.mtx hold the lower triangle: row, column, value",
        "variance_factor": {"which": sigma, "value": scale},
        "datum": {"kind": result.datum.name, "text": result.datum.text, "defect": int(result.datum.defect.count)},
        "rotations": "rotation_x, rotation_y, rotation_z are increments about the camera axes, radians, not omega, phi, kappa",
        "object_unit": result.network.unit,
        "rows": "index.csv names every row and column; numbers count from 0 in index.csv and .npz, from 1 in .mtx",
        "files": list(FILES),
    }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, names=np.array(names, dtype=str), **arrays)
    with whole_folder(Path(path), MARK) as folder:
        (folder / "index.json").write_text(json.dumps(about, indent=1, allow_nan=False, ensure_ascii=False) + "\n", encoding="utf-8")
        (folder / "index.csv").write_text(csv_text(table), encoding="utf-8")
        (folder / "covariance.npz").write_bytes(buffer.getvalue())
        (folder / "covariance.mtx").write_text(_matrix_market(row, column, value, numbering.count), encoding="ascii")


def _index(result: Any, sigma: str) -> tuple[list[str], dict[str, list[str]]]:
    """Return the names of all rows and the columns of the index, one row per unknown in the order of the matrix."""
    known = result.unknown_table(sigma)
    groups = result.numbering.groups
    out: dict[str, list[str]] = {k: [] for k in ("row", "name", "group", "label", "parameter", "unit", "value", "sigma")}
    rows: dict[int, tuple[str, str, str]] = {}
    all_names = []
    for g in groups:
        for node, label in enumerate(g.labels):
            names = g.parameters_of(node)
            for k, at in enumerate(g.columns[g.offsets[node] : g.offsets[node + 1]].tolist()):
                if at >= 0:
                    rows[at] = g.kind, label, names[k]
    for at in range(result.numbering.count):
        kind, label, parameter = rows[at]
        turned = kind == "image" and parameter in _ANGLES
        parameter = _ANGLES[parameter] if turned else parameter
        all_names.append(f"{kind} {label}: {parameter}")
        for key, text in (("name", all_names[-1]), ("group", kind), ("label", label), ("parameter", parameter)):
            out[key].append(quoted(text))
        out["row"].append(str(at))
        out["unit"].append(quoted(str(known["unit"][at])))
        out["value"].append("" if turned else numbers_text(np.array([known["value"][at]]))[0])
    variances = np.empty(result.numbering.count)
    for g in groups:
        for width in np.unique(np.diff(g.offsets)).tolist():
            nodes = np.flatnonzero(np.diff(g.offsets) == width)
            at = g.of(nodes, width)
            diagonal = np.einsum("nii->ni", result.cofactors.blocks(at))
            variances[at[at >= 0]] = diagonal[at >= 0]
    out["sigma"] = numbers_text(float(result.scale(sigma)) * np.sqrt(variances))
    return all_names, out


def _node_blocks(result: Any) -> tuple[Ints, Ints, Floats]:
    """Return the lower triangles of the blocks of images, points and declared unknowns, and of all cameras together."""
    rows, columns, values = [], [], []
    for g in result.numbering.groups:
        widths = np.diff(g.offsets)
        if g.kind == "camera":
            at = g.columns[g.columns >= 0]
            if len(at):
                q = result.cofactors.of(at)
                i, j = np.tril_indices(len(at))
                rows.append(at[i])
                columns.append(at[j])
                values.append(0.5 * (q + q.T)[i, j])
            continue
        for width in np.unique(widths).tolist():
            at = g.of(np.flatnonzero(widths == width), width)
            q = result.cofactors.blocks(at)
            i, j = np.tril_indices(width)
            keep = (at[:, i] >= 0) & (at[:, j] >= 0)
            rows.append(at[:, i][keep])
            columns.append(at[:, j][keep])
            values.append(0.5 * (q + q.transpose(0, 2, 1))[:, i, j][keep])
    row, column, value = np.concatenate(rows), np.concatenate(columns), np.concatenate(values)
    row, column = np.maximum(row, column), np.minimum(row, column)
    order = np.lexsort((row, column))
    return row[order], column[order], value[order]


def _matrix_market(row: Ints, column: Ints, value: Floats, count: int) -> str:
    """Return the text of a symmetric real matrix (Boisvert, Pozo & Remington 1996); zeros are left out."""
    keep = np.flatnonzero(value != 0.0)
    lines = ["%%MatrixMarket matrix coordinate real symmetric", f"% {SCHEMA}; rows are named in index.csv", f"{count} {count} {len(keep)}"]
    lines += [f"{i} {j} {v!r}" for i, j, v in zip((row[keep] + 1).tolist(), (column[keep] + 1).tolist(), value[keep].tolist(), strict=True)]
    return "\n".join(lines) + "\n"
