"""NumPy files from strangers: mapped, never unpickled, and never handed to NumPy where their header would end the process."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np


def map_array(file: Path) -> np.ndarray[Any, Any]:
    """Return the array of an ``.npy`` file, mapped into memory for reading.

    Parameters
    ----------
    file : Path

    Returns
    -------
    array
        Of the shape and type that the header states.

    Raises
    ------
    ValueError
        If the elements have no size (NumPy divides by it and the process ends) or are Python objects, or the file holds less than its
        header says; what else damaged headers end in is listed in `baarda.formats.residual_table.HEADER_ERRORS`.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "v.npy"
    >>> np.save(path, np.arange(3.0))
    >>> map_array(path).tolist()
    [0.0, 1.0, 2.0]
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of headers that Python 2 wrote
        with file.open("rb") as f:
            version = np.lib.format.read_magic(f)
            if version != (1, 0):
                begin = f.tell()
                length = int.from_bytes(f.read(4), "little")
                if length > file.stat().st_size:  # NumPy would ask for that much memory
                    raise ValueError("its header ends beyond the file")
                f.seek(begin)
            read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, dtype = read_header(f)
        if dtype.itemsize == 0:
            raise ValueError(f"its elements ({dtype}) have no size")
        if any(type(n) is not int or n < 0 for n in shape):
            raise ValueError(f"{shape} is not the shape of an array")
        if dtype.itemsize * math.prod(shape) > file.stat().st_size:  # an element may be announced larger than memory
            raise ValueError("its header announces more than the file holds")
        mapped: np.ndarray[Any, Any] = np.load(file, mmap_mode="r", allow_pickle=False)
    return mapped
