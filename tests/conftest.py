"""Where tests find data."""

import inspect
import os
import re
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("baarda", deadline=None, derandomize=True)  # no timed tests, no random ones
settings.load_profile("baarda")

HERE = Path(__file__).parent
EXTRAS = re.compile(r'importorskip\("(pyarrow|pyproj|typst|fsspec)|^ *import distributed', re.MULTILINE)
SHARED = Path(os.environ.get("BAARDA_DATA", HERE.parent.parent / "shared" / "data"))


@cache
def needs_an_extra(path: Path) -> bool:
    return path.suffix == ".py" and EXTRAS.search(path.read_text(encoding="utf-8")) is not None


def pytest_collection_modifyitems(items):
    """Mark the tests that skip without an oracle or an extra, so that a second run can be confined to them."""
    for item in items:
        if isinstance(item, pytest.DoctestItem) and ">>> from pyarrow" in (item.dtest.docstring or ""):
            item.add_marker("extra")
            item.add_marker(pytest.mark.skipif(find_spec("pyarrow") is None, reason="the example needs the extra 'tables'"))
        if needs_an_extra(item.path):
            item.add_marker("extra")
        function = getattr(item, "function", None)
        reasons = [str(m.kwargs.get("reason", "")) for m in item.iter_markers("skipif")]
        if any("the oracle" in r for r in reasons) or (function is not None and "the oracle" in inspect.getsource(function)):
            item.add_marker("oracle")


def data_folder(name: str) -> Path:
    """Return a data folder of the repository, else of the shared data; skip the test where it is absent."""
    for place in (HERE / "data" / name, SHARED / name):
        if place.is_dir():
            return place
    pytest.skip(f"data set {name} is not here (set BAARDA_DATA)")


@pytest.fixture(scope="session")
def data():
    """A function from the name of a data set to its folder."""
    return data_folder


@pytest.fixture(scope="session")
def camcal() -> Path:
    """The script of the bundled camera calibration."""
    return HERE.parent / "src" / "baarda" / "data" / "camcal" / "camcaldemo.xml"
