"""The public names: every one can be reached, and `import baarda` stays light."""

import subprocess
import sys

import pytest

import baarda
from baarda.formats import read
from networks import ring


@pytest.mark.parametrize("name", baarda.__all__)
def test_every_public_name_is_there(name):
    assert getattr(baarda, name) is not None
    assert name in dir(baarda)


def test_an_unknown_name_is_named():
    with pytest.raises(AttributeError, match="nothing_of_the_kind"):
        _ = baarda.nothing_of_the_kind


def test_write_project_writes_what_read_reads(tmp_path):
    network = ring(images=4, points=8, control=4)
    baarda.write_project(network, tmp_path / "project")
    again = read(tmp_path / "project")
    assert again.images.labels == network.images.labels
    assert baarda.adjust(again).objective == pytest.approx(baarda.adjust(network).objective, rel=1e-9)


def test_importing_baarda_imports_neither_numpy_nor_scipy():
    code = "import baarda, sys; sys.exit(any(m in sys.modules for m in ('numpy', 'scipy', 'numba')))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
