"""Settings and versions: what must be the same for the same numbers to come out again; nothing that differs from run to run."""

from __future__ import annotations

import platform
from importlib.metadata import version

import baarda
from baarda.procedures.testing import Analysis
from baarda.report.sections.base import Block, Column, DataTable, SectionMaker, say

_MEANINGS = {
    "alpha": "level of global tests, tests of parameters, images and points",
    "alpha_outlier": "level of the test of one observation",
    "power": "power that minimal detectable biases promise",
    "sigma": "variance factor that judges: a posteriori (t, F, tau) or a priori (normal, chi-square)",
    "levels": "how families of tests share their level",
    "seed": "seed of simulated null laws",
    "replicas": "simulated data sets per null law",
    "correlation_limit": "pairs of parameters correlated beyond it are tested together",
}


def _build(analysis: Analysis) -> list[Block]:
    net = analysis.adjustment.network
    source = [("source", net.path or "in memory", "as typed"), ("format", net.format or "in memory", "reader that was used")]
    said = {k: ", ".join(m.name for m in v) if k == "camera_sets" else str(v) for k, v in net.settings.items()}
    found = [(say("source: {key}", key=key), value, "setting found in the source; options win over it") for key, value in said.items()]
    options = [(key, str(value), _MEANINGS.get(key, "")) for key, value in vars(analysis.options).items()]
    columns = (Column("setting", "", "", "left"), Column("value", "", "", "left"), Column("meaning", "", "", "left"))
    software = [("baarda", baarda.__version__), ("python", platform.python_version())]
    software += [(name, version(name)) for name in ("numpy", "scipy", "matplotlib")]
    names = (Column("software", "", "", "left"), Column("version", "", "", "left"))
    return [DataTable("Settings", columns, (*source, *found, *options)), DataTable("Software", names, tuple(software))]


SETTINGS = SectionMaker(140, "settings", "Settings and versions", _build)
