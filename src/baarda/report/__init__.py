"""What people read: the result folder and the report."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from baarda.adjustment import Adjustment
from baarda.hypotheses.levels import Options
from baarda.procedures.testing import Analysis, analyse

__all__ = ["write_report"]


def write_report(result: Adjustment | Analysis, out: str | Path, **options: Any) -> Path:
    """Test an adjustment and write its result folder.

    Parameters
    ----------
    result : Adjustment or Analysis
    out : str or Path
        Folder to write; it is there whole or not at all.
    **options
        Levels and choices of the tests, the fields of `baarda.hypotheses.levels.Options`.

    Returns
    -------
    Path
        The folder.
    """
    from baarda.report.result_folder import write_folder

    return write_folder(result if isinstance(result, Analysis) else analyse(result, Options(**options)), out)
