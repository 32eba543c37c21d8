"""Real blocks of other programs, from the command line: adjusted, audited, reported."""

import json

import pytest

from test_cli import run


@pytest.mark.parametrize(
    ("name", "images", "sigma0", "distance"),
    [("opensfm_berlin", 3, 2.6037, 0.457), ("colmap_sceaux_txt", 11, None, 0.0344)],
)
def test_adjust_and_audit(data, tmp_path, name, images, sigma0, distance):
    out = tmp_path / "out"
    done = run("adjust", str(data(name)), "--audit", "--out", str(out))
    assert done.returncode == 0, done.stderr
    result = json.loads((out / "result.json").read_text())
    assert result["status"] == "converged" and result["counts"]["images"] == images
    if sigma0 is not None:
        assert result["sigma0"]["aposteriori"] == pytest.approx(sigma0, abs=1e-3)
    assert result["audit"]["distance"] == pytest.approx(distance, abs=2e-3)
    assert {t["name"] for t in result["tests"]} >= {"global_variance_factor", "data_snooping"}
    assert (out / "report.html").stat().st_size > 50_000
