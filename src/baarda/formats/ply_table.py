"""The vertices of PLY files (Turk 1994), binary or text, as columns."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baarda.errors import InputError

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}
_HEADER = 1 << 16


def vertices(data: bytes, file: Path, needed: tuple[str, ...]) -> dict[str, NDArray[Any]]:
    r"""Return the properties of the vertices by name.

    Parameters
    ----------
    data : bytes
    file : Path
        For messages.
    needed : tuple of str
        Properties that must be there.

    Raises
    ------
    InputError
        If the header cannot be used, the vertices are not the first element, or the data end early.

    Examples
    --------
    >>> head = b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty int id\nend_header\n"
    >>> found = vertices(head + b"0.5 7\n1.5 8\n", Path("a.ply"), ("x", "id"))
    >>> found["x"].tolist(), found["id"].tolist()
    ([0.5, 1.5], [7, 8])
    """
    end = re.search(rb"\bend_header\r?\n", data[:_HEADER])
    if not data.startswith(b"ply") or end is None:
        raise InputError("not a PLY file: it must begin with ply and have a header", file)
    order, count, fields, element = "", -1, [], ""
    for i, line in enumerate(data[: end.start()].decode("ascii", "replace").splitlines(), start=1):
        words = line.split()
        if words[:1] == ["format"]:
            order = _ORDERS.get(words[1] if len(words) > 1 else "", "")
            if not order:
                raise InputError(f"PLY format {line!r:.60} is not known", file, i)
            text = words[1] == "ascii"
        elif words[:1] == ["element"]:
            if len(words) != 3 or not re.fullmatch(r"\d{1,12}", words[2], re.ASCII):
                raise InputError(f"not an element: {line!r:.60}", file, i)
            if not element and words[1] != "vertex":
                raise InputError(f"the first element must be vertex, not {words[1]!r:.60}", file, i)
            element = words[1]
            if element == "vertex":
                count = int(words[2])
        elif words[:1] == ["property"] and element == "vertex":
            if len(words) != 3 or words[1] not in _TYPES:
                raise InputError(f"property {line!r:.60} is not supported", file, i)
            fields.append((words[2], order + _TYPES[words[1]]))
    names = [n for n, _ in fields]
    if not order or count < 0 or len(set(names)) < len(names):
        raise InputError("the PLY header has no format, no vertices, or a property twice", file)
    if dict(fields).get("id", "i4").lstrip("<>")[0] == "f":
        raise InputError("the property id must be whole numbers", file)
    missing = [n for n in needed if n not in names]
    if missing:
        raise InputError(f"the vertices have no property {missing[0]!r}; they have {', '.join(names)}", file)
    dtype = np.dtype(fields)
    body = data[end.end() :]
    if text:
        rows = body.split(b"\n")[:count]
        try:
            table = np.array([tuple(r.split()) for r in rows], dtype=dtype) if count else np.zeros(0, dtype=dtype)
        except ValueError as error:
            raise InputError(f"the vertices cannot be read: {error}", file) from None
        if len(table) < count:
            raise InputError(f"{count} vertices are announced, the text holds {len(table)}: truncated?", file)
    else:
        if len(body) < count * dtype.itemsize:
            raise InputError(f"{count} vertices of {dtype.itemsize} bytes are announced, {len(body)} bytes follow: truncated?", file)
        table = np.frombuffer(body, dtype, count)
    with np.errstate(invalid="ignore"):  # a NaN that signals
        return {n: table[n].astype(float) if table[n].dtype.kind == "f" else table[n] for n in names}
